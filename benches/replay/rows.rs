//! The rows: who takes turns with whom, and what is asked of both.

use std::hint::black_box;
use std::path::Path;
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use getup_proto::RunSpec;
use getup_replay::{SampleOptions, SyncMode, describe, take_snapshot};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::json;
use tokio::runtime::Runtime;

use crate::clients::{drain, insert, sample};
use crate::common::{Row, median};
use crate::reverb::Reverb;
use crate::services::{Service, open};
use crate::{FULL, TURN};

/// Pairs of turns of a row, and how long one lasts.
const TURNS: usize = 3;
/// Values of a transition in memory: observation, action, reward, β.
const VALUES: usize = 68 + 21 + 1 + 1;

pub(crate) fn insert_rows(runtime: &Runtime, peer: &mut Reverb, writers: u64) -> Result<Vec<Row>> {
    let [mut ours, mut theirs, mut ratios, mut synced] = [const { Vec::new() }; 4];
    let [mut our_times, mut their_times] = [const { Vec::<[f64; 2]>::new() }; 2];
    for turn in 0..TURNS {
        let mut our_turn = || -> Result<f64> {
            let (rate, times) = insert(runtime, writers, "process")?;
            our_times.push(times);
            Ok(rate)
        };
        let mut their_turn = || {
            let answer =
                peer.ask(&json!({"insert": {"writers": writers, "seconds": 2.0 * TURN.as_secs_f64()}}))?;
            their_times.push([answer.number("p50")?, answer.number("p99")?]);
            answer.number("per_second")
        };
        let (our, their) = in_turn(turn, &mut our_turn, &mut their_turn)?;
        ours.push(our);
        theirs.push(their);
        ratios.push(our / their);
        synced.push(insert(runtime, writers, "data")?.0);
    }
    let who = if writers == 1 { "1 writer".to_owned() } else { format!("{writers} writers") };
    let per_second = |name, ours, peer, ratio| row(name, "transitions/s", ours, peer, None, ratio);
    let mut rows = vec![
        per_second(format!("grpc insert, {who}"), median(ours), Some(median(theirs)), Some(median(ratios))),
        per_second(format!("grpc insert, synced, {who}"), median(synced), None, None),
    ];
    rows.extend(latency_rows(&format!("insert, {who}"), &our_times, &their_times));
    Ok(rows)
}

pub(crate) fn sample_rows(
    runtime: &Runtime,
    service: &Service,
    peer: &mut Reverb,
    batch: usize,
) -> Result<Vec<Row>> {
    let bare = Service::start(&["bare", &batch.to_string()])?;
    let spec = runtime.block_on(describe(&service.endpoint)).map_err(anyhow::Error::from)?.spec;
    let spec = RunSpec::parse(spec.context("a replay knows its spec")?)?;
    let [mut ours, mut theirs, mut limits, mut ratios, mut shares] = [const { Vec::new() }; 5];
    let [mut our_times, mut their_times] = [const { Vec::<[f64; 2]>::new() }; 2];
    for turn in 0..TURNS {
        let mut our_turn = || -> Result<f64> {
            let (rate, times) = sample(runtime, &service.endpoint, &spec, batch)?;
            our_times.push(times);
            Ok(rate)
        };
        let mut their_turn = || {
            let answer = peer.ask(&json!({"sample": {"batch": batch, "seconds": TURN.as_secs_f64()}}))?;
            their_times.push([answer.number("p50")?, answer.number("p99")?]);
            answer.number("per_second")
        };
        let (our, their) = in_turn(turn, &mut our_turn, &mut their_turn)?;
        let limit = drain(runtime, &bare.endpoint, batch)?;
        ours.push(our);
        theirs.push(their);
        limits.push(limit);
        ratios.push(our / their);
        shares.push(our / limit);
    }
    let name = format!("grpc sample, batch {batch}");
    let (peer, limit) = (Some(median(theirs)), Some(median(limits)));
    let mut rows = vec![row(name, "transitions/s", median(ours), peer, limit, Some(median(ratios)))];
    rows[0].share_of_limit = Some(median(shares));
    rows.extend(latency_rows(&format!("sample, batch {batch}"), &our_times, &their_times));
    Ok(rows)
}

fn latency_rows(name: &str, ours: &[[f64; 2]], theirs: &[[f64; 2]]) -> [Row; 2] {
    [0, 1].map(|place| {
        let milliseconds =
            |times: &[[f64; 2]]| median(times.iter().map(|times| 1e3 * times[place]).collect());
        let percentile = ["p50", "p99"][place];
        let (ours, theirs) = (milliseconds(ours), Some(milliseconds(theirs)));
        row(format!("{name}, latency {percentile}"), "ms (less is better)", ours, theirs, None, None)
    })
}

pub(crate) fn memory_row(runtime: &Runtime, service: &Service, peer: &mut Reverb) -> Result<Row> {
    let described = runtime.block_on(describe(&service.endpoint)).map_err(anyhow::Error::from)?;
    ensure!(described.size > FULL as u64 - 1000, "the store holds {} transitions", described.size);
    let theirs = peer.ask(&json!({"memory": {"transitions": FULL}}))?.number("bytes")?;
    let raw = (4 * (VALUES - 1) * FULL) as f64;
    let mut row = row(
        "resident memory, 1 M transitions".to_owned(),
        "MB (less is better)",
        service.resident()? as f64 / 1e6,
        Some(theirs / 1e6),
        Some(1.4 * raw / 1e6),
        None,
    );
    row.share_of_limit = row.limit.map(|limit| row.ours / limit);
    Ok(row)
}

/// How long appends wait for a snapshot: the longest of several.
pub(crate) fn snapshot_row(runtime: &Runtime, service: &Service) -> Result<Row> {
    let mut longest: f64 = 0.0;
    for n in 0..10 {
        let taken = runtime.block_on(take_snapshot(&service.endpoint, "", &format!("bench-{n}")));
        longest = longest.max(1e3 * taken.map_err(anyhow::Error::from)?.paused_seconds);
    }
    let name = "snapshot, 1 M transitions, longest pause".to_owned();
    Ok(row(name, "ms (less is better)", longest, None, None, None))
}

pub(crate) fn restart_row(runtime: &Runtime, dir: &Path, peer: &mut Reverb) -> Result<Row> {
    let mut times = Vec::new();
    for _ in 0..TURNS {
        let started = Instant::now();
        // Says where it listens once its ring is there.
        let service = Service::start(&["serve", &dir.display().to_string(), "process"])?;
        let described = runtime.block_on(describe(&service.endpoint)).map_err(anyhow::Error::from)?;
        times.push(started.elapsed().as_secs_f64());
        ensure!(described.size > FULL as u64 - 1000, "the store holds {} transitions", described.size);
    }
    peer.ask(&json!({"memory": {"transitions": FULL}}))?;
    let theirs = peer.ask(&json!({"restart": {}}))?.number("seconds")?;
    let mut row = row(
        "restart, 1 M transitions".to_owned(),
        "s (less is better)",
        median(times),
        Some(theirs),
        Some(5.0),
        None,
    );
    row.share_of_limit = row.limit.map(|limit| row.ours / limit);
    Ok(row)
}

pub(crate) fn in_process_row(dir: &Path) -> Result<Row> {
    const BATCH: usize = 256;
    let store = open(dir, SyncMode::Process)?;
    let options = SampleOptions { batch: BATCH, n_step: 1, gamma: 0.97, seed: 1, segments: false };
    let mut draws = ChaCha8Rng::seed_from_u64(1);
    let flat = vec![0.5f32; FULL * VALUES];
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    // Places of the columns in a row, and once more the observation: the one that follows.
    let columns = [(0, 68), (68, 21), (89, 1), (90, 1), (VALUES, 68)];
    let [mut ours, mut limits, mut shares] = [const { Vec::new() }; 3];
    for turn in 0..2 * TURNS {
        let mut our_turn = || {
            per_second(BATCH, || {
                black_box(store.try_sample(&mut draws, &options)?.context("the store has transitions")?);
                Ok(())
            })
        };
        let mut their_turn = || {
            per_second(BATCH, || {
                let places: Vec<usize> = (0..BATCH).map(|_| rng.random_range(0..FULL - 1) * VALUES).collect();
                for (from, width) in columns {
                    let mut column = Vec::with_capacity(BATCH * width);
                    places.iter().for_each(|place| column.extend_from_slice(&flat[place + from..][..width]));
                    black_box(column);
                }
                Ok(())
            })
        };
        let (our, limit) = in_turn(turn, &mut our_turn, &mut their_turn)?;
        ours.push(our);
        limits.push(limit);
        shares.push(our / limit);
    }
    let mut row =
        row("in-process sample".to_owned(), "transitions/s", median(ours), None, Some(median(limits)), None);
    row.share_of_limit = Some(median(shares));
    Ok(row)
}

fn row(
    name: String,
    unit: &str,
    ours: f64,
    peer: Option<f64>,
    limit: Option<f64>,
    ratio_to_peer: Option<f64>,
) -> Row {
    Row { name, unit: unit.to_owned(), ours, peer, limit, ratio_to_peer, share_of_limit: None }
}

/// Whoever goes second finds the caches warm: both do in turn.
fn in_turn(
    turn: usize,
    ours: &mut dyn FnMut() -> Result<f64>,
    theirs: &mut dyn FnMut() -> Result<f64>,
) -> Result<(f64, f64)> {
    if turn.is_multiple_of(2) {
        let our = ours()?;
        Ok((our, theirs()?))
    } else {
        let their = theirs()?;
        Ok((ours()?, their))
    }
}

fn per_second(batch: usize, mut work: impl FnMut() -> Result<()>) -> Result<f64> {
    let started = Instant::now();
    let mut transitions = 0;
    while started.elapsed() < TURN / 4 {
        work()?;
        transitions += batch;
    }
    Ok(transitions as f64 / started.elapsed().as_secs_f64())
}
