use super::*;
use crate::fixtures;
use proptest::prelude::*;
use tempfile::TempDir;

fn config(capacity: usize) -> ReplayConfig {
    ReplayConfig { capacity, min_size: 1, ..ReplayConfig::default() }
}

/// Opens a log and collects what it hands on.
fn open(dir: &Path, spec: &RunSpec, capacity: usize) -> Result<(Log, Vec<Segment>), StoreError> {
    let mut segments = Vec::new();
    let log = Log::open(dir, spec, &config(capacity), |segment| segments.push(segment.clone()))?;
    Ok((log, segments))
}

/// A log of `count` commits of one segment each, closed.
fn written(dir: &Path, spec: &RunSpec, count: u64) -> Vec<Segment> {
    let (mut log, _) = open(dir, spec, 10_000).unwrap();
    let segments: Vec<_> = (1..=count).map(|sequence| fixtures::segment(spec, 1, sequence, 64)).collect();
    for segment in &segments {
        log.append(std::slice::from_ref(segment)).unwrap();
    }
    segments
}

#[test]
fn what_was_appended_is_there_after_a_restart_in_order_and_once() {
    let (dir, spec) = (TempDir::new().unwrap(), fixtures::get_up_spec());
    let segments = written(dir.path(), &spec, 30);
    let (mut log, found) = open(dir.path(), &spec, 10_000).unwrap();
    assert_eq!(found, segments);
    assert_eq!((log.state().segments, log.state().transitions, log.durable(1)), (30, 1920, 30));
    assert_eq!(log.append(&segments[10..]).unwrap(), [false; 20]);
    let (_, again) = {
        drop(log);
        open(dir.path(), &spec, 10_000).unwrap()
    };
    assert_eq!(again, segments);
}

#[test]
fn eviction_drops_the_oldest_keeps_the_capacity_and_forgets_no_writer() {
    let (dir, spec) = (TempDir::new().unwrap(), fixtures::spec(8));
    let (mut log, _) = open(dir.path(), &spec, 256).unwrap();
    log.append(&[fixtures::segment(&spec, 77, 5, 8)]).unwrap();
    for sequence in 1..=400 {
        log.append(&[fixtures::segment(&spec, 1, sequence, 8)]).unwrap();
    }
    assert!(log.files.len() <= 18, "{} files", log.files.len());
    // Both writers' first segments are long gone, and are not taken again.
    let again = vec![fixtures::segment(&spec, 77, 5, 8), fixtures::segment(&spec, 1, 1, 8)];
    assert_eq!(log.append(&again).unwrap(), [false; 2]);
    drop(log);
    let (mut log, found) = open(dir.path(), &spec, 256).unwrap();
    let held: usize = found.iter().map(|segment| segment.steps).sum();
    assert!((256..=256 + 32).contains(&held), "{held} transitions");
    assert_eq!(found.last().unwrap().sequence, 400);
    assert_eq!((log.durable(77), log.durable(1), log.state().segments), (5, 400, 401));
    assert_eq!(log.append(&again).unwrap(), [false; 2]);
}

#[test]
fn disk_space_stays_bounded_while_many_times_the_capacity_passes_through() {
    let (dir, spec) = (TempDir::new().unwrap(), fixtures::get_up_spec());
    let capacity = 16_384;
    let (mut log, _) = open(dir.path(), &spec, capacity).unwrap();
    let mut most = 0;
    for round in 0..160 {
        let group: Vec<_> = (1..=16).map(|i| fixtures::segment(&spec, 1, round * 16 + i, 64)).collect();
        log.append(&group).unwrap();
        most = most.max(disk_bytes(dir.path()));
    }
    let payload = (capacity * 90 * 4) as u64;
    assert!(most * 10 < 12 * payload, "{} MB for {} MB", most >> 20, payload >> 20);
}

#[test]
fn a_smaller_or_larger_capacity_takes_over_a_store() {
    let (dir, spec) = (TempDir::new().unwrap(), fixtures::spec(8));
    for (capacity, sequences) in [(512, 1..=100), (64, 101..=102), (64, 103..=130), (1024, 131..=200)] {
        let (mut log, _) = open(dir.path(), &spec, capacity).unwrap();
        for sequence in sequences {
            log.append(&[fixtures::segment(&spec, 1, sequence, 8)]).unwrap();
        }
    }
    let (log, found) = open(dir.path(), &spec, 1024).unwrap();
    assert_eq!(log.state().segments, 200);
    let sequences: Vec<_> = found.iter().map(|segment| segment.sequence).collect();
    assert_eq!(sequences, (sequences[0]..=200).collect::<Vec<_>>());
}

#[test]
fn another_run_another_format_and_a_second_process_are_refused_with_the_way_out() {
    let (dir, spec) = (TempDir::new().unwrap(), fixtures::spec(8));
    let (log, _) = open(dir.path(), &spec, 256).unwrap();
    let in_use = open(dir.path(), &spec, 256).unwrap_err().to_string();
    assert!(in_use.contains("in use by another process: end that one"), "{in_use}");
    drop(log);

    let mut other = spec.clone();
    other.run = "other".to_owned();
    let refused = open(dir.path(), &other, 256).unwrap_err().to_string();
    assert!(refused.contains("cannot be used here") && refused.contains("the run is `test`"), "{refused}");

    let manifest = dir.path().join("store.json");
    let text = fs::read_to_string(&manifest).unwrap().replace("\"format\": 2", "\"format\": 7");
    fs::write(&manifest, text).unwrap();
    let refused = open(dir.path(), &spec, 256).unwrap_err().to_string();
    assert!(refused.contains("has format 7") && refused.contains("move the folder away"), "{refused}");
}

#[test]
fn a_missing_or_damaged_small_file_is_named() {
    let spec = fixtures::spec(64);
    for content in [Some("short"), None] {
        let dir = TempDir::new().unwrap();
        written(dir.path(), &spec, 3);
        replace(&dir.path().join("watermark"), content);
        let refused = open(dir.path(), &spec, 256).unwrap_err().to_string();
        assert!(refused.contains("damaged") && refused.contains("watermark"), "{refused}");
        assert!(refused.contains("replay repair"), "{refused}");
    }
}

/// Gives a file other content, or removes it.
fn replace(file: &Path, content: Option<&str>) {
    match content {
        Some(content) => fs::write(file, content).unwrap(),
        None => fs::remove_file(file).unwrap(),
    }
}

#[test]
fn a_missing_or_damaged_manifest_is_named_and_a_snapshots_takes_its_place() {
    let spec = fixtures::spec(64);
    for content in [Some("{\"format\": 2"), Some("{}"), None] {
        let dir = TempDir::new().unwrap();
        let segments = written(dir.path(), &spec, 3);
        let snapshot = dir.path().join(SNAPSHOTS).join("nightly");
        let (log, _) = open(dir.path(), &spec, 10_000).unwrap();
        log.begin_snapshot(&snapshot).unwrap().finish(&spec).unwrap();
        let store = log.store();
        drop(log);
        let manifest = dir.path().join("store.json");
        replace(&manifest, content);
        let refused = open(dir.path(), &spec, 10_000).unwrap_err().to_string();
        assert!(refused.contains("store.json") && refused.contains("copy it from a snapshot"), "{refused}");
        assert!(!refused.contains("replay repair"), "it needs the file too: {refused}");
        fs::copy(snapshot.join("store.json"), &manifest).unwrap();
        let (log, found) = open(dir.path(), &spec, 10_000).unwrap();
        assert_eq!((log.store(), found), (store, segments));
    }
}

#[test]
fn a_snapshot_that_fails_leaves_nothing() {
    let (dir, spec) = (TempDir::new().unwrap(), fixtures::spec(8));
    let (mut log, _) = open(dir.path(), &spec, 256).unwrap();
    for sequence in 1..=30 {
        log.append(&[fixtures::segment(&spec, 1, sequence, 8)]).unwrap();
    }
    let snapshots = dir.path().join(SNAPSHOTS);
    // Something takes its name while it is put together.
    let taken = snapshots.join("taken");
    let begun = log.begin_snapshot(&taken).unwrap();
    fs::create_dir_all(taken.join("something")).unwrap();
    begun.finish(&spec).unwrap_err();
    // The second of the files cannot be linked.
    files::remove(dir.path(), log.files[1].first).unwrap();
    log.begin_snapshot(&snapshots.join("second")).unwrap_err();
    let left: Vec<_> = fs::read_dir(&snapshots).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(left, ["taken"]);
}

#[test]
fn what_a_killed_snapshot_or_rewriting_left_is_removed_when_the_store_is_opened() {
    let (dir, spec) = (TempDir::new().unwrap(), fixtures::spec(64));
    let segments = written(dir.path(), &spec, 3);
    let snapshots = dir.path().join(SNAPSHOTS);
    let left = [snapshots.join(".nightly.unfinished"), dir.path().join("rewriting")];
    let whole = snapshots.join("nightly");
    for folder in [&left[0], &left[1], &whole] {
        fs::create_dir_all(folder.join(files::FOLDER)).unwrap();
        fs::hard_link(files::path(dir.path(), 0), files::path(folder, 0)).unwrap();
    }
    let (_, found) = open(dir.path(), &spec, 10_000).unwrap();
    assert_eq!(found, segments);
    assert!(left.iter().all(|folder| !folder.exists()) && files::path(&whole, 0).exists());
}

#[test]
fn a_log_that_lost_what_it_acknowledged_is_refused() {
    let (dir, spec) = (TempDir::new().unwrap(), fixtures::spec(64));
    written(dir.path(), &spec, 20);
    for first in files::list(dir.path()).unwrap() {
        files::remove(dir.path(), first).unwrap();
    }
    let refused = open(dir.path(), &spec, 256).unwrap_err().to_string();
    assert!(refused.contains("acknowledged 20 segments and holds the first 0"), "{refused}");
    fs::remove_dir_all(dir.path().join(files::FOLDER)).unwrap();
    let refused = open(dir.path(), &spec, 256).unwrap_err().to_string();
    assert!(refused.contains("its folder `segments` is missing"), "{refused}");
}

#[test]
fn what_a_kill_cuts_off_is_dropped_and_what_was_acknowledged_is_not() {
    let (dir, spec) = (TempDir::new().unwrap(), fixtures::spec(64));
    let segments = written(dir.path(), &spec, 3);
    let path = files::path(dir.path(), 0);
    let whole = fs::read(&path).unwrap();
    let mut commit = Vec::new();
    for number in 3..6 {
        record::put_segment(&mut commit, number, &fixtures::segment(&spec, 1, number + 1, 64));
    }
    // Killed in the middle of a commit of three: none was acknowledged, and the whole ones may stay.
    for cut in [1, commit.len() / 2, commit.len() - 1] {
        fs::write(&path, [&whole, &commit[..cut]].concat()).unwrap();
        let (mut log, found) = open(dir.path(), &spec, 10_000).unwrap();
        assert_eq!(found[..3], segments);
        assert_eq!(found.len(), 3 + 3 * cut / commit.len());
        let next = found.len() as u64 + 1;
        assert_eq!(log.append(&[fixtures::segment(&spec, 1, next, 64)]).unwrap(), [true]);
        drop(log);
        let (_, again) = open(dir.path(), &spec, 10_000).unwrap();
        assert_eq!(again.len(), found.len() + 1);
        // The watermark has gone up with it: back to where it was.
        Watermark::open(dir.path()).unwrap().set_acknowledged(3).unwrap();
    }
    // The same cut in what was acknowledged is damage.
    fs::write(&path, &whole[..whole.len() - 1]).unwrap();
    let refused = open(dir.path(), &spec, 10_000).unwrap_err().to_string();
    assert!(refused.contains("damaged") && refused.contains("should be segment 2"), "{refused}");
}

#[test]
fn a_file_that_is_missing_in_the_middle_is_named() {
    let (dir, spec) = (TempDir::new().unwrap(), fixtures::spec(8));
    let (mut log, _) = open(dir.path(), &spec, 256).unwrap();
    for sequence in 1..=30 {
        log.append(&[fixtures::segment(&spec, 1, sequence, 8)]).unwrap();
    }
    let second = log.files[1].first;
    drop(log);
    fs::remove_file(files::path(dir.path(), second)).unwrap();
    let refused = open(dir.path(), &spec, 256).unwrap_err().to_string();
    assert!(refused.contains("damaged") && refused.contains("what comes before has"), "{refused}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(if std::env::var_os("GETUP_TEST_FULL").is_some() { 600 } else { 48 }))]

    #[test]
    fn damage_anywhere_in_the_stores_files_is_refused_or_harmless_and_never_a_panic(
        place in 0.0f64..1.0,
        length in 1usize..20_000,
        kind in 0..3,
        in_index in prop::bool::weighted(0.3),
    ) {
        let (dir, spec) = (TempDir::new().unwrap(), fixtures::spec(64));
        let (mut log, _) = open(dir.path(), &spec, 512).unwrap();
        for sequence in 1..=40 {
            log.append(&[fixtures::segment(&spec, 1, sequence, 64)]).unwrap();
        }
        drop(log);
        let (_, kept) = open(dir.path(), &spec, 512).unwrap();
        let folder = dir.path().join(if in_index { index::FOLDER } else { files::FOLDER });
        let paths = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
        let path = paths.filter(|path| path.is_file()).min_by_key(|path| (path.to_string_lossy().len() + length) % 7);
        let path: PathBuf = path.unwrap();
        let mut bytes = fs::read(&path).unwrap();
        let from = (place * bytes.len() as f64) as usize;
        let to = (from + length).min(bytes.len());
        match kind {
            0 => bytes[from..to].fill(0),
            1 => bytes[from..to].iter_mut().for_each(|byte| *byte ^= 0x55),
            _ => bytes.truncate(from),
        }
        fs::write(&path, bytes).unwrap();
        match open(dir.path(), &spec, 512) {
            // An index that lost its newest entries names an older first file, which is gone: that is refused. One
            // whose damage lies where nothing is written is harmless.
            Ok((_, found)) => prop_assert_eq!(found, kept),
            Err(error) => {
                let text = error.to_string();
                prop_assert!(text.contains("damaged") && text.contains("replay repair"), "{}", text);
            }
        }
    }
}
