//! The learner's metrics.

use getup_telemetry::Registry;
use getup_telemetry::prometheus::{
    CounterVec, Gauge, GaugeVec, Histogram, HistogramOpts, IntCounter, IntGauge,
    register_counter_vec_with_registry, register_gauge_vec_with_registry, register_gauge_with_registry,
    register_histogram_with_registry, register_int_counter_with_registry, register_int_gauge_with_registry,
};

use crate::sac::{Losses, Norms, Phases};

/// Handles to everything the learner exposes.
#[derive(Clone)]
pub(crate) struct LearnerMetrics {
    pub(crate) updates: IntCounter,
    pub(crate) env_steps: IntGauge,
    pub(crate) update_seconds: Histogram,
    pub(crate) wait_seconds: Histogram,
    phases: CounterVec,
    gradient_norm: GaugeVec,
    weight_norm: GaugeVec,
    pub(crate) loss_not_finite: IntGauge,
    critic_loss: Gauge,
    actor_loss: Gauge,
    temperature: Gauge,
    entropy: Gauge,
    q: Gauge,
    pub(crate) beta: Gauge,
    pub(crate) stage: IntGauge,
    pub(crate) stage_env_steps: IntGauge,
    pub(crate) stage_limit_env_steps: IntGauge,
    pub(crate) policy_version: IntGauge,
    pub(crate) evaluations: IntCounter,
    pub(crate) evaluations_outstanding: IntGauge,
    pub(crate) evaluation_return_mean: Gauge,
    pub(crate) evaluation_return_min: Gauge,
    pub(crate) evaluation_rise_rate: Gauge,
    pub(crate) evaluation_stand_rate: Gauge,
    pub(crate) promotions: IntCounter,
    pub(crate) checkpoints: IntCounter,
    pub(crate) checkpoint_seconds: Histogram,
    pub(crate) filling: IntGauge,
    pub(crate) finished: IntGauge,
}

impl LearnerMetrics {
    /// Registers all; a registry takes one learner.
    pub(crate) fn new(registry: &Registry) -> Self {
        const PROVEN: &str = "the learner's metrics are registered once a registry, under names of their own";
        let counter = |name: &str, help: &str| {
            register_int_counter_with_registry!(format!("getup_learner_{name}"), help, registry)
                .expect(PROVEN)
        };
        let whole = |name: &str, help: &str| {
            register_int_gauge_with_registry!(format!("getup_learner_{name}"), help, registry).expect(PROVEN)
        };
        let gauge = |name: &str, help: &str| {
            register_gauge_with_registry!(format!("getup_learner_{name}"), help, registry).expect(PROVEN)
        };
        let unknown = |name: &str, help: &str| {
            let gauge = gauge(name, help);
            gauge.set(f64::NAN);
            gauge
        };
        let by_network = |name: &str, help: &str| {
            register_gauge_vec_with_registry!(format!("getup_learner_{name}"), help, &["network"], registry)
                .expect(PROVEN)
        };
        let seconds = |name: &str, help: &str| {
            let buckets = (0..16).map(|power| 1e-4 * 2f64.powi(power)).collect();
            let options = HistogramOpts::new(format!("getup_learner_{name}"), help).buckets(buckets);
            register_histogram_with_registry!(options, registry).expect(PROVEN)
        };
        Self {
            updates: counter("updates_total", "Updates of the networks since this process started."),
            env_steps: whole("env_steps", "Env steps of the run that have reached the replay."),
            update_seconds: seconds(
                "update_seconds",
                "Time of one update, without waiting for its minibatch.",
            ),
            wait_seconds: seconds("wait_seconds", "Time waited for a minibatch."),
            phases: {
                let help = "Time of updates, by phase: batch, critics, actor, optimizer (on a processor with the gradients of weights).";
                let name = "getup_learner_update_phase_seconds_total";
                register_counter_vec_with_registry!(name, help, &["phase"], registry).expect(PROVEN)
            },
            gradient_norm: by_network("gradient_norm", "Euclidean norm of the gradient, by network."),
            weight_norm: by_network("weight_norm", "Euclidean norm of the weights, by network."),
            loss_not_finite: whole(
                "loss_not_finite",
                "1 once training stopped because a loss or a gradient was no number any more.",
            ),
            critic_loss: gauge("critic_loss", "Mean squared error of the critics, summed over them."),
            actor_loss: unknown(
                "actor_loss",
                "Mean of temperature times log-probability less Q, when the actor last learned; NaN before.",
            ),
            temperature: gauge("temperature", "SAC's temperature."),
            entropy: unknown(
                "entropy_nats",
                "Mean entropy of the policy over a minibatch, in nats, when the actor last learned; NaN before.",
            ),
            q: gauge("q", "Mean Q of a minibatch's own actions."),
            beta: gauge("beta", "Torque-limit multiplier of the stage."),
            stage: whole("stage", "Stage of the curriculum, from 0."),
            stage_env_steps: whole("stage_env_steps", "Env steps spent in the stage, N_i."),
            stage_limit_env_steps: whole(
                "stage_limit_env_steps",
                "Env steps the stage may last, M_i; 0 for none.",
            ),
            policy_version: whole("policy_version", "Counter of the newest policy that was broadcast."),
            evaluations: counter("evaluations_total", "Evaluations reported since this process started."),
            evaluations_outstanding: whole(
                "evaluations_outstanding",
                "Evaluations offered and not yet reported.",
            ),
            evaluation_return_mean: gauge("evaluation_return_mean", "Mean return of the newest evaluation."),
            evaluation_return_min: gauge("evaluation_return_min", "Minimum return of the newest evaluation."),
            evaluation_rise_rate: gauge(
                "evaluation_rise_rate",
                "Share of the newest evaluation's falls from which it rises.",
            ),
            evaluation_stand_rate: gauge(
                "evaluation_stand_rate",
                "Share of the newest evaluation's falls after which it stands.",
            ),
            promotions: counter("promotions_total", "Stages passed since this process started."),
            checkpoints: counter("checkpoints_total", "Checkpoints written since this process started."),
            checkpoint_seconds: seconds("checkpoint_seconds", "Time to write a checkpoint, beside training."),
            filling: whole(
                "filling",
                "1 while the replay fills before the updates of a trained actor go on.",
            ),
            finished: whole("finished", "1 once training is over."),
        }
    }

    /// Adds the time of an update: until its batch was ready, and where `phases` has more than `before`.
    pub(crate) fn phases(&self, batch: f64, before: Phases, phases: Phases) {
        let add = |phase: &str, seconds: f64| self.phases.with_label_values(&[phase]).inc_by(seconds);
        add("batch", batch);
        add("critics", phases.critics - before.critics);
        add("actor", phases.actor - before.actor);
        add("optimizer", phases.optimizer - before.optimizer);
    }

    pub(crate) fn norms(&self, norms: &Norms) {
        for (network, [weight, gradient]) in [("actor", norms.actor), ("critics", norms.critics)] {
            self.weight_norm.with_label_values(&[network]).set(weight);
            self.gradient_norm.with_label_values(&[network]).set(gradient);
        }
    }

    pub(crate) fn losses(&self, losses: &Losses) {
        self.critic_loss.set(losses.critic);
        self.actor_loss.set(losses.actor);
        self.temperature.set(losses.temperature);
        self.entropy.set(losses.entropy);
        self.q.set(losses.q);
    }
}
