//! `getup bench`: what a running cluster's services do, measured by the real protocol.

mod load;

use std::collections::HashMap;
use std::hint::black_box;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use futures::future::try_join_all;
use getup_actor::link::{LearnerLink, SegmentWriter};
use getup_actor::{GrpcLearner, GrpcReplay, Identity, PolicyUpdate};
use getup_learner::config::SacConfig;
use getup_proto::v1::learner_client::LearnerClient;
use getup_proto::{PolicyVersion, RunSpec, Segment, v1};
use getup_replay::{MinibatchSource, RemoteOptions, SampleOptions, ShardedSource};
use getup_telemetry::{Registry, Shutdown, Waits};
use getup_transport::{ChannelOptions, Credentials, Endpoint};
use serde::Serialize;
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{sleep_until, timeout};

use crate::config::{ConfigArgs, reached_at};
use crate::output::{progress_bar, say};
use load::{episode, percentiles};

/// Transitions of a minibatch.
const BATCHES: [usize; 3] = [128, 256, 1024];
/// Minibatches ahead, as a learner has them.
const PREFETCH: usize = 8;
/// How often it is asked which policy is the newest: as much too long a lag may seem.
const ASK_EVERY: Duration = Duration::from_millis(2);
/// How long the first answer of each part may take.
const PATIENCE: Duration = Duration::from_secs(10);
/// The longest that a part may be measured.
const LONGEST: Duration = Duration::from_secs(3600);
/// Appends, the sizes of minibatch, broadcasts.
const PARTS: usize = 2 + BATCHES.len();

/// Measure a running cluster: appends, minibatches and broadcasts, by the real protocol.
///
/// Simulated writers append made-up episodes to a table, as fast as they are acknowledged, one segment at a time; a
/// simulated learner samples it at three sizes of minibatch; simulated actors hear the policies that the learner
/// broadcasts, where it trains. It takes the cluster's settings, as an actor does.
///
/// The table is one that no run learns from: start the replays with `--tables FILE`, where FILE has a section `[bench]`
/// with the lines `capacity = 200000` and `min_size = 1` (without samples_per_insert nobody is held up). A run that
/// trains meanwhile shares processors, disk and network with the bench, and loses nothing else.
#[derive(clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    config: ConfigArgs,
    /// The table that is filled and sampled; `default` is the run's own, and needs --yes.
    #[arg(long, value_name = "NAME", default_value = "bench")]
    table: String,
    /// Simulated writers, and as many listeners; in turn to each replay.
    #[arg(long, value_name = "N", default_value_t = 16)]
    writers: usize,
    /// How long each of the five parts is measured.
    #[arg(long, value_name = "SECONDS", default_value_t = 5.0)]
    seconds: f64,
    /// Yes, put made-up transitions among those that the run learns from, with `--table default`.
    #[arg(long)]
    yes: bool,
    /// One JSON object on stdout.
    #[arg(long)]
    json: bool,
}

/// What was measured.
#[derive(Serialize)]
struct Report {
    writers: usize,
    seconds: f64,
    append_p50_ms: f64,
    append_p99_ms: f64,
    env_steps_per_second: f64,
    megabytes_per_second: f64,
    samples: Vec<Sampled>,
    broadcast: Option<Broadcast>,
    /// Why there is no broadcast.
    no_broadcast: Option<String>,
}

#[derive(Serialize)]
struct Sampled {
    batch: usize,
    minibatches_per_second: f64,
}

/// Of policies, from their publication until they are heard and parsed.
#[derive(Serialize)]
struct Broadcast {
    /// Heard by each listener, on average.
    policies_per_second: f64,
    lag_p50_ms: f64,
    lag_p99_ms: f64,
}

/// Where the cluster is, and what it is asked.
struct Bench {
    replays: Vec<Endpoint>,
    learner: Endpoint,
    spec: RunSpec,
    sac: SacConfig,
    table: String,
    writers: usize,
    time: Duration,
    waits: Waits,
}

pub(crate) fn run(arguments: Args) -> Result<()> {
    let config = arguments.config.load()?;
    let time = Duration::try_from_secs_f64(arguments.seconds).ok();
    let time = time.filter(|time| !time.is_zero() && *time <= LONGEST);
    let time = time.with_context(|| format!("--seconds {}: over 0, at most an hour", arguments.seconds))?;
    ensure!(arguments.writers > 0, "--writers 0: at least one");
    ensure!(
        arguments.yes || arguments.table != getup_replay::DEFAULT_TABLE,
        "--table default puts made-up transitions among those that run `{}` learns from: say --yes to do it",
        config.run
    );
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let report = runtime.block_on(async {
        let credentials = Credentials::load(&config.security)?;
        let at = |address: &str| Endpoint::new(&reached_at(address), &credentials);
        let bench = Bench {
            replays: config.network.replays().iter().map(|address| at(address)).collect(),
            learner: at(&config.network.learner),
            spec: config.run_spec()?,
            sac: config.sac.clone(),
            table: arguments.table,
            writers: arguments.writers,
            time,
            waits: Waits::new(&Registry::new()),
        };
        // Every part has its own limits; this is one for what no part thought of.
        let limit = PARTS as u32 * (time + 2 * PATIENCE);
        let measured = timeout(limit, bench.measure()).await;
        measured.unwrap_or_else(|_| Err(bench.unanswered("the measurement did not end", limit)))
    });
    // What still waits for an answer is not waited for.
    runtime.shutdown_background();
    let report = report?;
    if arguments.json {
        say!("{}", serde_json::to_string(&report)?);
    } else {
        report.print();
    }
    Ok(())
}

impl Report {
    fn print(&self) {
        let line = |what: String, value: f64, unit: &str| say!("{what:<36} {value:>12.1} {unit}");
        let by = format!("{} writer{}", self.writers, if self.writers == 1 { "" } else { "s" });
        line(format!("append p50, {by}"), self.append_p50_ms, "ms");
        line(format!("append p99, {by}"), self.append_p99_ms, "ms");
        line(format!("appended, {by}"), self.env_steps_per_second, "env steps/s");
        line(format!("appended, {by}"), self.megabytes_per_second, "MB/s");
        for Sampled { batch, minibatches_per_second } in &self.samples {
            line(format!("minibatches of {batch}"), *minibatches_per_second, "a second");
        }
        if let Some(Broadcast { policies_per_second, lag_p50_ms, lag_p99_ms }) = self.broadcast {
            line(
                format!("broadcasts heard, {} listeners each", self.writers),
                policies_per_second,
                "a second",
            );
            line("broadcast lag p50".to_owned(), lag_p50_ms, "ms");
            line("broadcast lag p99".to_owned(), lag_p99_ms, "ms");
        }
        if let Some(why) = &self.no_broadcast {
            say!("broadcasts were not measured: {why}");
        }
    }
}

impl Bench {
    async fn measure(&self) -> Result<Report> {
        for replay in &self.replays {
            let described = timeout(PATIENCE, getup_replay::describe(replay.clone())).await;
            let described = described.map_err(|_| self.unanswered("the replay does not answer", PATIENCE))?;
            let described = described.map_err(|status| {
                anyhow::anyhow!("{}: {}", replay.address, getup_transport::reason(&status))
            })?;
            ensure!(
                described.tables.contains(&self.table),
                "the replay at {} has no table `{}` but {}: `getup bench --help` says how it gets one",
                replay.address,
                self.table,
                described.tables.join(", ")
            );
        }
        let bar = progress_bar(PARTS as u64, "parts");
        let (mut times, env_steps, bytes) = self.append().await?;
        bar.inc(1);
        let mut samples = Vec::new();
        for batch in BATCHES {
            samples.push(Sampled { batch, minibatches_per_second: self.sample(batch).await? });
            bar.inc(1);
        }
        let (broadcast, no_broadcast) = match self.hear().await {
            Ok(broadcast) => (Some(broadcast), None),
            Err(error) => (None, Some(format!("{error:#}"))),
        };
        bar.finish_and_clear();
        let [p50, p99] = milliseconds(std::mem::take(&mut times));
        let seconds = self.time.as_secs_f64();
        Ok(Report {
            writers: self.writers,
            seconds,
            append_p50_ms: p50,
            append_p99_ms: p99,
            env_steps_per_second: env_steps as f64 / seconds,
            megabytes_per_second: bytes as f64 / 1e6 / seconds,
            samples,
            broadcast,
            no_broadcast,
        })
    }

    /// How long each append took, in seconds; env steps and bytes of all.
    async fn append(&self) -> Result<(Vec<f64>, usize, usize)> {
        let segments: Arc<[Segment]> = (0..8).flat_map(|number| episode(&self.spec, number)).collect();
        let writer = |index: usize| {
            let identity = Identity::new(&format!("bench-{index}"), 0);
            let replay = self.replays[index % self.replays.len()].clone();
            let link = GrpcReplay::new(replay, self.spec.clone(), identity, self.waits.clone())?;
            Ok::<_, anyhow::Error>(Writer {
                link: link.in_table(&self.table),
                sequence: 0,
                segments: segments.clone(),
            })
        };
        let mut writers = (0..self.writers).map(writer).collect::<Result<Vec<_>>>()?;
        // The first of each connects.
        let connecting = try_join_all(writers.iter_mut().map(Writer::append_one));
        let connected = timeout(PATIENCE, connecting).await;
        connected.map_err(|_| self.unanswered("not every writer was acknowledged", PATIENCE))??;
        let until = Instant::now() + self.time;
        let appended = writers.into_iter().map(|writer| tokio::spawn(writer.append_until(until)));
        let mut all = (Vec::new(), 0, 0);
        for task in appended.collect::<Vec<_>>() {
            let (times, env_steps, bytes) = task.await??;
            all.0.extend(times);
            all = (all.0, all.1 + env_steps, all.2 + bytes);
        }
        ensure!(all.1 > 0, "no segment was acknowledged within {:?}", self.time);
        Ok(all)
    }

    /// Minibatches a second.
    async fn sample(&self, batch: usize) -> Result<f64> {
        let options = RemoteOptions {
            spec: self.spec.clone(),
            sample: SampleOptions {
                batch,
                n_step: self.sac.n_step,
                gamma: self.sac.gamma as f32,
                seed: 1,
                segments: false,
            },
            name: "bench".to_owned(),
            table: self.table.clone(),
            prefetch: PREFETCH,
        };
        let runtime = tokio::runtime::Handle::current();
        let shutdown = Shutdown::new();
        let mut source = ShardedSource::new(&self.replays, &options, &runtime, self.waits.clone(), shutdown);
        let time = self.time;
        let counted = tokio::task::spawn_blocking(move || {
            if source.poll(PATIENCE)?.is_none() {
                return Ok(None);
            }
            let (began, mut count) = (Instant::now(), 0);
            while let Some(left) = time.checked_sub(began.elapsed()) {
                count += u64::from(source.poll(left)?.map(black_box).is_some());
            }
            Ok::<_, getup_replay::SampleError>(Some(count as f64 / began.elapsed().as_secs_f64()))
        });
        counted.await??.ok_or_else(|| self.unanswered("no minibatch came", PATIENCE))
    }

    /// Listeners hear policies, while the learner is asked which is its newest: a lag is counted from the last answer that
    /// did not know of the policy, so that it is at most a question too long, and clocks of other machines do not matter.
    async fn hear(&self) -> Result<Broadcast> {
        let heard = Arc::new(Mutex::new(Vec::new()));
        let mut listeners = JoinSet::new();
        let mut all_updates = Vec::new();
        for index in 0..self.writers {
            let (slot, mut updates) = watch::channel(None);
            all_updates.push(updates.clone());
            let (endpoint, spec, waits) = (self.learner.clone(), self.spec.clone(), self.waits.clone());
            let link = GrpcLearner::new(endpoint, spec, &format!("bench-{index}"), waits)?;
            let heard = Arc::clone(&heard);
            let note = async move {
                while updates.changed().await.is_ok() {
                    let update = updates.borrow_and_update();
                    let version = update.as_ref().map(|update: &Arc<PolicyUpdate>| update.version);
                    drop(update);
                    let now = Instant::now();
                    let mut heard = heard.lock().unwrap_or_else(PoisonError::into_inner);
                    heard.extend(version.map(|version| (version, now)));
                }
                Ok(())
            };
            // Each by itself, or the last would wait until all others have parsed theirs.
            listeners.spawn(async move {
                let hear = async { Ok::<_, anyhow::Error>(link.subscribe(slot).await?) };
                tokio::try_join!(hear, note)
            });
        }
        let measured = async {
            // Each hears the newest first, which was there before.
            let first = timeout(PATIENCE, all_heard(&mut all_updates)).await;
            first.map_err(|_| self.unanswered("not every listener heard a policy", PATIENCE))??;
            Ok::<_, anyhow::Error>((Instant::now(), self.publications().await?))
        };
        let (began, published) = tokio::select! {
            published = measured => published?,
            ended = listeners.join_next() => bail!("the learner broadcasts nothing more: {ended:?}"),
        };
        let heard = std::mem::take(&mut *heard.lock().unwrap_or_else(PoisonError::into_inner));
        let count = heard.iter().filter(|(_, at)| *at >= began).count();
        let lag = |(version, at): (PolicyVersion, Instant)| {
            Some(at.saturating_duration_since(*published.get(&version)?).as_secs_f64())
        };
        let lags: Vec<f64> = heard.into_iter().filter_map(lag).collect();
        ensure!(
            !lags.is_empty(),
            "no policy was broadcast within {:?}: the learner does not train",
            self.time
        );
        let policies_per_second = count as f64 / self.writers as f64 / self.time.as_secs_f64();
        let [lag_p50_ms, lag_p99_ms] = milliseconds(lags);
        Ok(Broadcast { policies_per_second, lag_p50_ms, lag_p99_ms })
    }

    /// When each policy was not yet there.
    async fn publications(&self) -> Result<HashMap<PolicyVersion, Instant>> {
        let until = tokio::time::Instant::now() + self.time;
        let mut client = LearnerClient::new(self.learner.channel(ChannelOptions::default())?);
        let (mut published, mut newest, mut asked) = (HashMap::new(), None, Instant::now());
        while tokio::time::Instant::now() < until {
            let asking = Instant::now();
            let status = timeout(PATIENCE, client.status(v1::StatusRequest {})).await;
            let status =
                status.map_err(|_| self.unanswered("the learner does not answer", PATIENCE))??.into_inner();
            let version = PolicyVersion::from(status.version.unwrap_or_default());
            // The first was there before.
            if newest.replace(version).is_some_and(|before| before != version) {
                published.insert(version, asked);
            }
            asked = asking;
            sleep_until((tokio::time::Instant::now() + ASK_EVERY).min(until)).await;
        }
        Ok(published)
    }

    fn unanswered(&self, what: &str, limit: Duration) -> anyhow::Error {
        let waits: Vec<String> = self.waits.current().iter().map(ToString::to_string).collect();
        anyhow::anyhow!("{what} within {limit:?}: {}", waits.join("; "))
    }
}

/// Waits until there is something in each. Nothing stays borrowed meanwhile: whoever puts the next thing in the place of a
/// borrowed one would wait for this, and this for the others.
async fn all_heard<T>(slots: &mut [watch::Receiver<Option<T>>]) -> Result<(), watch::error::RecvError> {
    let heard = async |slot: &mut watch::Receiver<Option<T>>| slot.wait_for(Option::is_some).await.map(drop);
    try_join_all(slots.iter_mut().map(heard)).await.map(drop)
}

/// A simulated actor's way to a replay.
struct Writer {
    link: GrpcReplay,
    sequence: u64,
    segments: Arc<[Segment]>,
}

impl Writer {
    /// How long it took; its env steps and bytes.
    async fn append_one(&mut self) -> Result<(Duration, usize, usize)> {
        let template = &self.segments[self.sequence as usize % self.segments.len()];
        self.sequence += 1;
        let segment = Segment { writer: self.link.writer(), sequence: self.sequence, ..template.clone() };
        let bytes = segment.columns.iter().map(|column| column.len()).sum();
        let (steps, began) = (segment.steps, Instant::now());
        self.link.append(vec![segment]).await?;
        Ok((began.elapsed(), steps, bytes))
    }

    async fn append_until(mut self, until: Instant) -> Result<(Vec<f64>, usize, usize)> {
        let (mut times, mut env_steps, mut bytes) = (Vec::new(), 0, 0);
        loop {
            let began = Instant::now();
            let Ok(appended) = tokio::time::timeout_at(until.into(), self.append_one()).await else {
                // One that hangs is not left out: it takes at least so long.
                times.push(began.elapsed().as_secs_f64());
                return Ok((times, env_steps, bytes));
            };
            let (took, steps, size) = appended?;
            times.push(took.as_secs_f64());
            (env_steps, bytes) = (env_steps + steps, bytes + size);
        }
    }
}

/// The median and the 99th percentile of seconds, in milliseconds.
fn milliseconds(seconds: Vec<f64>) -> [f64; 2] {
    percentiles(seconds, [0.5, 0.99]).map(|value| 1e3 * value.unwrap_or(f64::NAN))
}

#[cfg(test)]
mod tests {
    use super::*;
    use futures::FutureExt;

    #[tokio::test]
    async fn who_heard_first_hears_on_while_the_others_are_waited_for() {
        let (early, first) = watch::channel(Some(1));
        let (_late, second) = watch::channel(None);
        let mut slots = [first, second];
        let mut heard = std::pin::pin!(all_heard(&mut slots));
        assert!(heard.as_mut().now_or_never().is_none(), "the second has heard nothing");
        let next = tokio::task::spawn_blocking(move || early.send_replace(Some(2)));
        assert_eq!(timeout(PATIENCE, next).await.expect("nobody holds the first one's").unwrap(), Some(1));
    }
}
