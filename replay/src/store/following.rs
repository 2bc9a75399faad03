//! How a segment's trace is led through a [`Store`] to the minibatch that it is first in.

use std::time::SystemTime;

use getup_proto::{Segment, SegmentTrace, TraceContext};
use getup_telemetry::traces::{KeyValue, SpanKind};

use super::Store;
use crate::ring::{Drawn, Ring};
use crate::undrawn::Followed;

impl Store {
    /// Records what befell a segment that is followed up to now, when it has entered the ring as the newest.
    pub(super) fn committed(&self, ring: &Ring, segment: &Segment, trace: SegmentTrace) {
        let now = SystemTime::now();
        let SegmentTrace { context, begun, since } = trace;
        self.traces.child(context, ("limiter", SpanKind::Internal), begun, since, Vec::new());
        let sequence = KeyValue::new("getup.sequence", segment.sequence as i64);
        self.traces.child(context, ("commit", SpanKind::Consumer), since, now, vec![sequence]);
        self.undrawn.insert(ring.numbers(), context, now);
    }

    /// The segments that are followed of which one of `drawn` is the first draw.
    pub(super) fn followed(&self, ring: &Ring, drawn: &[Drawn]) -> Vec<Followed> {
        self.undrawn.take(drawn.iter().map(|drawn| ring.number_of(drawn.slot)))
    }

    /// Records that a segment that is followed is in a minibatch for the first time; returns where its trace goes on.
    pub(super) fn sampled(
        &self,
        followed: &Followed,
        began: Option<SystemTime>,
        batch: usize,
    ) -> TraceContext {
        let &Followed { context, since, .. } = followed;
        let from = began.map_or(since, |began| began.max(since));
        let waited = from.duration_since(since).unwrap_or_default().as_secs_f64();
        let attributes =
            vec![KeyValue::new("getup.batch", batch as i64), KeyValue::new("getup.undrawn_seconds", waited)];
        self.traces.child(context, ("sample", SpanKind::Producer), from, SystemTime::now(), attributes)
    }
}

/// Those of the segments that are followed are here now, whatever befell them in this process before.
pub(super) fn arrived(segments: &mut [Segment]) {
    for trace in segments.iter_mut().filter_map(|segment| segment.trace.as_mut()) {
        **trace = SegmentTrace::arrived(trace.context);
    }
}
