//! Looking at stores, mending, compacting and copying them.

use crate::common::{Replay, config, eventually, open, options};
use crate::fixtures::{Ending, Part, segment, spec};
use getup_proto::Segment;
use getup_replay::{ReplayConfig, Survey, compact, repair, segments, take_snapshot};
use proptest::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use tempfile::TempDir;
use tonic::Code;

const STEPS: usize = 8;

/// A closed store of `count` segments of writer 1 in several files, and those segments that it still holds.
fn written(dir: &Path, capacity: usize, count: u64) -> Vec<Segment> {
    let store = open(dir, &spec(STEPS), &ReplayConfig { capacity, ..config() }).unwrap();
    for sequence in 1..=count {
        store.append(vec![segment(&spec(STEPS), 1, sequence, STEPS)]).unwrap();
    }
    drop(store);
    read(dir)
}

fn read(dir: &Path) -> Vec<Segment> {
    segments(dir).unwrap().1.map(Result::unwrap).collect()
}

fn files(dir: &Path) -> Vec<PathBuf> {
    let mut files: Vec<_> =
        fs::read_dir(dir.join("segments")).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

#[test]
fn a_survey_counts_what_is_there_and_what_ever_was() {
    let dir = TempDir::new().unwrap();
    let held = written(dir.path(), 256, 400).len() as u64;
    let survey = Survey::read(dir.path(), |_| {}).unwrap();
    assert_eq!(survey.damages, [""; 0]);
    assert_eq!((survey.segments, survey.transitions), (held, held * STEPS as u64));
    assert_eq!((survey.ever.segments, survey.ever.transitions), (400, 3200));
    assert_eq!(survey.value_bytes, held * (9 * 3 + 8 * 2 + 8 + 1) * 4);
    assert_eq!((survey.writers.len(), survey.writers[0].sequence), (1, 400));
    // sled's files are a megabyte or so, however little is in them.
    assert!((survey.value_bytes..(4 << 20)).contains(&survey.disk_bytes), "{survey:?}");
    assert_eq!(survey.files, files(dir.path()).len());

    let nothing = Survey::read(&dir.path().join("segments"), |_| {}).unwrap_err().to_string();
    assert!(nothing.contains("no replay store") && nothing.contains("store.json"), "{nothing}");
    let nowhere = dir.path().join("nowhere");
    let nothing = repair(&nowhere).unwrap_err().to_string();
    assert!(nothing.contains("no replay store"), "{nothing}");
    assert!(!nowhere.exists() && !dir.path().join("segments/lock").exists(), "looking leaves nothing behind");
}

#[test]
fn a_store_in_use_can_be_looked_at_and_not_mended() {
    let dir = TempDir::new().unwrap();
    let store = open(dir.path(), &spec(STEPS), &config()).unwrap();
    store.append(vec![segment(&spec(STEPS), 1, 1, STEPS)]).unwrap();
    assert_eq!(Survey::read(dir.path(), |_| {}).unwrap().segments, 1);
    assert_eq!(read(dir.path()).len(), 1);
    for refused in [repair(dir.path()).unwrap_err(), compact(dir.path(), None).unwrap_err()] {
        assert!(refused.to_string().contains("in use by another process"), "{refused}");
    }
    store.append(vec![segment(&spec(STEPS), 1, 2, STEPS)]).unwrap();
    assert_eq!(store.len(), 2 * STEPS);
}

#[test]
fn repair_leaves_a_whole_store_alone() {
    let dir = TempDir::new().unwrap();
    let held = written(dir.path(), 256, 100);
    let before = files(dir.path());
    let repaired = repair(dir.path()).unwrap();
    assert_eq!((repaired.old, repaired.segments), (None, held.len() as u64));
    assert_eq!(files(dir.path()), before);
}

#[test]
fn repair_mends_a_lost_index_and_a_lost_watermark() {
    for lost in ["index", "watermark"] {
        let dir = TempDir::new().unwrap();
        let held = written(dir.path(), 256, 100);
        let path = dir.path().join(lost);
        if path.is_dir() {
            fs::remove_dir_all(path).unwrap()
        } else {
            fs::remove_file(path).unwrap()
        }
        let settings = ReplayConfig { capacity: 256, ..config() };
        let refused = open(dir.path(), &spec(STEPS), &settings).unwrap_err().to_string();
        assert!(refused.contains("damaged") && refused.contains(lost), "{refused}");
        let repaired = repair(dir.path()).unwrap();
        assert!(repaired.found.damages[0].contains(lost), "{repaired:?}");
        assert_eq!(read(dir.path()), held);
        let store = open(dir.path(), &spec(STEPS), &settings).unwrap();
        assert_eq!((store.counters().transitions, store.introduce(1, "actor")), (800, 100));
    }
}

/// What a start refuses with `named` is mended, with at least so many of its segments and the totals over its life.
fn is_refused_and_mended(dir: &Path, named: &str, kept: usize, transitions: u64) {
    let settings = ReplayConfig { capacity: 256, ..config() };
    let refused = open(dir, &spec(STEPS), &settings).unwrap_err().to_string();
    assert!(refused.contains("damaged") && refused.contains(named), "{refused}");
    let damages = Survey::read(dir, |_| {}).unwrap().damages;
    assert!(damages.iter().any(|damage| damage.contains(named)), "{damages:?}");
    let repaired = repair(dir).unwrap();
    assert!(repaired.old.is_some() && repaired.segments >= kept as u64, "{repaired:?}");
    let survey = Survey::read(dir, |_| {}).unwrap();
    assert_eq!((survey.damages.as_slice(), survey.segments), ([].as_slice(), repaired.segments));
    let store = open(dir, &spec(STEPS), &settings).unwrap();
    let counters = store.counters();
    assert_eq!((counters.env_steps, counters.transitions), (transitions, transitions));
    store.append(vec![segment(&spec(STEPS), 1, 1_000, STEPS)]).unwrap();
    assert_eq!(store.counters().transitions, transitions + STEPS as u64);
}

#[test]
fn a_store_whose_oldest_file_is_missing_is_damaged_and_can_be_mended() {
    // One that holds all that it ever stored, and one that has evicted most.
    for count in [20, 100] {
        let dir = TempDir::new().unwrap();
        let held = written(dir.path(), 256, count);
        fs::remove_file(&files(dir.path())[0]).unwrap();
        is_refused_and_mended(dir.path(), "should come before it", held.len() - 2, count * STEPS as u64);
        assert_eq!(read(dir.path())[..held.len() - 2], held[2..]);
    }
}

#[test]
fn a_file_under_another_files_name_is_damage_and_can_be_mended() {
    let dir = TempDir::new().unwrap();
    let held = written(dir.path(), 256, 20);
    let newest = files(dir.path()).pop().unwrap();
    fs::rename(&newest, newest.with_file_name("00000000000000000777.seg")).unwrap();
    is_refused_and_mended(
        dir.path(),
        "00000000000000000777.seg: it begins after 18 segments",
        held.len(),
        160,
    );
}

#[test]
fn repair_keeps_the_totals_of_what_was_evicted_and_of_what_is_lost() {
    let dir = TempDir::new().unwrap();
    let held = written(dir.path(), 256, 100);
    let oldest = &files(dir.path())[0];
    let mut bytes = fs::read(oldest).unwrap();
    bytes[..40].fill(0);
    fs::write(oldest, bytes).unwrap();
    is_refused_and_mended(dir.path(), "its header cannot be read", held.len(), 800);
    assert_eq!(read(dir.path())[..held.len()], held);

    // A file in the middle, of two segments.
    let dir = TempDir::new().unwrap();
    let held = written(dir.path(), 256, 100);
    fs::remove_file(&files(dir.path())[3]).unwrap();
    is_refused_and_mended(dir.path(), "what comes before has", held.len() - 2, 800);
}

#[test]
fn compacting_keeps_the_newest_the_totals_and_the_marks() {
    let dir = TempDir::new().unwrap();
    let settings = ReplayConfig { capacity: 10_000, ..config() };
    let store = open(dir.path(), &spec(STEPS), &settings).unwrap();
    store.append(vec![segment(&spec(STEPS), 77, 5, STEPS)]).unwrap();
    let mut draws = ChaCha8Rng::seed_from_u64(1);
    for sequence in 1..=200 {
        store.append(vec![segment(&spec(STEPS), 1, sequence, STEPS)]).unwrap();
    }
    store.try_sample(&mut draws, &options(32)).unwrap().unwrap();
    let counters = store.counters();
    drop(store);
    let all = read(dir.path());
    let compacted = compact(dir.path(), Some(100)).unwrap();
    // Whole segments: 13 of 8 steps hold a hundred.
    assert_eq!((compacted.segments, compacted.transitions), (13, 104));
    assert_eq!(read(dir.path()), all[all.len() - 13..]);
    let store = open(dir.path(), &spec(STEPS), &settings).unwrap();
    let after = store.counters();
    assert_eq!((after.transitions, after.sampled, store.len()), (counters.transitions, 32, 104));
    assert_eq!((store.introduce(77, "actor"), store.introduce(1, "actor")), (5, 200));
    drop(store);

    assert_eq!(compact(dir.path(), Some(0)).unwrap().segments, 0);
    let store = open(dir.path(), &spec(STEPS), &settings).unwrap();
    assert_eq!((store.counters().transitions, store.len()), (counters.transitions, 0));
    assert_eq!((store.introduce(77, "actor"), store.introduce(1, "actor")), (5, 200));
    // Nothing to sample, whatever the totals say.
    assert!(store.try_sample(&mut draws, &options(32)).unwrap().is_none());
    store.append(vec![segment(&spec(STEPS), 1, 201, STEPS)]).unwrap();
    assert_eq!(store.len(), STEPS);
    store.try_sample(&mut draws, &options(32)).unwrap().unwrap();
}

#[test]
fn a_snapshot_of_a_store_under_load_is_a_store_of_one_moment() {
    let replay = Replay::start(spec(STEPS), &ReplayConfig { capacity: 2_000, ..config() });
    let stop = Arc::new(AtomicBool::new(false));
    let writing = std::thread::spawn({
        let (store, stop) = (replay.store.clone(), stop.clone());
        move || {
            for sequence in 1.. {
                store.append(vec![segment(&spec(STEPS), 1, sequence, STEPS)]).unwrap();
                if stop.load(Ordering::SeqCst) {
                    return;
                }
            }
        }
    });
    eventually("the store evicts", || replay.store.counters().transitions > 3_000);
    let mut taken = Vec::new();
    for name in ["first", "second", "third"] {
        let before = replay.store.counters().transitions;
        let reply = replay.runtime.block_on(take_snapshot(&replay.endpoint, "", name)).unwrap();
        let counters = reply.counters.unwrap();
        assert!((before..=replay.store.counters().transitions).contains(&counters.transitions));
        assert_ne!(counters.transitions, 0);
        taken.push((PathBuf::from(reply.path), counters));
        eventually("more was appended", || replay.store.counters().transitions > counters.transitions + 500);
    }
    let refused =
        |name: &str| replay.runtime.block_on(take_snapshot(&replay.endpoint, "", name)).unwrap_err();
    for (name, code) in
        [("first", Code::FailedPrecondition), ("", Code::InvalidArgument), ("../up", Code::InvalidArgument)]
    {
        assert_eq!(refused(name).code(), code, "{name}");
    }
    stop.store(true, Ordering::SeqCst);
    writing.join().unwrap();
    for (path, counters) in taken {
        // Untouched by what was appended and evicted since.
        let survey = Survey::read(&path, |_| {}).unwrap();
        assert_eq!(
            (survey.damages.as_slice(), survey.ever.transitions),
            ([].as_slice(), counters.transitions)
        );
        let sequences: Vec<u64> = read(&path).iter().map(|segment| segment.sequence).collect();
        let newest = counters.transitions / STEPS as u64;
        assert_eq!(sequences, (sequences[0]..=newest).collect::<Vec<_>>());
        assert!(sequences.len() * STEPS >= 2_000);
        let store = open(&path, &spec(STEPS), &ReplayConfig { capacity: 2_000, ..config() }).unwrap();
        assert_eq!(
            (store.counters().transitions, store.introduce(1, "actor")),
            (counters.transitions, newest)
        );
        // A learner that is restored with it goes on counting where it was.
        assert_eq!(store.counters().store, replay.store.counters().store);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(if std::env::var_os("GETUP_TEST_FULL").is_some() { 300 } else { 24 }))]

    /// Power loss and bad disks: a file is cut or overwritten anywhere.
    #[test]
    fn repair_keeps_every_segment_that_the_damage_did_not_touch(
        damages in prop::collection::vec((any::<prop::sample::Index>(), 0.0f64..1.0, 1usize..600, 0..3), 1..4),
    ) {
        let dir = TempDir::new().unwrap();
        let held = written(dir.path(), 512, 120);
        let mut touched = 0;
        for (file, place, length, kind) in damages {
            let files = files(dir.path());
            let path = &files[file.index(files.len())];
            let mut bytes = fs::read(path).unwrap();
            let from = (place * bytes.len() as f64) as usize;
            let to = (from + length).min(bytes.len());
            match kind {
                0 => bytes[from..to].fill(0),
                1 => bytes[from..to].iter_mut().for_each(|byte| *byte ^= 0x55),
                _ => bytes.truncate(from),
            }
            // A record has more than 200 bytes; a cut takes all that follow.
            touched += if kind == 2 { 5 } else { 2 + length / 200 };
            fs::write(path, bytes).unwrap();
        }
        let settings = ReplayConfig { capacity: 512, ..config() };
        let opened = open(dir.path(), &spec(STEPS), &settings).map(|store| store.len());
        let repaired = repair(dir.path()).unwrap();
        match opened {
            Ok(_) => prop_assert_eq!(repaired.old, None),
            Err(_) => prop_assert!(!repaired.found.damages.is_empty() && repaired.old.is_some()),
        }
        let kept = read(dir.path());
        prop_assert!(kept.len() + touched >= held.len(), "{} of {} kept", kept.len(), held.len());
        // What is kept was there, in its order and once.
        let mut rest = held.iter();
        prop_assert!(kept.iter().all(|segment| rest.any(|other| other == segment)));
        // And the store goes on.
        let store = open(dir.path(), &spec(STEPS), &settings).unwrap();
        store.append(vec![segment(&spec(STEPS), 1, 121, STEPS)]).unwrap();
        prop_assert_eq!(store.introduce(1, "actor"), 121);
        prop_assert_eq!(Survey::read(dir.path(), |_| {}).unwrap().damages, Vec::<String>::new());
    }
}

#[test]
fn an_episode_is_whole_in_the_order_of_the_log() {
    let dir = TempDir::new().unwrap();
    let store = open(dir.path(), &spec(STEPS), &config()).unwrap();
    let part = |lane, first_step, ending, sequence| {
        Part { writer: 1, sequence, lane, episode: 0, first_step, steps: STEPS, ending }.build(&spec(STEPS))
    };
    let parts = vec![
        part(0, 0, Ending::None, 1),
        part(1, 0, Ending::None, 2),
        part(0, 8, Ending::Terminal, 3),
        part(1, 8, Ending::Truncated, 4),
    ];
    store.append(parts.clone()).unwrap();
    drop(store);
    assert_eq!(read(dir.path()), parts);
}

#[test]
fn a_snapshot_and_its_original_go_their_own_ways_also_where_the_newest_file_was_full() {
    let dir = TempDir::new().unwrap();
    // Two segments fill a file.
    let settings = ReplayConfig { capacity: 256, ..config() };
    let append = |dir: &Path, sequence| {
        let store = open(dir, &spec(STEPS), &settings).unwrap();
        store.append(vec![segment(&spec(STEPS), 1, sequence, STEPS)]).unwrap();
    };
    let copy = dir.path().join("copy");
    let store = open(dir.path(), &spec(STEPS), &settings).unwrap();
    store.append((1..=4).map(|i| segment(&spec(STEPS), 1, i, STEPS)).collect()).unwrap();
    store.snapshot(&copy).unwrap();
    let again = store.snapshot(&copy).unwrap_err().to_string();
    assert!(again.contains("there is a snapshot"), "{again}");
    drop(store);
    for sequence in 5..=9 {
        append(&copy, sequence);
    }
    for sequence in 5..=6 {
        append(dir.path(), sequence);
    }
    let sequences = |dir: &Path| read(dir).iter().map(|segment| segment.sequence).collect::<Vec<_>>();
    assert_eq!((sequences(dir.path()), sequences(&copy)), ((1..=6).collect(), (1..=9).collect()));
    for dir in [dir.path(), &copy] {
        assert_eq!(Survey::read(dir, |_| {}).unwrap().damages, Vec::<String>::new());
    }
}

#[test]
fn a_rewriting_that_was_killed_halfway_is_finished_by_whoever_opens_the_store() {
    // Of the three pairs of renames, so many were made; and of the next, the first where `half`.
    for (moved, half) in [(0, false), (0, true), (1, false), (1, true), (2, false), (2, true), (3, false)] {
        let (dir, copy) = (TempDir::new().unwrap(), TempDir::new().unwrap());
        let held = written(dir.path(), 256, 100);
        let copied = copy.path().join("store");
        let cp = |from: &Path, to: &Path| {
            assert!(std::process::Command::new("cp").arg("-r").arg(from).arg(to).status().unwrap().success());
        };
        cp(dir.path(), &copied);
        compact(&copied, Some(64)).unwrap();
        let kept = read(&copied);
        let (rewriting, replaced) = (dir.path().join("rewriting"), dir.path().join("replaced"));
        cp(&copied, &rewriting);
        fs::write(rewriting.join("complete"), "").unwrap();
        fs::create_dir(&replaced).unwrap();
        let names = ["segments", "index", "watermark"];
        for (place, name) in names.iter().enumerate().take(moved + usize::from(half)) {
            fs::rename(dir.path().join(name), replaced.join(name)).unwrap();
            if place < moved {
                fs::rename(rewriting.join(name), dir.path().join(name)).unwrap();
            }
        }
        let store = open(dir.path(), &spec(STEPS), &ReplayConfig { capacity: 256, ..config() }).unwrap();
        assert_eq!((store.counters().transitions, store.introduce(1, "actor")), (800, 100), "{moved} {half}");
        drop(store);
        assert_eq!(read(dir.path()), kept, "{moved} {half}");
        assert!(kept.len() < held.len());
        assert!(!rewriting.exists() && !replaced.exists());
    }
}
