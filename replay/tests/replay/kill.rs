//! The service as a process of its own, killed under load and on a slow disk: every acknowledged segment is there, and none
//! twice.

use crate::common::{self, PATIENCE, Writer, config, open};
use crate::fixtures::{segment, spec};
use getup_replay::{MinibatchSource, RemoteOptions, RemoteSource, ReplayConfig, SyncMode, serve};
use getup_telemetry::{Registry, Shutdown, Waits};
use std::collections::HashMap;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tempfile::TempDir;
use tokio::net::TcpListener;

const DIR: &str = "GETUP_TEST_REPLAY_DIR";
const WRITERS: u64 = 3;
const STEPS: usize = 8;

/// The process that is killed: without its variable there is nothing to prove here.
#[test]
fn serves_until_it_is_killed() {
    let Some(dir) = std::env::var_os(DIR) else { return };
    let store = open(Path::new(&dir), &spec(STEPS), &config()).unwrap();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        println!("\nlistening on {}", listener.local_addr().unwrap());
        serve(listener, Arc::new(store), Shutdown::new()).await.unwrap();
    });
}

/// The process, until it is dropped.
struct Service(Child);

impl Service {
    fn kill(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        // One that was killed is.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn start(dir: &Path) -> (Service, String) {
    start_with(dir, None)
}

/// Starts the process, with a library before all others.
fn start_with(dir: &Path, library: Option<&Path>) -> (Service, String) {
    let mut command = Command::new(std::env::current_exe().unwrap());
    if let Some(library) = library {
        command.env("LD_PRELOAD", library);
    }
    let mut child = command
        .args(["--exact", "kill::serves_until_it_is_killed", "--nocapture"])
        .env(DIR, dir)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let endpoint =
        lines.map_while(Result::ok).find_map(|line| line.strip_prefix("listening on ").map(str::to_owned));
    (Service(child), endpoint.expect("the process says where it listens"))
}

/// Writes segments from somewhat before the service's mark until the service is gone; returns what was acknowledged.
async fn write(endpoint: String, id: u64, acknowledged: Arc<AtomicU64>) {
    let spec = spec(STEPS);
    let Ok(mut writer) = Writer::connect(&endpoint, &spec, id).await else { return };
    assert!(writer.durable >= acknowledged.load(Ordering::SeqCst), "an acknowledged segment is gone");
    let from = writer.durable.saturating_sub(5) + 1;
    let (requests, mut replies) = (writer.requests.clone(), writer.replies);
    let sending = tokio::spawn(async move {
        for sequence in from.. {
            let message = Some(common::message(&segment(&spec, id, sequence, STEPS)));
            if requests.send(getup_proto::v1::AppendRequest { message, ..Default::default() }).await.is_err()
            {
                return;
            }
        }
    });
    writer.requests = tokio::sync::mpsc::channel(1).0;
    while let Ok(sequence) = common::next(&mut replies).await {
        acknowledged.fetch_max(sequence, Ordering::SeqCst);
    }
    sending.abort();
}

#[test]
fn every_acknowledged_segment_survives_a_kill_under_load_and_none_is_stored_twice() {
    let kills = if std::env::var_os("GETUP_TEST_FULL").is_some() { 200 } else { 4 };
    let dir = TempDir::new().unwrap();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let acknowledged: HashMap<u64, Arc<AtomicU64>> = (1..=WRITERS).map(|id| (id, Arc::default())).collect();
    let total = || acknowledged.values().map(|sequence| sequence.load(Ordering::SeqCst)).sum::<u64>();
    let mut sampled = 0;
    for kill in 0..kills {
        let (mut child, endpoint) = start(dir.path());
        let before = total();
        let writing: Vec<_> = acknowledged
            .iter()
            .map(|(&id, acknowledged)| runtime.spawn(write(endpoint.clone(), id, acknowledged.clone())))
            .collect();
        let mut source = sampler(&endpoint, &runtime);
        // At another moment each time, and not before something was acknowledged.
        let started = Instant::now();
        let lasts = Duration::from_millis(30 + 37 * (kill % 7));
        while started.elapsed() < lasts || total() <= before {
            assert!(started.elapsed() < PATIENCE, "nothing is acknowledged");
            if let Some(minibatch) = source.poll(Duration::from_millis(5)).unwrap() {
                sampled = minibatch.counters.sampled;
            }
        }
        child.kill();
        for writing in writing {
            runtime.block_on(writing).unwrap();
        }

        let store = open(dir.path(), &spec(STEPS), &config()).unwrap();
        let mut stored = 0;
        for (&id, acknowledged) in &acknowledged {
            let durable = store.introduce(id, "actor");
            assert!(
                durable >= acknowledged.load(Ordering::SeqCst),
                "kill {kill}: an acknowledged segment is gone"
            );
            stored += durable * STEPS as u64;
        }
        // Writers leave no gaps here: so many segments, each once, and as many of them as fit.
        let counters = store.counters();
        assert_eq!(counters.transitions, stored, "kill {kill}");
        assert_eq!(store.len() as u64, stored.min(config().capacity as u64), "kill {kill}");
        assert!(counters.sampled >= sampled, "kill {kill}: samples were forgotten");
    }
    assert!(total() > kills);
}

/// Makes every write of segments to a file take a twentieth of a second; those of the watermark's few bytes stay in memory.
const SLOW_WRITES: &str = r#"
#define _GNU_SOURCE
#include <dlfcn.h>
#include <sys/stat.h>
#include <unistd.h>

static void wait_for(int file, size_t count) {
    struct stat facts;
    if (count > 64 && fstat(file, &facts) == 0 && S_ISREG(facts.st_mode)) usleep(50000);
}

ssize_t write(int file, const void *bytes, size_t count) {
    static ssize_t (*real)(int, const void *, size_t);
    if (!real) real = (ssize_t (*)(int, const void *, size_t))dlsym(RTLD_NEXT, "write");
    wait_for(file, count);
    return real(file, bytes, count);
}

ssize_t pwrite64(int file, const void *bytes, size_t count, off_t at) {
    static ssize_t (*real)(int, const void *, size_t, off_t);
    if (!real) real = (ssize_t (*)(int, const void *, size_t, off_t))dlsym(RTLD_NEXT, "pwrite64");
    wait_for(file, count);
    return real(file, bytes, count, at);
}
"#;

/// Compiles a library that comes before all others.
fn library(folder: &Path, code: &str) -> PathBuf {
    let (source, library) = (folder.join("library.c"), folder.join("library.so"));
    std::fs::write(&source, code).unwrap();
    let compiled =
        Command::new("cc").args(["-shared", "-fPIC", "-o"]).arg(&library).arg(&source).arg("-ldl").status();
    assert!(compiled.unwrap().success());
    library
}

#[test]
fn a_slow_disk_holds_up_writers_and_not_samplers_and_loses_nothing() {
    let dir = TempDir::new().unwrap();
    let library = library(dir.path(), SLOW_WRITES);
    let store = dir.path().join("store");
    let (mut child, endpoint) = start_with(&store, Some(&library));
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let acknowledged = Arc::new(AtomicU64::new(0));
    let writing = runtime.spawn(write(endpoint.clone(), 1, acknowledged.clone()));
    let mut source = sampler(&endpoint, &runtime);
    let started = Instant::now();
    let (mut minibatches, mut steps, mut last) = (0, 0, 0);
    while steps < 20 {
        assert!(started.elapsed() < PATIENCE, "{last} segments acknowledged, {minibatches} minibatches");
        minibatches += u64::from(source.poll(Duration::from_millis(5)).unwrap().is_some());
        let now = acknowledged.load(Ordering::SeqCst);
        steps += u64::from(now > last);
        last = now;
    }
    // Twenty writes of a twentieth of a second: the disk is slow, segments share commits, and samples come all the while.
    assert!(last > 2 * steps, "{last} segments were acknowledged in {steps} steps");
    assert!(minibatches > 5 * steps, "{minibatches} minibatches in {steps} steps");
    child.kill();
    runtime.block_on(writing).unwrap();
    let store = open(&store, &spec(STEPS), &config()).unwrap();
    assert!(store.introduce(1, "actor") >= acknowledged.load(Ordering::SeqCst));
}

/// Says on stderr which files and folders are synced.
const TOLD_SYNCS: &str = r#"
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdio.h>
#include <unistd.h>

static void tell(int file) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, path, sizeof path);
    if (length > 0) dprintf(2, "synced %.*s\n", (int)length, path);
}

int fsync(int file) {
    static int (*real)(int);
    if (!real) real = (int (*)(int))dlsym(RTLD_NEXT, "fsync");
    tell(file);
    return real(file);
}

int fdatasync(int file) {
    static int (*real)(int);
    if (!real) real = (int (*)(int))dlsym(RTLD_NEXT, "fdatasync");
    tell(file);
    return real(file);
}
"#;
const OPENED: &str = "the store is open\n";
const ACKNOWLEDGED: &str = "the segment is acknowledged\n";

/// The process whose syncs are told: without its variable there is nothing to prove here.
#[test]
fn opens_appends_to_and_copies_a_store_that_syncs() {
    let Some(dir) = std::env::var_os(DIR) else { return };
    let dir = Path::new(&dir);
    let synced = ReplayConfig { sync: SyncMode::Data, ..config() };
    let store = open(dir, &spec(STEPS), &synced).unwrap();
    eprint!("{OPENED}");
    store.append(vec![segment(&spec(STEPS), 1, 2, STEPS)]).unwrap();
    eprint!("{ACKNOWLEDGED}");
    store.snapshot(&dir.join("snapshots/copy")).unwrap();
}

#[test]
fn with_sync_data_all_reaches_the_disk_before_it_counts_what_is_read_back_acknowledged_and_copied() {
    let folder = TempDir::new().unwrap();
    let library = library(folder.path(), TOLD_SYNCS);
    let dir = folder.path().canonicalize().unwrap().join("store");
    // By a process that did not sync.
    let store = open(&dir, &spec(STEPS), &config()).unwrap();
    store.append(vec![segment(&spec(STEPS), 1, 1, STEPS)]).unwrap();
    drop(store);
    let output = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "kill::opens_appends_to_and_copies_a_store_that_syncs", "--nocapture"])
        .env(DIR, &dir)
        .env("LD_PRELOAD", &library)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let (opening, rest) = said.split_once(OPENED).unwrap();
    let (appending, copying) = rest.split_once(ACKNOWLEDGED).unwrap();
    let newest = "segments/00000000000000000000.seg";
    let copied = "snapshots/.copy.unfinished";
    for (said, name) in [
        (opening, newest.to_owned()),
        (opening, "segments".to_owned()),
        (appending, newest.to_owned()),
        (copying, format!("{copied}/{newest}")),
        (copying, format!("{copied}/segments")),
        (copying, format!("{copied}/watermark")),
        (copying, "snapshots".to_owned()),
    ] {
        let line = format!("synced {}\n", dir.join(&name).display());
        assert!(said.contains(&line), "{name} is not synced:\n{said}");
    }
}

fn sampler(endpoint: &str, runtime: &tokio::runtime::Runtime) -> RemoteSource {
    let options = RemoteOptions {
        spec: spec(STEPS),
        sample: common::options(32),
        name: "learner".to_owned(),
        table: String::new(),
        prefetch: 2,
    };
    RemoteSource::new(endpoint, options, runtime.handle(), Waits::new(&Registry::new()), Shutdown::new())
}
