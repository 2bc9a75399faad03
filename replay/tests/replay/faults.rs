//! Peers and disks that fail: back-pressure, a clear word, and nothing lost that was acknowledged.

use crate::common::{self, PATIENCE, Replay, Writer, config, eventually, hello, open, options, skip};
use crate::fixtures::{get_up_spec, segment, spec};
use getup_proto::v1;
use getup_replay::{MinibatchSource, ReplayConfig, Survey};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;
use tempfile::TempDir;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

const STEPS: usize = 64;

/// A small file system in memory, unmounted when dropped. None where this process may not mount.
struct SmallDisk(TempDir);

impl SmallDisk {
    fn new(bytes: usize) -> Option<Self> {
        let dir = TempDir::new().unwrap();
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", &format!("size={bytes}"), "tmpfs"])
            .arg(dir.path())
            .output();
        mounted.is_ok_and(|output| output.status.success()).then_some(Self(dir))
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("--lazy").arg(self.0.path()).status();
    }
}

#[test]
fn a_full_disk_holds_writers_up_and_loses_nothing() {
    let Some(disk) = SmallDisk::new(6 << 20) else {
        return skip("a full disk: this process may not mount a file system");
    };
    let ballast = disk.0.path().join("ballast");
    fs::write(&ballast, vec![1; 2 << 20]).unwrap();
    let dir = disk.0.path().join("replay");
    let settings = ReplayConfig { capacity: 1_000_000, ..config() };
    let replay = Replay::start_in(&dir, get_up_spec(), &settings);
    let mut writer = replay.writer(1);
    let spec = replay.spec.clone();
    // Four megabytes do not hold 200 segments of 23 KB, and six do.
    let sending = replay.runtime.spawn(async move {
        for sequence in 1..=200 {
            writer.send(&segment(&spec, 1, sequence, STEPS)).await.unwrap();
        }
        writer.acknowledged(200).await.unwrap();
    });
    eventually("the disk is full, and it says so", || {
        let waiting = replay.waiting();
        waiting.contains("No space left") && waiting.contains("Make room on its disk")
    });
    let stored = replay.store.counters().transitions;
    assert!((64 * 60..64 * 200).contains(&stored), "{stored}");
    // Whoever samples notices nothing.
    let mut source = replay.source(options(32), 4);
    for _ in 0..20 {
        source.next().unwrap();
    }
    assert!(!sending.is_finished());
    fs::remove_file(&ballast).unwrap();
    replay.runtime.block_on(async { tokio::time::timeout(PATIENCE, sending).await }).unwrap().unwrap();
    assert_eq!(replay.store.counters().transitions, 200 * STEPS as u64);
    let (ended, _) = replay.stop();
    ended.unwrap();
    assert_eq!(Survey::read(&dir, |_| {}).unwrap().damages, Vec::<String>::new());
    let store = open(&dir, &get_up_spec(), &settings).unwrap();
    assert_eq!((store.len(), store.introduce(1, "actor")), (200 * STEPS, 200));
}

#[test]
fn a_full_disk_does_not_hold_up_the_end_and_keeps_what_was_acknowledged() {
    let Some(disk) = SmallDisk::new(2 << 20) else {
        return skip("a full disk: this process may not mount a file system");
    };
    let dir = disk.0.path().join("replay");
    let replay = Replay::start_in(&dir, get_up_spec(), &config());
    let mut writer = replay.writer(1);
    let spec = replay.spec.clone();
    let durable = replay.runtime.spawn(async move {
        // However many are written at once later: one is there before the disk is full.
        writer.send(&segment(&spec, 1, 1, STEPS)).await.unwrap();
        writer.acknowledged(1).await.unwrap();
        let mut durable = 1;
        for sequence in 2..=100 {
            if writer.send(&segment(&spec, 1, sequence, STEPS)).await.is_err() {
                break;
            }
        }
        while let Ok(sequence) = common::next(&mut writer.replies).await {
            durable = sequence;
        }
        durable
    });
    eventually("the disk is full", || replay.waiting().contains("No space left"));
    replay.shutdown.trigger();
    let durable = replay.runtime.block_on(durable).unwrap();
    let (_, seconds) = replay.stop();
    assert!(seconds < Duration::from_secs(10), "{seconds:?}");
    assert!((1..100).contains(&durable), "{durable}");
    let survey = Survey::read(&dir, |_| {}).unwrap();
    assert_eq!(survey.damages, Vec::<String>::new());
    assert!(survey.segments >= durable);
}

#[test]
fn a_client_that_stops_reading_delays_nobody_and_costs_no_memory() {
    let replay = Replay::start(get_up_spec(), &config());
    replay.store.append((1..=100).map(|i| segment(&replay.spec, 1, i, STEPS)).collect()).unwrap();
    // Asks for four thousand million minibatches, and takes none.
    let hello = v1::SampleHello {
        spec: Some(replay.spec.to_wire()),
        batch: 256,
        n_step: 1,
        gamma: 0.9,
        seed: 1,
        name: "greedy".to_owned(),
        table: String::new(),
        segments: false,
    };
    let (requests, outbound) = mpsc::channel(4);
    for message in [v1::sample_request::Message::Hello(hello), v1::sample_request::Message::Credits(u32::MAX)]
    {
        requests.try_send(v1::SampleRequest { message: Some(message) }).unwrap();
    }
    let mut client = replay.client();
    let replies = replay.runtime.block_on(client.sample(ReceiverStream::new(outbound))).unwrap();
    let sampled = || replay.store.counters().sampled;
    eventually("its windows are full", || {
        let before = sampled();
        std::thread::sleep(Duration::from_millis(200));
        sampled() == before && before > 0
    });
    // What waits for it is some messages of 4 MB; a minibatch has 164 KB.
    assert!(sampled() / 256 < 400, "{} minibatches wait for it", sampled() / 256);
    let mut source = replay.source(options(64), 4);
    for _ in 0..50 {
        source.next().unwrap();
    }
    let mut writer = replay.writer(2);
    replay.runtime.block_on(async {
        writer.send(&segment(&replay.spec, 2, 1, STEPS)).await.unwrap();
        writer.acknowledged(1).await.unwrap();
    });
    drop(replies);
    let (ended, seconds) = replay.stop();
    ended.unwrap();
    assert!(seconds < Duration::from_secs(10), "{seconds:?}");
}

#[test]
fn a_writer_that_is_cut_off_in_the_middle_is_taken_up_where_it_was_durable() {
    let replay = Replay::start(get_up_spec(), &config());
    let mut next = 1;
    for round in 1..=20_u64 {
        let Writer { requests, replies, durable } = replay.writer(1);
        assert!(durable + 1 >= next, "segment {durable} of those up to {next}");
        next = durable + 1;
        replay.runtime.block_on(async {
            for sequence in next..next + 10 {
                let message = Some(common::message(&segment(&replay.spec, 1, sequence, STEPS)));
                let _ = requests.send(v1::AppendRequest { message, ..Default::default() }).await;
            }
            // Gone at another moment each time, with segments on their way.
            tokio::time::sleep(Duration::from_micros(150 * round)).await;
        });
        drop((requests, replies));
    }
    let mut writer = replay.writer(1);
    let last = writer.durable + 1;
    replay.runtime.block_on(async {
        writer.send(&segment(&replay.spec, 1, last, STEPS)).await.unwrap();
        writer.acknowledged(last).await.unwrap();
    });
    // Each once, without a gap.
    eventually("all are counted", || replay.store.counters().transitions == last * STEPS as u64);
    assert!(last > 20);
}

#[test]
fn a_stream_that_says_nothing_is_ended() {
    let replay = Replay::start(spec(8), &config());
    let mut client = replay.client();
    let status = replay.runtime.block_on(async {
        let (requests, outbound) = mpsc::channel::<v1::AppendRequest>(1);
        let answered = client.append(ReceiverStream::new(outbound)).await;
        drop(requests);
        answered.unwrap_err()
    });
    assert_eq!(status.code(), tonic::Code::DeadlineExceeded, "{status}");
    // And one that says hello may be silent.
    let said = replay.outcome(vec![hello(&replay.spec, 1)]);
    assert_eq!(said.unwrap(), 0);
}

/// A file of the store, cut to `bytes`.
fn cut(path: &Path, bytes: u64) {
    fs::File::options().write(true).open(path).unwrap().set_len(bytes).unwrap();
}

fn newest(dir: &Path) -> PathBuf {
    fs::read_dir(dir.join("segments")).unwrap().map(|entry| entry.unwrap().path()).max().unwrap()
}

/// What a power loss leaves of a store that syncs: all that was acknowledged, and any part of what was not.
#[test]
fn with_sync_data_any_cut_behind_the_acknowledged_is_harmless_and_without_it_a_cut_is_named() {
    use getup_replay::SyncMode;
    let settings = ReplayConfig { sync: SyncMode::Data, ..config() };
    let dir = TempDir::new().unwrap();
    let store = open(dir.path(), &get_up_spec(), &settings).unwrap();
    store.append((1..=5).map(|i| segment(&get_up_spec(), 1, i, STEPS)).collect()).unwrap();
    drop(store);
    let acknowledged = fs::metadata(newest(dir.path())).unwrap().len();
    let watermark = fs::read(dir.path().join("watermark")).unwrap();
    let store = open(dir.path(), &get_up_spec(), &settings).unwrap();
    store.append((6..=8).map(|i| segment(&get_up_spec(), 1, i, STEPS)).collect()).unwrap();
    drop(store);
    let all = fs::metadata(newest(dir.path())).unwrap().len();
    for share in [0.0, 0.1, 0.34, 0.5, 0.99] {
        let copy = TempDir::new().unwrap();
        let copied = copy.path().join("replay");
        assert!(Command::new("cp").arg("-r").arg(dir.path()).arg(&copied).status().unwrap().success());
        // The second commit was under way when the power went: its acknowledgement had not left.
        fs::write(copied.join("watermark"), &watermark).unwrap();
        cut(&newest(&copied), acknowledged + (share * (all - acknowledged) as f64) as u64);
        let store = open(&copied, &get_up_spec(), &settings).unwrap();
        assert!((5..8).contains(&store.introduce(1, "actor")), "at {share}");
        drop(store);
        // Under an acknowledgement that did leave, the same cut is damage, and can be mended.
        fs::write(copied.join("watermark"), fs::read(dir.path().join("watermark")).unwrap()).unwrap();
        cut(&newest(&copied), acknowledged + (share * (all - acknowledged) as f64) as u64);
        let refused = open(&copied, &get_up_spec(), &settings).unwrap_err().to_string();
        assert!(refused.contains("damaged") && refused.contains("replay repair"), "{refused}");
        let repaired = getup_replay::repair(&copied).unwrap();
        assert!((5..8).contains(&repaired.segments), "{repaired:?}");
        open(&copied, &get_up_spec(), &settings).unwrap();
    }
}

#[test]
fn a_writer_that_goes_while_the_limiter_holds_it_leaves_nothing_behind() {
    let paced =
        ReplayConfig { min_size: 8, samples_per_insert: Some(1.0), error_buffer: Some(16.0), ..config() };
    let replay = Replay::start(spec(8), &paced);
    let writer = replay.writer(1);
    for sequence in 1..=6 {
        replay.runtime.block_on(writer.send(&segment(&replay.spec, 1, sequence, 8))).unwrap();
    }
    eventually("it waits for a sampler", || replay.waiting().contains("writer"));
    drop(writer);
    eventually("nobody waits", || replay.waiting().is_empty());
}

#[test]
fn a_writer_that_reads_no_acknowledgement_holds_up_no_other() {
    let paced =
        ReplayConfig { min_size: 8, samples_per_insert: Some(1.0), error_buffer: Some(16.0), ..config() };
    let replay = Replay::start(spec(8), &paced);
    // Its window takes no acknowledgement, and a few wait for it at the service.
    let endpoint = tonic::transport::Endpoint::from_shared(format!("http://{}", replay.endpoint)).unwrap();
    let mut deaf = replay.runtime.block_on(async {
        let channel = endpoint.initial_stream_window_size(0).connect().await.unwrap();
        let (requests, outbound) = mpsc::channel(64);
        let request = |message| v1::AppendRequest { message: Some(message), ..Default::default() };
        requests.send(request(hello(&replay.spec, 1))).await.unwrap();
        for sequence in 1..=40 {
            let segment = common::message(&segment(&replay.spec, 1, sequence, 8));
            requests.send(request(segment)).await.unwrap();
        }
        let mut client = v1::replay_client::ReplayClient::new(channel);
        (client.append(ReceiverStream::new(outbound)).await.unwrap(), requests)
    });
    eventually("it waits for a sampler", || replay.waiting().contains("writer"));
    let mut writer = replay.writer(2);
    let mut source = replay.source(options(8), 1);
    let heard = replay.runtime.spawn({
        let segment = segment(&replay.spec, 2, 1, 8);
        async move {
            writer.send(&segment).await.unwrap();
            writer.acknowledged(1).await.unwrap();
        }
    });
    eventually("the other one is acknowledged", || {
        source.poll(Duration::from_millis(50)).unwrap();
        heard.is_finished()
    });
    replay.runtime.block_on(heard).unwrap();
    deaf.0.get_mut();
}
