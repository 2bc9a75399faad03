//! The protocol in a simulation: all roles on machines of their own, on one thread, with one clock and one seed.
//!
//! Real are the actor's role (queue, spread, links, heartbeats, reports, shutdown), the replay's service over its store on
//! disk, the learner's hub, leases, service and curriculum, and the transport with HTTP/2 and gRPC. Stubs are what plays
//! and what learns. turmoil brings the clock and the network, in which messages are late, held back and lost; a
//! machine loses its power at any write to the network, and keeps its disk as it was then.
//!
//! | module | what lives there |
//! | --- | --- |
//! | `schedule` | what happens to machines and links, out of a seed |
//! | `herd` | many actors, and a learner that comes back to them |
//! | `ledger` | what has happened, and the promises it is held against |
//! | `roles`, `trainer` | the three roles; the stubs |
//! | `machine`, `network` | the power, the disk, the wires |
//!
//! Each schedule, and the herd, has a process of its own, whose random numbers all come from its seed: they do too where
//! they ask the operating system.
//! `GETUP_SIMULATION_SEED=N cargo test --release -p getup-actor --test simulation -- --nocapture` plays the schedule of
//! seed N aloud. `GETUP_TEST_FULL` plays five thousand.

mod herd;
mod ledger;
mod machine;
mod network;
mod roles;
mod schedule;
mod trainer;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tempfile::TempDir;

/// The seed that somebody wants repeated.
const SEED: &str = "GETUP_SIMULATION_SEED";
/// The seed of a process' own schedule.
const SCHEDULE: &str = "GETUP_TEST_SCHEDULE";
/// The test that plays it.
const PLAYS: &str = "plays_its_schedule";
/// An empty folder for its disks.
const FOLDER: &str = "GETUP_TEST_FOLDER";
/// Whether it tells every event.
const ALOUD: &str = "GETUP_TEST_ALOUD";
/// Real time after which a schedule is taken to hang.
const PATIENCE: Duration = Duration::from_secs(120);

/// Seeds of schedules that found something once.
const REGRESSIONS: [u64; 0] = [];

/// Random numbers of the operating system, out of the seed: every thread has the same.
const RANDOMNESS: &str = r#"
#include <stdint.h>
#include <stdlib.h>
#include <sys/types.h>

ssize_t getrandom(void *bytes, size_t count, unsigned int flags) {
    static __thread uint64_t state;
    (void)flags;
    if (!state) state = strtoull(getenv("GETUP_TEST_SCHEDULE"), 0, 10) * 2 + 1;
    for (size_t at = 0; at < count; at++) {
        state = state * 6364136223846793005u + 1442695040888963407u;
        ((unsigned char *)bytes)[at] = (unsigned char)(state >> 56);
    }
    return (ssize_t)count;
}
"#;

/// The process of a schedule: without its variable there is nothing to prove here.
#[test]
fn plays_its_schedule() {
    let Some((seed, folder)) = own_process() else { return };
    match schedule::play(seed, &folder, std::env::var_os(ALOUD).is_some()) {
        Ok(summary) => println!("\nplayed: {summary}"),
        Err(broken) => panic!("\nbroken: {broken}"),
    }
}

/// The seed and the folder that a [`Player`] started this process for, which then ends in time; `None` if none did.
fn own_process() -> Option<(u64, PathBuf)> {
    let seed = std::env::var(SCHEDULE).ok()?.parse().unwrap();
    std::thread::spawn(|| {
        std::thread::sleep(PATIENCE);
        eprintln!("it hangs: it was not played within {PATIENCE:?}");
        std::process::abort();
    });
    Some((seed, PathBuf::from(std::env::var_os(FOLDER).unwrap())))
}

/// Starts processes whose random numbers all come from a seed.
struct Player {
    randomness: PathBuf,
    _folder: TempDir,
}

impl Player {
    fn new() -> Self {
        let folder = TempDir::new().unwrap();
        let (source, randomness) = (folder.path().join("random.c"), folder.path().join("random.so"));
        std::fs::write(&source, RANDOMNESS).unwrap();
        let compiled =
            Command::new("cc").args(["-shared", "-fPIC", "-o"]).arg(&randomness).arg(&source).status();
        assert!(compiled.unwrap().success());
        Self { randomness, _folder: folder }
    }

    /// A process of one of the tests here.
    fn command(&self, test: &str, seed: u64, folder: &TempDir) -> Command {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command
            .args(["--exact", test, "--nocapture"])
            .env(SCHEDULE, seed.to_string())
            .env(FOLDER, folder.path())
            .env("LD_PRELOAD", &self.randomness);
        command
    }

    fn play(&self, seed: u64) -> Result<String, String> {
        let folder = TempDir::new().unwrap();
        let Output { status, stdout, stderr } = self.command(PLAYS, seed, &folder).output().unwrap();
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        let (stdout, stderr) = (text(&stdout), text(&stderr));
        match stdout.lines().find(|line| line.starts_with("played: ")) {
            Some(summary) if status.success() => Ok(summary.to_owned()),
            _ => Err(stderr),
        }
    }
}

fn repeat_with(seed: u64) -> String {
    let this = Path::new("actor").join("tests").join("simulation");
    format!(
        "{SEED}={seed} cargo test --release -p getup-actor --test simulation -- --nocapture (see {})",
        this.display()
    )
}

#[test]
fn what_is_promised_is_kept_in_every_schedule() {
    let player = Player::new();
    if let Ok(seed) = std::env::var(SEED) {
        let folder = TempDir::new().unwrap();
        let status = player.command(PLAYS, seed.parse().unwrap(), &folder).env(ALOUD, "1").status().unwrap();
        assert!(status.success(), "the schedule of seed {seed} breaks a promise");
        return;
    }
    let seeds: u64 = if std::env::var_os("GETUP_TEST_FULL").is_some() { 5_000 } else { 300 };
    let (next, broken) = (AtomicU64::new(0), Mutex::new(Vec::new()));
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
            scope.spawn(|| {
                while broken.lock().unwrap().is_empty() {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    let seed = match REGRESSIONS.get(index as usize) {
                        Some(seed) => *seed,
                        None if index < seeds + REGRESSIONS.len() as u64 => index - REGRESSIONS.len() as u64,
                        None => return,
                    };
                    if let Err(output) = player.play(seed) {
                        broken.lock().unwrap().push((seed, output));
                    }
                }
            });
        }
    });
    if let Some((seed, output)) = broken.into_inner().unwrap().first() {
        panic!(
            "the schedule of seed {seed} breaks a promise:\n{output}\nrepeat it with\n{}",
            repeat_with(*seed)
        );
    }
}

#[test]
fn a_seed_repeats_its_schedule_event_by_event() {
    let player = Player::new();
    for seed in 0..4 {
        let first = player.play(seed).unwrap();
        assert_eq!(player.play(seed).unwrap(), first, "seed {seed}");
    }
    assert_ne!(player.play(0), player.play(1), "and another seed has another");
}

#[test]
fn actors_do_not_come_back_all_at_once_to_a_learner_that_was_away() {
    const NAME: &str = "actors_do_not_come_back_all_at_once_to_a_learner_that_was_away";
    /// Within so long, no more than a quarter of them.
    const WINDOW: Duration = Duration::from_millis(50);
    let Some((_, folder)) = own_process() else {
        let folder = TempDir::new().unwrap();
        let Output { status, stderr, .. } = Player::new().command(NAME, 1, &folder).output().unwrap();
        assert!(status.success(), "{}", String::from_utf8_lossy(&stderr));
        return;
    };
    let most = |moments: &[Duration]| {
        let within = |first: &Duration| {
            moments.iter().filter(|moment| (*first..*first + WINDOW).contains(*moment)).count()
        };
        moments.iter().map(within).max().unwrap_or(0)
    };
    for absence in [herd::Absence::Crash, herd::Absence::Hang] {
        let folder = folder.join(format!("{absence:?}"));
        std::fs::create_dir(&folder).unwrap();
        let herd::Return { connections, mut heartbeats } = herd::play(&folder, absence);
        if let herd::Absence::Crash = absence {
            assert_eq!(connections.len(), herd::ACTORS, "each connects again, once");
        }
        assert!(most(&connections) <= herd::ACTORS / 4, "{absence:?}: connections at {connections:.2?}");
        // One of each may have waited for it.
        heartbeats.retain(|moment| *moment > Duration::from_millis(100));
        assert!(heartbeats.len() > 4 * herd::ACTORS, "{absence:?}: {} heartbeats", heartbeats.len());
        assert!(most(&heartbeats) <= herd::ACTORS / 4, "{absence:?}: heartbeats at {heartbeats:.2?}");
    }
}
