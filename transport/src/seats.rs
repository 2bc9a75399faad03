//! How many connections a port holds, in all and from one address.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use getup_telemetry::prometheus::IntGauge;

use crate::metrics::Reason;

/// The places of a port's connections.
#[derive(Debug)]
pub(crate) struct Seats {
    /// Places in all, and for one address.
    limits: (usize, usize),
    taken: Mutex<HashMap<IpAddr, usize>>,
    gauge: IntGauge,
}

/// A place that is free again when this is dropped.
#[derive(Debug)]
pub(crate) struct Seat {
    seats: Arc<Seats>,
    peer: IpAddr,
}

impl Seats {
    pub(crate) fn new(connections: usize, per_peer: usize, gauge: IntGauge) -> Arc<Self> {
        Arc::new(Self { limits: (connections, per_peer), taken: Mutex::default(), gauge })
    }

    /// A place for a connection from this address, or why there is none.
    pub(crate) fn take(self: &Arc<Self>, peer: IpAddr) -> Result<Seat, Reason> {
        let peer = peer.to_canonical();
        let mut taken = self.taken();
        if taken.values().sum::<usize>() >= self.limits.0 {
            return Err(Reason::Connections);
        }
        if taken.get(&peer).is_some_and(|of_peer| *of_peer >= self.limits.1) {
            return Err(Reason::PeerConnections);
        }
        *taken.entry(peer).or_default() += 1;
        self.gauge.inc();
        Ok(Seat { seats: Arc::clone(self), peer })
    }

    fn taken(&self) -> MutexGuard<'_, HashMap<IpAddr, usize>> {
        // The map is whole after every statement: a panic elsewhere does not spoil it.
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        let mut taken = self.seats.taken();
        if let Some(of_peer) = taken.get_mut(&self.peer) {
            *of_peer -= 1;
            if *of_peer == 0 {
                taken.remove(&self.peer);
            }
        }
        self.seats.gauge.dec();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_is_free_again_once_its_connection_is_gone() {
        let gauge = IntGauge::new("connections", "connections").unwrap();
        let seats = Seats::new(3, 2, gauge.clone());
        let take = |peer: &str| seats.take(peer.parse().unwrap());
        let first = take("10.0.0.1").unwrap();
        let _second = take("::ffff:10.0.0.1").unwrap();
        assert_eq!(take("10.0.0.1").unwrap_err(), Reason::PeerConnections);
        let third = take("10.0.0.2").unwrap();
        assert_eq!(take("10.0.0.3").unwrap_err(), Reason::Connections);
        assert_eq!(gauge.get(), 3);
        drop((first, third));
        assert_eq!((gauge.get(), seats.taken().len()), (1, 1));
        take("10.0.0.1").unwrap();
    }
}
