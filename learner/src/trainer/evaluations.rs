//! What a reported evaluation brings: a line in the run's folder, and the curriculum's decision.

use getup_policy::Policy;
use getup_proto::names::BETA_VALUE;
use getup_proto::{PolicyVersion, v1};
use serde::Serialize;

use super::{Ending, TrainError, Trainer};
use crate::curriculum::{Decision, Outcome, StageResult};
use crate::hub::Evaluation;
use crate::run_folder::{append_line, write_atomically};

/// A line of `evaluations.jsonl`.
#[derive(Debug, Serialize)]
struct EvaluationLine<'a> {
    version: String,
    env_steps: u64,
    updates: u64,
    stage: u32,
    beta: f64,
    mean: f64,
    min: f64,
    /// Share of the falls in which the head reaches 1.4 m.
    rises: f64,
    /// Share of the falls that end standing.
    stands: f64,
    returns: &'a [f64],
}

/// A line of `timings.jsonl`.
#[derive(Debug, Serialize)]
struct TimingLine {
    version: String,
    env_steps: u64,
    updates: u64,
    /// Since this process began to train.
    seconds: f64,
    updates_per_second: f64,
}

impl Trainer {
    /// Records an evaluation, and lets the curriculum decide.
    pub(super) fn evaluated(
        &mut self,
        evaluation: &Evaluation,
        episodes: &[v1::EpisodeResult],
    ) -> Result<(), TrainError> {
        let policy = &evaluation.policy;
        let returns: Vec<f64> = episodes.iter().map(|episode| episode.episode_return).collect();
        let mean = returns.iter().sum::<f64>() / returns.len() as f64;
        let min = returns.iter().copied().fold(f64::INFINITY, f64::min);
        let share = |of: fn(&v1::EpisodeResult) -> bool| {
            episodes.iter().filter(|episode| of(episode)).count() as f64 / episodes.len() as f64
        };
        let rises = share(|episode| episode.rises);
        let stands = share(|episode| episode.stands);
        let (beta, stage) = (policy.values[BETA_VALUE], policy.stage);
        let line = EvaluationLine {
            version: PolicyVersion::from(policy.version.unwrap_or_default()).to_string(),
            env_steps: policy.env_steps,
            updates: evaluation.updates,
            stage,
            beta,
            mean,
            min,
            rises,
            stands,
            returns: &returns,
        };
        append_line(&self.folder.evaluations(), &line)?;
        let timing = TimingLine {
            version: line.version.clone(),
            env_steps: line.env_steps,
            updates: line.updates,
            seconds: self.pace.seconds(),
            updates_per_second: self.pace.per_second(),
        };
        append_line(&self.folder.timings(), &timing)?;
        tracing::info!(
            env_steps = policy.env_steps,
            updates = evaluation.updates,
            beta,
            mean,
            min,
            rises,
            stands,
            "evaluation"
        );
        self.metrics.evaluations.inc();
        self.metrics.evaluation_return_mean.set(mean);
        self.metrics.evaluation_return_min.set(min);
        let env_steps = policy.env_steps;
        self.metrics.evaluation_rise_rate.set(rises);
        self.metrics.evaluation_stand_rate.set(stands);
        let version = policy.version;
        self.evaluation = Some(v1::EvaluationSummary { version, env_steps, mean, min, beta, rises, stands });
        let result = StageResult { stage, env_steps, min_return: min, mean_return: mean, stand_rate: stands };
        let decision = self.curriculum.report(result, self.progress.env_steps);
        self.decided(decision, evaluation, &line)
    }

    fn decided(
        &mut self,
        decision: Decision,
        evaluation: &Evaluation,
        line: &EvaluationLine<'_>,
    ) -> Result<(), TrainError> {
        let passed = match decision {
            Decision::Ignore | Decision::Stay => None,
            Decision::Better => Some(line.beta),
            Decision::Promote { passed, next } => {
                tracing::info!(passed, next, min = line.min, "promoted: the next stage is weaker");
                self.metrics.promotions.inc();
                Some(passed)
            }
            Decision::Finish(outcome) => {
                tracing::info!(?outcome, "the curriculum is over");
                self.ending = Some(Ending::Curriculum(outcome));
                match outcome {
                    Outcome::FloorPassed { beta } => Some(beta),
                    Outcome::StageOutlasted { .. } | Outcome::Settled { .. } => None,
                }
            }
        };
        if let Some(beta) = passed {
            let model = Policy::from_bytes(&evaluation.policy.networks[0].model)?;
            let mut model = self.describe(model, beta);
            // The curriculum is in the next stage already, and training went on meanwhile.
            model.metadata.insert("stage".into(), evaluation.policy.stage.to_string());
            model.metadata.insert("env_steps".into(), evaluation.policy.env_steps.to_string());
            model.metadata.insert("updates".into(), evaluation.updates.to_string());
            model.metadata.insert("evaluation_mean".into(), line.mean.to_string());
            model.metadata.insert("evaluation_min".into(), line.min.to_string());
            model.metadata.insert("evaluation_stands".into(), line.stands.to_string());
            if decision != Decision::Better {
                let stage = format!("stage-{}", evaluation.policy.stage);
                write_atomically(&self.folder.model(&stage), &model.to_bytes())?;
            }
            write_atomically(&self.folder.model("best"), &model.to_bytes())?;
        }
        if !matches!(decision, Decision::Ignore | Decision::Stay) {
            // On disk before anybody hears of the next stage: the curriculum never goes back, nor does its best policy.
            self.checkpoint();
            self.checkpoints.finish()?;
        }
        if matches!(decision, Decision::Promote { .. }) {
            self.publish();
        }
        self.show();
        Ok(())
    }
}
