//! A machine that may lose its power at any write to the network, and its disk as it was then.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard};
use std::time::Duration;

use getup_telemetry::Shutdown;

/// A host of the simulation, with what survives its crashes.
pub(crate) struct Machine {
    /// Its name on the network.
    pub(crate) name: String,
    /// Its disk, where it has one.
    disk: Option<PathBuf>,
    state: Mutex<State>,
    /// When somebody connected to it, and when it sent a heartbeat; over all its starts.
    visits: Mutex<Vec<Duration>>,
    heartbeats: Mutex<Vec<Duration>>,
}

#[derive(Default)]
struct State {
    /// Writes to the network that are left before the power goes, and whether the last of them still leaves.
    fuse: Option<(u32, bool)>,
    /// What a machine without power does is never seen by anybody, its own disk included.
    dead: bool,
    /// Ends what runs in order.
    shutdown: Shutdown,
}

impl Machine {
    pub(crate) fn new(name: String, disk: Option<PathBuf>) -> Self {
        Self { name, disk, state: Mutex::default(), visits: Mutex::default(), heartbeats: Mutex::default() }
    }

    /// Its disk.
    pub(crate) fn disk(&self) -> &Path {
        self.disk.as_deref().expect("this machine has a disk")
    }

    /// The power goes at a write after so many others; whether that one still leaves.
    pub(crate) fn light_fuse(&self, writes: u32, leaves: bool) {
        self.state().fuse = Some((writes, leaves));
    }

    /// The power goes now, unless it has.
    pub(crate) fn cut_power(&self) {
        let mut state = self.state();
        if !state.dead {
            state.dead = true;
            self.keep_disk();
        }
    }

    /// To be asked before bytes leave: whether they do.
    pub(crate) fn may_write(&self) -> bool {
        let mut state = self.state();
        if state.dead {
            return false;
        }
        match &mut state.fuse {
            None => true,
            Some((0, leaves)) => {
                let leaves = *leaves;
                state.dead = true;
                self.keep_disk();
                leaves
            }
            Some((writes, _)) => {
                *writes -= 1;
                true
            }
        }
    }

    /// Whether there is power.
    pub(crate) fn is_alive(&self) -> bool {
        !self.state().dead
    }

    /// What ends this start of the machine in order.
    pub(crate) fn shutdown(&self) -> Shutdown {
        self.state().shutdown.clone()
    }

    /// Notes that somebody connects to it.
    pub(crate) fn visited(&self) {
        self.visits.lock().unwrap().push(turmoil::sim_elapsed().unwrap_or_default());
    }

    /// When somebody connected to it.
    pub(crate) fn visits(&self) -> Vec<Duration> {
        self.visits.lock().unwrap().clone()
    }

    /// Notes that it sends a heartbeat.
    pub(crate) fn beats(&self) {
        self.heartbeats.lock().unwrap().push(turmoil::sim_elapsed().unwrap_or_default());
    }

    /// When it sent a heartbeat.
    pub(crate) fn heartbeats(&self) -> Vec<Duration> {
        self.heartbeats.lock().unwrap().clone()
    }

    /// Before the next start, when nothing runs any more: the disk is as it was when the power went.
    pub(crate) fn reset(&self) {
        let mut state = self.state();
        if state.dead
            && let Some(disk) = &self.disk
        {
            fs::remove_dir_all(disk).unwrap();
            fs::rename(kept(disk), disk).unwrap();
        }
        *state = State::default();
    }

    fn keep_disk(&self) {
        if let Some(disk) = &self.disk {
            copy(disk, &kept(disk));
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap()
    }
}

fn kept(disk: &Path) -> PathBuf {
    disk.with_extension("kept")
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let target = to.join(entry.file_name());
        if entry.file_type().unwrap().is_dir() {
            copy(&entry.path(), &target);
        } else {
            fs::copy(entry.path(), target).unwrap();
        }
    }
}
