//! Our clients: writers, samplers, and the reader of the bare stream.

use std::hint::black_box;
use std::time::Instant;

use anyhow::{Context, Result, bail, ensure};
use getup_actor::link::SegmentWriter;
use getup_actor::{GrpcReplay, Identity};
use getup_proto::{MAX_MESSAGE_BYTES, RunSpec, Segment, v1};
use getup_replay::{MinibatchSource, RemoteOptions, RemoteSource, SampleOptions, describe};
use getup_telemetry::{Registry, Shutdown, Waits};
use tokio::runtime::Runtime;

use crate::fixtures::get_up_spec;
use crate::load::{episode, percentiles};
use crate::services::Service;
use crate::{PREFETCH, TURN};

/// Segments that an actor appends at once.
const APPEND: usize = 16;

/// Transitions that writers have acknowledged a second, with a new service; and p50 and p99, in seconds, of how long a
/// segment takes of a writer that sends one at a time.
pub(crate) fn insert(runtime: &Runtime, writers: u64, sync: &str) -> Result<(f64, [f64; 2])> {
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
    let (_, more, times) = work(1)?;
    let described = runtime.block_on(describe(&service.endpoint)).map_err(anyhow::Error::from)?;
    let stored = described.counters.unwrap_or_default().transitions;
    ensure!(stored == (written + more) as u64, "{stored} of {} transitions are stored", written + more);
    Ok((rate, p50_and_p99(times)?))
}

/// Appends for a turn, so many segments at a time; returns the transitions and how long each append took.
async fn write(endpoint: String, writer: u64, at_once: usize) -> Result<(usize, Vec<f64>)> {
    // The segments of several episodes, again and again: only their numbers differ.
    let mut segments: Vec<Segment> = (0..8).flat_map(|number| episode(&get_up_spec(), number)).collect();
    let identity =
        Identity { name: format!("writer {writer}"), run_seed: 0, writer: writer + 1000 * at_once as u64 };
    let id = identity.writer;
    let waits = Waits::new(&Registry::new());
    let mut link = GrpcReplay::new(&endpoint, get_up_spec(), identity, waits)?;
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

/// Transitions sampled a second, and p50 and p99 of the seconds between minibatches.
pub(crate) fn sample(
    runtime: &Runtime,
    endpoint: &str,
    spec: &RunSpec,
    batch: usize,
) -> Result<(f64, [f64; 2])> {
    let options = RemoteOptions {
        spec: spec.clone(),
        sample: SampleOptions { batch, n_step: 1, gamma: 0.97, seed: 1, segments: false },
        name: "benchmark".to_owned(),
        table: String::new(),
        prefetch: PREFETCH,
    };
    let mut source =
        RemoteSource::new(endpoint, options, runtime.handle(), Waits::new(&Registry::new()), Shutdown::new());
    source.next()?;
    let mut moments = vec![Instant::now()];
    while moments[0].elapsed() < TURN {
        black_box(source.next()?);
        moments.push(Instant::now());
    }
    let times: Vec<f64> = moments.windows(2).map(|pair| (pair[1] - pair[0]).as_secs_f64()).collect();
    let rate = (times.len() * batch) as f64 / times.iter().sum::<f64>();
    Ok((rate, p50_and_p99(times)?))
}

/// Transitions a second of the bare stream.
pub(crate) fn drain(runtime: &Runtime, endpoint: &str, batch: usize) -> Result<f64> {
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

fn p50_and_p99(times: Vec<f64>) -> Result<[f64; 2]> {
    let [Some(p50), Some(p99)] = percentiles(times, [0.5, 0.99]) else { bail!("nothing came in {TURN:?}") };
    Ok([p50, p99])
}
