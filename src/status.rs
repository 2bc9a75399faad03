//! `getup status`: who waits on whom, and why.

use std::time::Duration;

use anyhow::{Context, Result, anyhow};
use futures::future::join_all;
use getup_proto::v1;
use getup_proto::v1::learner_client::LearnerClient;
use getup_transport::{ChannelOptions, Credentials, Endpoint};
use serde_json::json;
use tonic::Status;

use crate::config::{ConfigArgs, reached_at};
use crate::output::say;

const TIMEOUT: Duration = Duration::from_secs(5);

/// Ask a running cluster who waits on whom, and why.
#[derive(clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    config: ConfigArgs,
    /// One JSON object on stdout.
    #[arg(long)]
    json: bool,
}

#[tokio::main(flavor = "current_thread")]
pub(crate) async fn run(arguments: Args) -> Result<()> {
    let config = arguments.config.load()?;
    let replays = config.network.replays();
    let credentials = Credentials::load(&config.security)?;
    let at = |address: &str| Endpoint::new(&reached_at(address), &credentials);
    let asking = join_all(replays.iter().map(|address| ask_replay(at(address))));
    let (replays, learner) = tokio::join!(asking, ask_learner(at(&config.network.learner)));
    if arguments.json {
        let replay = |replay: &Result<_>| {
            replay.as_ref().map_or_else(|error| json!({"error": format!("{error:#}")}), replay_json)
        };
        let replay = match replays.as_slice() {
            [one] => replay(one),
            several => several.iter().map(replay).collect(),
        };
        let learner =
            learner.as_ref().map_or_else(|error| json!({"error": format!("{error:#}")}), learner_json);
        say!("{}", json!({"replay": replay, "learner": learner}));
    } else {
        for replay in &replays {
            match replay {
                Ok(reply) => print_replay(reply),
                Err(error) => say!("replay   not reached: {error:#}"),
            }
        }
        match &learner {
            Ok(reply) => print_learner(reply),
            Err(error) => say!("learner  not reached: {error:#}"),
        }
    }
    anyhow::ensure!(
        learner.is_ok() || replays.iter().any(Result::is_ok),
        "no role answers: is the cluster running? (`getup train` shows its waits itself)"
    );
    Ok(())
}

async fn ask_replay(endpoint: Endpoint) -> Result<v1::DescribeReply> {
    let address = endpoint.address.clone();
    getup_replay::describe(endpoint).await.map_err(|status| unanswered(&address, &status))
}

async fn ask_learner(endpoint: Endpoint) -> Result<v1::StatusReply> {
    let mut client = LearnerClient::new(endpoint.channel(ChannelOptions::default())?);
    let asked = tokio::time::timeout(TIMEOUT, client.status(v1::StatusRequest {})).await;
    let asked = asked.with_context(|| format!("{}: no answer within {TIMEOUT:?}", endpoint.address))?;
    Ok(asked.map_err(|status| unanswered(&endpoint.address, &status))?.into_inner())
}

fn unanswered(address: &str, status: &Status) -> anyhow::Error {
    anyhow!("{address}: {}", getup_transport::reason(status))
}

fn version(version: Option<v1::PolicyVersion>) -> String {
    getup_proto::PolicyVersion::from(version.unwrap_or_default()).to_string()
}

fn or_nobody(waiting: &str) -> &str {
    if waiting.is_empty() { "nobody waits" } else { waiting }
}

fn print_replay(reply: &v1::DescribeReply) {
    let counters = reply.counters.unwrap_or_default();
    let limiter = reply.limiter.clone().unwrap_or_default();
    say!(
        "replay   {} of {} transitions, {} env steps in {} episodes, {} sampled",
        reply.size,
        reply.capacity,
        counters.env_steps,
        counters.episodes,
        counters.sampled
    );
    say!("         {}", or_nobody(&limiter.waiting));
    for writer in &reply.writers {
        say!(
            "         writer {}: {} segments, silent for {:.0} s",
            writer.name,
            writer.durable_sequence,
            writer.silent_seconds
        );
    }
}

fn print_learner(reply: &v1::StatusReply) {
    say!(
        "learner  {}: run {}, {} env steps, {} updates ({:.0}/s), stage {}, β = {:.3}",
        reply.state,
        reply.run,
        reply.env_steps,
        reply.updates,
        reply.updates_per_second,
        reply.stage,
        reply.beta
    );
    say!("         {}", or_nobody(&reply.waiting));
    if let Some(evaluation) = &reply.evaluation {
        let v1::EvaluationSummary { env_steps, mean, min, .. } = evaluation;
        let [rises, stands] = [evaluation.rises, evaluation.stands].map(|share| 100.0 * share);
        say!(
            "         last evaluation at {env_steps} env steps: mean return {mean:.1}, minimum {min:.1}, rises \
             {rises:.0} %, stands {stands:.0} %"
        );
    }
    for actor in &reply.actors {
        let activity = if actor.waiting.is_empty() { "steps" } else { actor.waiting.as_str() };
        say!(
            "actor    {}: {activity}; {} env steps, policy {}, silent for {:.0} s{}",
            actor.name,
            actor.env_steps,
            version(actor.version),
            actor.silent_seconds,
            if actor.lease > 0 { ", evaluates" } else { "" }
        );
    }
}

fn replay_json(reply: &v1::DescribeReply) -> serde_json::Value {
    let counters = reply.counters.unwrap_or_default();
    let limiter = reply.limiter.clone().unwrap_or_default();
    json!({
        "size": reply.size, "capacity": reply.capacity,
        "memory_bytes": reply.memory_bytes, "disk_bytes": reply.disk_bytes,
        // A string: it has more digits than a number in JSON is sure to keep.
        "store": counters.store.to_string(),
        "env_steps": counters.env_steps, "transitions": counters.transitions,
        "episodes": counters.episodes, "sampled": counters.sampled,
        "waiting": limiter.waiting,
        "limiter": {"cursor": limiter.cursor, "min": limiter.min_cursor, "max": limiter.max_cursor},
        "writers": reply.writers.iter().map(|writer| json!({
            "name": writer.name, "segments": writer.durable_sequence, "silent_seconds": writer.silent_seconds,
        })).collect::<Vec<_>>(),
    })
}

fn learner_json(reply: &v1::StatusReply) -> serde_json::Value {
    json!({
        "run": reply.run, "state": reply.state, "waiting": reply.waiting,
        "env_steps": reply.env_steps, "updates": reply.updates, "updates_per_second": reply.updates_per_second,
        "stage": reply.stage, "beta": reply.beta,
        "stage_env_steps": reply.stage_env_steps, "stage_limit": reply.stage_limit,
        "version": version(reply.version),
        "evaluation": reply.evaluation.as_ref().map(|evaluation| json!({
            "env_steps": evaluation.env_steps, "mean": evaluation.mean, "min": evaluation.min,
            "beta": evaluation.beta, "version": version(evaluation.version),
            "rises": evaluation.rises, "stands": evaluation.stands,
        })),
        "actors": reply.actors.iter().map(|actor| json!({
            "name": actor.name, "env_steps": actor.env_steps, "version": version(actor.version),
            "silent_seconds": actor.silent_seconds, "waiting": actor.waiting, "lease": actor.lease,
        })).collect::<Vec<_>>(),
    })
}
