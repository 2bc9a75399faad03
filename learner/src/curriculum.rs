//! The strong-to-weak torque curriculum (§5, Algorithm 1), as a state machine: an evaluation in, a decision out.
//!
//! Stage i trains with the torque-limit multiplier β^i. An evaluation whose minimum return exceeds ω passes the
//! stage and β becomes β·decay, never under the floor; a pass at the floor ends the curriculum. Stage 0 is the
//! discovery and has no limit, and neither has a stage that follows one above 1. A later stage may last M_i = clip(1.5·N_{i−1}, N_min, N_max) env steps; an
//! evaluation past that without a pass ends the curriculum, with β of the last stage that passed.
//!
//! Evaluations must be given in the order of their versions. One of an earlier stage counts for nothing.
//!
//! With `fixed`, β stays: no evaluation promotes, the best one is kept (most falls that end standing, then the mean
//! return), and training ends when none was better for `patience` env steps.

use serde::{Deserialize, Serialize};

use crate::config::CurriculumConfig;

/// What the curriculum must know of an evaluation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StageResult {
    /// The stage that the evaluated version belonged to.
    pub stage: u32,
    /// Env steps of the run when that version was made.
    pub env_steps: u64,
    /// The minimum return over the episodes.
    pub min_return: f64,
    /// Their mean.
    pub mean_return: f64,
    /// Share of them that end standing.
    pub stand_rate: f64,
}

/// What follows from an evaluation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Decision {
    /// The evaluation was of an earlier stage, or the curriculum is over: recorded, never counted.
    Ignore,
    /// The stage goes on.
    Stay,
    /// β is fixed, and no evaluation before was as good.
    Better,
    /// The stage is passed and the next one begins.
    Promote {
        /// β of the stage that passed.
        passed: f64,
        /// β of the stage that begins.
        next: f64,
    },
    /// The curriculum is over.
    Finish(Outcome),
}

/// How the curriculum ended.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "kind")]
pub enum Outcome {
    /// The floor was passed.
    FloorPassed {
        /// The floor.
        beta: f64,
    },
    /// A stage outlasted its limit.
    StageOutlasted {
        /// β of the last stage that passed.
        beta: f64,
    },
    /// A fixed β's evaluations no longer got better.
    Settled {
        /// That β.
        beta: f64,
    },
}

impl Outcome {
    /// β of the last stage that passed, which is π_weak's; or the fixed β.
    pub fn beta(self) -> f64 {
        match self {
            Self::FloorPassed { beta } | Self::StageOutlasted { beta } | Self::Settled { beta } => beta,
        }
    }
}

/// The curriculum's state; it is part of the checkpoint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Curriculum {
    config: CurriculumConfig,
    stage: u32,
    beta: f64,
    /// Env steps of the run when this stage began.
    stage_start: u64,
    /// M_i; none in the discovery.
    stage_limit: Option<u64>,
    /// β of the last stage that passed.
    passed: Option<f64>,
    /// Stages passed at a β of 1 or less.
    #[serde(default)]
    faded: u32,
    /// Of a fixed β.
    #[serde(default)]
    best: Option<Best>,
    outcome: Option<Outcome>,
}

/// The best evaluation under a fixed β.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Best {
    stand_rate: f64,
    mean_return: f64,
    /// Env steps of the run when its version was made.
    env_steps: u64,
}

impl Curriculum {
    /// Stage 0, at `beta_start`.
    pub fn new(config: CurriculumConfig) -> Self {
        let beta = config.beta_start;
        Self {
            config,
            stage: 0,
            beta,
            stage_start: 0,
            stage_limit: None,
            passed: None,
            faded: 0,
            best: None,
            outcome: None,
        }
    }

    /// The same state under other settings: a resumed run may change them.
    pub fn with_config(self, config: CurriculumConfig) -> Self {
        Self { config, ..self }
    }

    /// i, from 0.
    pub fn stage(&self) -> u32 {
        self.stage
    }

    /// β^i; once the curriculum is over, β of the last stage that passed.
    pub fn beta(&self) -> f64 {
        self.outcome.map_or(self.beta, Outcome::beta)
    }

    /// β^i of the stage that is trained, or was at the end.
    pub fn stage_beta(&self) -> f64 {
        self.beta
    }

    /// M_i, in env steps; none in the discovery.
    pub fn stage_limit(&self) -> Option<u64> {
        self.stage_limit
    }

    /// N_i so far: env steps spent in this stage when the run is at `env_steps`.
    pub fn stage_steps(&self, env_steps: u64) -> u64 {
        env_steps.saturating_sub(self.stage_start)
    }

    /// So many env steps count neither for the stage nor for a fixed β's patience: the policy did not change.
    pub fn pause(&mut self, env_steps: u64) {
        self.stage_start += env_steps;
        if let Some(best) = &mut self.best {
            best.env_steps += env_steps;
        }
    }

    /// Share of the episodes that begin high in this stage.
    pub fn high_starts(&self) -> f64 {
        let CurriculumConfig { high_starts, high_starts_fade, .. } = self.config;
        (high_starts - high_starts_fade * f64::from(self.faded)).max(0.0)
    }

    /// β of the last stage that passed; none before the first promotion.
    pub fn passed(&self) -> Option<f64> {
        self.passed
    }

    /// How the curriculum ended; none while it runs.
    pub fn outcome(&self) -> Option<Outcome> {
        self.outcome
    }

    /// Takes an evaluation, in version order. `now` are the run's env steps at this moment: a next stage begins
    /// there, while N_i is counted to the evaluated version.
    pub fn report(&mut self, result: StageResult, now: u64) -> Decision {
        if self.outcome.is_some() || result.stage != self.stage {
            return Decision::Ignore;
        }
        if self.config.fixed {
            return self.hold(result);
        }
        let steps = self.stage_steps(result.env_steps);
        let early = self.beta > 1.0 && result.mean_return > self.config.omega_above_one;
        if early || result.min_return > self.config.omega {
            self.pass(steps, now)
        } else if self.stage_limit.is_some_and(|limit| steps > limit) {
            // A stage with a limit follows one that passed.
            let beta = self.passed.unwrap_or(self.beta);
            self.finish(Outcome::StageOutlasted { beta })
        } else {
            Decision::Stay
        }
    }

    /// Keeps the best of a fixed β's evaluations.
    fn hold(&mut self, StageResult { stand_rate, mean_return, env_steps, .. }: StageResult) -> Decision {
        let Some(best) =
            self.best.filter(|best| (stand_rate, mean_return) <= (best.stand_rate, best.mean_return))
        else {
            self.best = Some(Best { stand_rate, mean_return, env_steps });
            return Decision::Better;
        };
        let patience = self.config.patience;
        if patience > 0 && env_steps.saturating_sub(best.env_steps) >= patience {
            return self.finish(Outcome::Settled { beta: self.beta });
        }
        Decision::Stay
    }

    fn pass(&mut self, steps: u64, now: u64) -> Decision {
        let passed = self.beta;
        self.passed = Some(passed);
        self.faded += u32::from(passed <= 1.0);
        if passed <= self.config.beta_floor {
            return self.finish(Outcome::FloorPassed { beta: passed });
        }
        self.stage += 1;
        self.beta = self.next_beta();
        self.stage_start = now;
        // From above 1 the discovery goes on until β = 1 is passed.
        self.stage_limit = (passed <= 1.0).then(|| {
            let limit = (steps as f64 * 1.5).round() as u64;
            limit.clamp(self.config.n_min, self.config.n_max)
        });
        Decision::Promote { passed, next: self.beta }
    }

    fn next_beta(&self) -> f64 {
        if self.beta > 1.0 {
            return (self.beta * self.config.decay_above_one).max(1.0);
        }
        (self.beta * self.config.decay).max(self.config.beta_floor)
    }

    fn finish(&mut self, outcome: Outcome) -> Decision {
        self.outcome = Some(outcome);
        Decision::Finish(outcome)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn paper() -> Curriculum {
        Curriculum::new(CurriculumConfig::default())
    }

    fn result(stage: u32, env_steps: u64, min_return: f64) -> StageResult {
        StageResult { stage, env_steps, min_return, mean_return: min_return, stand_rate: 0.0 }
    }

    #[test]
    fn a_minimum_over_omega_promotes_and_one_at_omega_does_not() {
        let mut curriculum = paper();
        assert_eq!(curriculum.report(result(0, 20_000, 60.0), 20_500), Decision::Stay);
        assert_eq!(
            curriculum.report(result(0, 40_000, 60.1), 40_500),
            Decision::Promote { passed: 1.0, next: 0.95 }
        );
        assert_eq!((curriculum.stage(), curriculum.beta(), curriculum.passed()), (1, 0.95, Some(1.0)));
        assert_eq!(curriculum.stage_steps(40_500), 0);
    }

    #[test]
    fn discovery_has_no_limit() {
        let mut curriculum = paper();
        assert_eq!(curriculum.report(result(0, u64::MAX, 0.0), u64::MAX), Decision::Stay);
        assert_eq!(curriculum.stage_limit(), None);
    }

    #[test]
    fn a_stage_may_last_one_and_a_half_times_the_last_one_within_its_bounds() {
        for (steps, limit) in [(100_000, 300_000), (400_000, 600_000), (1_000_000, 800_000)] {
            let mut curriculum = paper();
            curriculum.report(result(0, steps, 61.0), steps);
            assert_eq!(curriculum.stage_limit(), Some(limit));
        }
    }

    #[test]
    fn a_stage_past_its_limit_ends_the_curriculum_with_the_beta_that_passed_last() {
        let mut curriculum = paper();
        curriculum.report(result(0, 100_000, 61.0), 101_000);
        curriculum.report(result(1, 200_000, 61.0), 201_000);
        assert_eq!(curriculum.report(result(2, 501_000, 59.0), 502_000), Decision::Stay);
        let ended = Decision::Finish(Outcome::StageOutlasted { beta: 0.95 });
        assert_eq!(curriculum.report(result(2, 501_001, 59.0), 502_000), ended);
        assert_eq!((curriculum.beta(), curriculum.passed()), (0.95, Some(0.95)));
        assert_eq!(curriculum.report(result(2, 600_000, 99.0), 600_000), Decision::Ignore);
    }

    #[test]
    fn a_pass_beats_an_exceeded_limit() {
        let mut curriculum = paper();
        curriculum.report(result(0, 100_000, 61.0), 100_000);
        let decision = curriculum.report(result(1, 900_000, 61.0), 900_000);
        assert!(matches!(decision, Decision::Promote { .. }));
    }

    #[test]
    fn the_steps_of_a_stage_are_counted_to_the_evaluated_version() {
        let mut curriculum = paper();
        curriculum.report(result(0, 100_000, 61.0), 100_000);
        // The run is past the limit, the version that was evaluated is not.
        assert_eq!(curriculum.report(result(1, 400_000, 0.0), 450_000), Decision::Stay);
    }

    #[test]
    fn a_result_of_an_earlier_stage_is_never_counted() {
        let mut curriculum = paper();
        curriculum.report(result(0, 100_000, 61.0), 100_000);
        let before = curriculum.clone();
        assert_eq!(curriculum.report(result(0, 900_000, 99.0), 900_000), Decision::Ignore);
        assert_eq!(curriculum, before);
    }

    #[test]
    fn from_above_one_a_stage_at_exactly_one_exists() {
        let mut curriculum = Curriculum::new(CurriculumConfig {
            beta_start: 1.6,
            decay: 0.7,
            decay_above_one: 0.7,
            ..CurriculumConfig::default()
        });
        let mut betas = vec![curriculum.beta()];
        while curriculum.outcome().is_none() {
            curriculum.report(result(curriculum.stage(), 0, 61.0), 0);
            betas.push(curriculum.beta());
        }
        let rounded: Vec<f64> = betas.iter().map(|beta| (beta * 1e4).round() / 1e4).collect();
        assert_eq!(rounded, [1.6, 1.12, 1.0, 0.7, 0.49, 0.4, 0.4]);
        assert_eq!(curriculum.outcome(), Some(Outcome::FloorPassed { beta: 0.4 }));
    }

    #[test]
    fn above_one_a_mean_over_its_own_threshold_passes_and_at_one_it_does_not() {
        let mut curriculum = Curriculum::new(CurriculumConfig {
            beta_start: 1.05,
            decay_above_one: 0.9,
            omega_above_one: 35.0,
            ..CurriculumConfig::default()
        });
        let result = |stage, mean_return| StageResult {
            stage,
            env_steps: 0,
            min_return: 0.0,
            mean_return,
            stand_rate: 0.0,
        };
        assert_eq!(curriculum.report(result(0, 35.0), 0), Decision::Stay);
        assert_eq!(curriculum.report(result(0, 35.1), 0), Decision::Promote { passed: 1.05, next: 1.0 });
        assert_eq!(curriculum.report(result(1, 59.0), 0), Decision::Stay);
    }

    #[test]
    fn a_fixed_beta_keeps_its_best_evaluation_and_ends_when_none_was_better_for_long() {
        let mut curriculum = Curriculum::new(CurriculumConfig {
            fixed: true,
            patience: 30_000,
            ..CurriculumConfig::default()
        });
        let mut report = |env_steps, stand_rate, mean_return| {
            curriculum.report(
                StageResult { stage: 0, env_steps, min_return: 70.0, mean_return, stand_rate },
                env_steps,
            )
        };
        assert_eq!(report(0, 0.0, 5.0), Decision::Better);
        assert_eq!(report(10_000, 0.0, 9.0), Decision::Better);
        assert_eq!(report(20_000, 0.5, 7.0), Decision::Better, "standing counts before the return");
        assert_eq!(report(30_000, 0.5, 7.0), Decision::Stay);
        assert_eq!(report(40_000, 0.4, 90.0), Decision::Stay);
        assert_eq!(report(50_000, 0.4, 90.0), Decision::Finish(Outcome::Settled { beta: 1.0 }));
        assert_eq!(report(60_000, 1.0, 90.0), Decision::Ignore);
        assert_eq!((curriculum.beta(), curriculum.stage()), (1.0, 0));
    }

    #[test]
    fn env_steps_from_which_nothing_is_learned_outlast_no_stage() {
        let mut curriculum = paper();
        curriculum.report(result(0, 100_000, 61.0), 100_000);
        assert_eq!(curriculum.stage_limit(), Some(300_000));
        // A replay is filled again, after two thirds of the stage.
        curriculum.pause(150_000);
        assert_eq!(curriculum.stage_steps(450_000), 200_000);
        assert_eq!(curriculum.report(result(1, 460_000, 10.0), 460_000), Decision::Stay);
        let outlasted = Decision::Finish(Outcome::StageOutlasted { beta: 1.0 });
        assert_eq!(curriculum.report(result(1, 560_000, 10.0), 560_000), outlasted);
        assert_eq!((curriculum.beta(), curriculum.stage_beta()), (1.0, 0.95));
    }

    #[test]
    fn high_starts_fade_with_the_promotions_from_one_on() {
        let config = CurriculumConfig {
            beta_start: 1.6,
            decay_above_one: 0.9,
            high_starts: 0.25,
            ..CurriculumConfig::default()
        };
        let mut curriculum = Curriculum::new(config);
        let mut shares = Vec::new();
        while curriculum.beta() > 0.8 {
            shares.push((curriculum.beta() > 1.0, (curriculum.high_starts() * 100.0).round()));
            curriculum.report(result(curriculum.stage(), 0, 61.0), 0);
        }
        let at_one = shares.iter().position(|(above, _)| !above).unwrap();
        assert!(shares[..=at_one].iter().all(|(_, share)| *share == 25.0), "{shares:?}");
        assert_eq!(
            shares[at_one + 1..].iter().map(|(_, share)| *share).collect::<Vec<_>>(),
            [15.0, 5.0, 0.0, 0.0]
        );
    }

    proptest! {
        #[test]
        fn beta_only_falls_stays_over_its_floor_and_never_skips_one(
            start in 0.4..2.0f64,
            floor in 0.1..0.4f64,
            decay in 0.5..0.99f64,
            decay_above_one in 0.5..0.99f64,
            returns in proptest::collection::vec((0.0..120.0f64, 1u64..200_000, 0u32..3), 1..200),
        ) {
            let config = CurriculumConfig {
                beta_start: start, beta_floor: floor, decay, decay_above_one, ..CurriculumConfig::default()
            };
            let mut curriculum = Curriculum::new(config);
            let mut now = 0;
            for (min_return, steps, age) in returns {
                now += steps;
                let before = curriculum.clone();
                let stage = curriculum.stage().saturating_sub(age);
                let decision = curriculum.report(result(stage, now, min_return), now);
                match decision {
                    Decision::Better => prop_assert!(false, "β is not fixed"),
                    Decision::Ignore | Decision::Stay => prop_assert_eq!(&curriculum, &before),
                    Decision::Promote { passed, next } => {
                        prop_assert!(min_return > 60.0 && stage == before.stage());
                        prop_assert!(next < passed && next >= floor);
                        prop_assert!(!(passed > 1.0 && next < 1.0));
                        prop_assert_eq!(curriculum.stage(), before.stage() + 1);
                        let limit = curriculum.stage_limit();
                        prop_assert_eq!(limit.is_none(), passed > 1.0);
                        prop_assert!(limit.is_none_or(|limit| (300_000..=800_000).contains(&limit)));
                    }
                    Decision::Finish(outcome) => {
                        prop_assert!(before.outcome().is_none());
                        prop_assert_eq!(Some(outcome.beta()), curriculum.passed());
                    }
                }
                let state = serde_json::to_string(&curriculum).unwrap();
                prop_assert_eq!(&serde_json::from_str::<Curriculum>(&state).unwrap(), &curriculum);
            }
        }
    }
}
