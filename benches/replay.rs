//! The replay service beside DeepMind Reverb's, and beside what the network and the memory allow.
//!
//! Transitions of the get-up task: 68 numbers of observation, 21 of action, a reward and β, in segments of 64 steps (the
//! last of an episode shorter) of episodes of 250. Both services are processes of their own, on loopback, and their
//! clients use both cores with them.
//!
//! | row | ours | peer | limit |
//! | --- | --- | --- | --- |
//! | `grpc insert` | transitions a second, acknowledged, as an actor appends them: 16 segments at a time; durable against a kill | Reverb's best in the committed sweep, in its memory | |
//! | `grpc insert, synced` | the same with `replay.sync = "data"`: durable against a power loss | | |
//! | `grpc sample` | transitions a second of a [`RemoteSource`], 16 minibatches ahead | Reverb's best, through tf.data | a bare tonic stream of equal messages, parsed no further |
//! | `in-process sample` | transitions a second of `Store::try_sample`, batch 256 | | a bare gather of as many rows at random places of a flat array |
//! | `… latency` | seconds: p50 and p99 until 64 steps are acknowledged, nothing else on its way; of a minibatch at full speed | the same of Reverb | |
//! | `resident memory`, `restart` | at a million transitions | the same of Reverb | 1.4 × the raw bytes; 5 s |
//! | `snapshot` | the longest pause of appends | | |
//!
//! Both sides take turns; ratios and shares are medians over them. `benches/replay_reverb.py` is the peer, and says how
//! it is treated fairly.

mod common;
#[path = "../replay/tests/fixtures/mod.rs"]
mod fixtures;

use std::hint::black_box;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::pin::Pin;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use common::{Peer, Row, median, report};
use fixtures::{Ending, Part};
use getup_actor::link::SegmentWriter;
use getup_actor::{GrpcReplay, Identity};
use getup_proto::v1::replay_server::{Replay, ReplayServer};
use getup_proto::{MAX_MESSAGE_BYTES, RunSpec, Segment, v1};
use getup_replay::{
    MinibatchSource, RemoteOptions, RemoteSource, ReplayConfig, ReplayMetrics, SampleOptions, Sampler, Store,
    SyncMode, describe, serve, take_snapshot,
};
use getup_telemetry::{Registry, Shutdown, Waits};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tokio_stream::Stream;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Request, Response, Status, Streaming};

/// Pairs of turns of a row, and how long one lasts.
const TURNS: usize = 3;
const TURN: Duration = Duration::from_secs(4);
/// Transitions of a full store.
const FULL: usize = 1_000_000;
const STEPS: usize = 64;
const EPISODE: usize = 250;
/// Segments that an actor appends at once.
const APPEND: usize = 16;
/// Minibatches that are fetched ahead.
const PREFETCH: usize = 16;
/// Values of a transition in memory: observation, action, reward, β.
const VALUES: usize = 68 + 21 + 1 + 1;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[1..] {
        ["serve", dir, sync] => return serve_store(Path::new(dir), sync == "data"),
        ["bare", batch] => return serve_bare(batch.parse()?),
        _ => {}
    }
    let runtime = Runtime::new()?;
    let mut peer = Reverb::start()?;
    let mut rows = Vec::new();
    for writers in [1, 8] {
        rows.extend(insert_rows(&runtime, &mut peer, writers)?);
    }
    let dir = tempfile::tempdir()?;
    fill(dir.path())?;
    let service = Service::start(&["serve", &dir.path().display().to_string(), "process"])?;
    rows.push(memory_row(&runtime, &service, &mut peer)?);
    rows.push(snapshot_row(&runtime, &service)?);
    for batch in [256, 1024] {
        rows.extend(sample_rows(&runtime, &service, &mut peer, batch)?);
    }
    drop(service);
    rows.push(restart_row(&runtime, dir.path(), &mut peer)?);
    drop(peer);
    rows.push(in_process_row(dir.path())?);
    report("replay", &rows)
}

// ---- Rows

fn insert_rows(runtime: &Runtime, peer: &mut Reverb, writers: u64) -> Result<Vec<Row>> {
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

fn sample_rows(runtime: &Runtime, service: &Service, peer: &mut Reverb, batch: usize) -> Result<Vec<Row>> {
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

fn memory_row(runtime: &Runtime, service: &Service, peer: &mut Reverb) -> Result<Row> {
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
fn snapshot_row(runtime: &Runtime, service: &Service) -> Result<Row> {
    let mut longest: f64 = 0.0;
    for n in 0..10 {
        let taken = runtime.block_on(take_snapshot(&service.endpoint, "", &format!("bench-{n}")));
        longest = longest.max(1e3 * taken.map_err(anyhow::Error::from)?.paused_seconds);
    }
    let name = "snapshot, 1 M transitions, longest pause".to_owned();
    Ok(row(name, "ms (less is better)", longest, None, None, None))
}

fn restart_row(runtime: &Runtime, dir: &Path, peer: &mut Reverb) -> Result<Row> {
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

fn in_process_row(dir: &Path) -> Result<Row> {
    const BATCH: usize = 256;
    let store = open(dir, SyncMode::Process)?;
    let options = SampleOptions { batch: BATCH, n_step: 1, gamma: 0.97, seed: 1, segments: false };
    let mut sampler = Sampler::new(1);
    let flat = vec![0.5f32; FULL * VALUES];
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    // Places of the columns in a row, and once more the observation: the one that follows.
    let columns = [(0, 68), (68, 21), (89, 1), (90, 1), (VALUES, 68)];
    let [mut ours, mut limits, mut shares] = [const { Vec::new() }; 3];
    for turn in 0..2 * TURNS {
        let mut our_turn = || {
            per_second(BATCH, || {
                black_box(store.try_sample(&mut sampler, &options)?.context("the store has transitions")?);
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

// ---- Our clients

/// Transitions that writers have acknowledged a second, with a new service; and p50 and p99, in seconds, of how long a
/// segment takes of a writer that sends one at a time.
fn insert(runtime: &Runtime, writers: u64, sync: &str) -> Result<(f64, [f64; 2])> {
    let dir = tempfile::tempdir()?;
    let service = Service::start(&["serve", &dir.path().display().to_string(), sync])?;
    let work = |segments: usize| {
        let tasks: Vec<_> = (1..=writers)
            .map(|writer| runtime.spawn(write(service.endpoint.clone(), writer, segments)))
            .collect();
        let mut times = Vec::new();
        let started = Instant::now();
        let mut transitions = 0;
        for task in tasks {
            let (written, took) = runtime.block_on(task)??;
            transitions += written;
            times.extend(took);
        }
        Ok::<_, anyhow::Error>((transitions as f64 / started.elapsed().as_secs_f64(), transitions, times))
    };
    let (rate, written, _) = work(APPEND)?;
    let (_, more, mut times) = work(1)?;
    let described = runtime.block_on(describe(&service.endpoint)).map_err(anyhow::Error::from)?;
    let stored = described.counters.unwrap_or_default().transitions;
    ensure!(stored == (written + more) as u64, "{stored} of {} transitions are stored", written + more);
    times.sort_by(f64::total_cmp);
    Ok((rate, [0.5, 0.99].map(|share| times[((times.len() - 1) as f64 * share) as usize])))
}

/// Appends for a turn, so many segments at a time; returns the transitions and how long each append took.
async fn write(endpoint: String, writer: u64, at_once: usize) -> Result<(usize, Vec<f64>)> {
    // The segments of several episodes, again and again: only their numbers differ.
    let mut segments: Vec<Segment> = (0..8).flat_map(|n| episode(writer, n)).collect();
    let identity =
        Identity { name: format!("writer {writer}"), run_seed: 0, writer: writer + 1000 * at_once as u64 };
    let id = identity.writer;
    let waits = Waits::new(&Registry::new());
    let mut link = GrpcReplay::new(&endpoint, fixtures::get_up_spec(), identity, waits)?;
    let (mut transitions, mut times, mut sequence) = (0, Vec::new(), 0);
    let started = Instant::now();
    'turn: loop {
        for group in segments.chunks_mut(at_once) {
            if started.elapsed() >= TURN {
                break 'turn;
            }
            for segment in &mut *group {
                sequence += 1;
                (segment.writer, segment.sequence) = (id, sequence);
            }
            let began = Instant::now();
            link.append(group.to_vec()).await.map_err(|error| anyhow::anyhow!("{error}"))?;
            times.push(began.elapsed().as_secs_f64());
            transitions += group.iter().map(|segment| segment.steps).sum::<usize>();
        }
    }
    Ok((transitions, times))
}

/// An episode of 250 steps, cut.
fn episode(writer: u64, number: u64) -> Vec<Segment> {
    let spec = fixtures::get_up_spec();
    let cut = |first_step: usize| {
        let steps = STEPS.min(EPISODE - first_step);
        let ending = if first_step + steps == EPISODE { Ending::Truncated } else { Ending::None };
        Part { writer, sequence: 1, lane: 0, episode: number, first_step: first_step as u32, steps, ending }
            .build(&spec)
    };
    (0..EPISODE).step_by(STEPS).map(cut).collect()
}

/// Transitions sampled a second, and p50 and p99 of the seconds between minibatches.
fn sample(runtime: &Runtime, endpoint: &str, spec: &RunSpec, batch: usize) -> Result<(f64, [f64; 2])> {
    let options = RemoteOptions {
        endpoint: endpoint.into(),
        spec: spec.clone(),
        sample: SampleOptions { batch, n_step: 1, gamma: 0.97, seed: 1, segments: false },
        name: "benchmark".to_owned(),
        table: String::new(),
        prefetch: PREFETCH,
    };
    let mut source =
        RemoteSource::new(options, runtime.handle(), Waits::new(&Registry::new()), Shutdown::new());
    source.next()?;
    let mut moments = vec![Instant::now()];
    while moments[0].elapsed() < TURN {
        black_box(source.next()?);
        moments.push(Instant::now());
    }
    let mut times: Vec<f64> = moments.windows(2).map(|pair| (pair[1] - pair[0]).as_secs_f64()).collect();
    let rate = (times.len() * batch) as f64 / times.iter().sum::<f64>();
    times.sort_by(f64::total_cmp);
    Ok((rate, [0.5, 0.99].map(|share| times[((times.len() - 1) as f64 * share) as usize])))
}

/// Transitions a second of the bare stream.
fn drain(runtime: &Runtime, endpoint: &str, batch: usize) -> Result<f64> {
    runtime.block_on(async {
        let channel = tonic::transport::Endpoint::from_shared(format!("http://{endpoint}"))?
            .initial_stream_window_size(8 << 20)
            .initial_connection_window_size(8 << 20)
            .connect()
            .await?;
        let mut client =
            v1::replay_client::ReplayClient::new(channel).max_decoding_message_size(MAX_MESSAGE_BYTES);
        let mut replies = client.sample(tokio_stream::pending::<v1::SampleRequest>()).await?.into_inner();
        replies.message().await?;
        let started = Instant::now();
        let mut transitions = 0;
        while started.elapsed() < TURN {
            let reply = replies.message().await?.context("the stream goes on")?;
            transitions += batch * reply.minibatches.len();
        }
        Ok(transitions as f64 / started.elapsed().as_secs_f64())
    })
}

// ---- Our services, as processes

fn config(sync: SyncMode) -> ReplayConfig {
    ReplayConfig { capacity: FULL, min_size: 1, sync, ..ReplayConfig::default() }
}

fn open(dir: &Path, sync: SyncMode) -> Result<Store> {
    let registry = Registry::new();
    let (metrics, waits) = (ReplayMetrics::new(&registry), Waits::new(&registry));
    Ok(Store::open(dir, &fixtures::get_up_spec(), &config(sync), metrics, waits)?)
}

/// A store of a million transitions.
fn fill(dir: &Path) -> Result<()> {
    let store = open(dir, SyncMode::Process)?;
    let mut segments: Vec<Segment> = (0..16).flat_map(|n| episode(1, n)).collect();
    let mut sequence = 0;
    while store.counters().transitions < FULL as u64 + 1000 {
        for segment in &mut segments {
            sequence += 1;
            segment.sequence = sequence;
        }
        store.append(segments.clone())?;
    }
    Ok(())
}

fn serve_store(dir: &Path, synced: bool) -> Result<()> {
    let store = open(dir, if synced { SyncMode::Data } else { SyncMode::Process })?;
    Runtime::new()?.block_on(async {
        let listener = listen().await?;
        Ok(serve(listener, Arc::new(store), Shutdown::new()).await?)
    })
}

async fn listen() -> Result<TcpListener> {
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    println!("listening on {}", listener.local_addr()?);
    std::io::stdout().flush()?;
    Ok(listener)
}

/// Sends the same message without end, as large as those of a sampling stream.
struct Bare(v1::SampleReply);

fn serve_bare(batch: usize) -> Result<()> {
    let column = |name: &str, width: usize| v1::MinibatchColumn {
        name: name.to_owned(),
        width: width as u32,
        data: vec![1u8; batch * width * 4].into(),
    };
    let columns = [
        ("observation", 68),
        ("action", 21),
        ("reward", 1),
        ("beta", 1),
        ("next_observation", 68),
        ("discount", 1),
    ];
    let columns: Vec<_> = columns.map(|(name, width)| column(name, width)).into();
    let counters = Some(v1::ReplayCounters::default());
    let minibatch = v1::Minibatch { columns, counters, ..v1::Minibatch::default() };
    // As many as a message of the service holds.
    let count = ((4 << 20) / (batch * 160 * 4)).clamp(1, PREFETCH / 4);
    let reply = v1::SampleReply { minibatches: vec![minibatch; count] };
    Runtime::new()?.block_on(async {
        let incoming = TcpListenerStream::new(listen().await?);
        let service = ReplayServer::new(Bare(reply)).max_encoding_message_size(MAX_MESSAGE_BYTES);
        tonic::transport::Server::builder().add_service(service).serve_with_incoming(incoming).await?;
        Ok(())
    })
}

#[tonic::async_trait]
impl Replay for Bare {
    type AppendStream = tokio_stream::Empty<Result<v1::AppendReply, Status>>;
    type SampleStream = Pin<Box<dyn Stream<Item = Result<v1::SampleReply, Status>> + Send>>;

    async fn append(
        &self,
        _: Request<Streaming<v1::AppendRequest>>,
    ) -> Result<Response<Self::AppendStream>, Status> {
        Err(Status::unimplemented("it only sends"))
    }

    async fn sample(
        &self,
        _: Request<Streaming<v1::SampleRequest>>,
    ) -> Result<Response<Self::SampleStream>, Status> {
        let reply = self.0.clone();
        Ok(Response::new(Box::pin(tokio_stream::iter(std::iter::repeat_with(move || Ok(reply.clone()))))))
    }

    async fn describe(&self, _: Request<v1::DescribeRequest>) -> Result<Response<v1::DescribeReply>, Status> {
        Err(Status::unimplemented("it only sends"))
    }

    async fn update_priorities(
        &self,
        _: Request<v1::UpdatePrioritiesRequest>,
    ) -> Result<Response<v1::UpdatePrioritiesReply>, Status> {
        Err(Status::unimplemented("it only sends"))
    }

    async fn snapshot(&self, _: Request<v1::SnapshotRequest>) -> Result<Response<v1::SnapshotReply>, Status> {
        Err(Status::unimplemented("it only sends"))
    }
}

/// A process of this program that serves.
struct Service {
    child: Child,
    endpoint: String,
}

impl Service {
    fn start(arguments: &[&str]) -> Result<Self> {
        let mut child =
            Command::new(std::env::current_exe()?).args(arguments).stdout(Stdio::piped()).spawn()?;
        let mut line = String::new();
        BufReader::new(child.stdout.take().context("it is piped")?).read_line(&mut line)?;
        let endpoint =
            line.trim().strip_prefix("listening on ").context("a service says where it listens")?;
        Ok(Self { endpoint: endpoint.to_owned(), child })
    }

    /// Resident bytes.
    fn resident(&self) -> Result<u64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id()))?;
        let line =
            status.lines().find_map(|line| line.strip_prefix("VmRSS:")).context("a process has a size")?;
        Ok(1024 * line.trim().trim_end_matches(" kB").parse::<u64>()?)
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

// ---- The peer

/// Reverb, with its best settings.
struct Reverb(Peer);

struct Answer(Value);

impl Reverb {
    fn start() -> Result<Self> {
        let settings = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/replay_reverb.json");
        let arguments = [settings.display().to_string(), FULL.to_string()];
        let arguments = [arguments[0].as_str(), arguments[1].as_str()];
        Ok(Self(Peer::start_with("GETUP_REVERB_PYTHON", "replay_reverb.py", &arguments)?))
    }

    fn ask(&mut self, request: &Value) -> Result<Answer> {
        let answer = self.0.ask_line(&request.to_string())?;
        Ok(Answer(serde_json::from_str(&answer).with_context(|| format!("the peer answers {answer:?}"))?))
    }
}

impl Answer {
    fn number(&self, name: &str) -> Result<f64> {
        self.0[name].as_f64().with_context(|| format!("the peer's answer has no {name}: {}", self.0))
    }
}
