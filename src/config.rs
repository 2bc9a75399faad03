//! The configuration of a run: one file for all roles, made of one table a room.

mod explained;
mod layers;

use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use documented::DocumentedFieldsOpt;
use getup_actor::config::ActorConfig;
use getup_actor::explore::BetaDraw;
use getup_learner::config::{CurriculumConfig, EvaluationConfig, LearnerConfig, SacConfig};
use getup_proto::{ColumnSpec, Rows, RunSpec, columns};
use getup_replay::{ItemSelector, Remover, ReplayConfig, SyncMode};
use getup_sim::{GetUp, Task, TaskConfig};
use getup_telemetry::TracesConfig;
use getup_transport::SecurityConfig;
use serde::{Deserialize, Serialize};

pub(crate) use explained::{Setting, explained};
pub(crate) use layers::Layers;

/// The format of configuration files that this program writes and reads.
const FORMAT: u32 = 1;

/// Everything a run depends on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, DocumentedFieldsOpt)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct Config {
    /// The format of this file.
    pub(crate) format: u32,
    /// The preset it began as.
    pub(crate) preset: String,
    /// The run's name; roles of different runs refuse each other.
    pub(crate) run: String,
    /// Every random draw comes from it; those of an actor that is a process of its own, from it and the id of its start.
    pub(crate) seed: u64,
    /// Env steps of the whole run; 0 lets the curriculum end it.
    pub(crate) steps: u64,
    pub(crate) task: TaskConfig,
    pub(crate) actor: ActorConfig,
    pub(crate) replay: ReplayTable,
    pub(crate) sac: SacConfig,
    pub(crate) curriculum: CurriculumConfig,
    pub(crate) evaluation: EvaluationConfig,
    pub(crate) learner: LearnerConfig,
    pub(crate) network: NetworkConfig,
    pub(crate) security: SecurityConfig,
    pub(crate) traces: TracesConfig,
}

/// The replay's own settings; when it may be sampled follows from `[sac]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, DocumentedFieldsOpt)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct ReplayTable {
    /// Transitions that can be sampled.
    pub(crate) capacity: usize,
    /// Transitions are drawn in proportion to their last error to this power; 0 draws them all alike.
    pub(crate) priority_exponent: f64,
    /// What an acknowledged segment survives: `process` (a kill) or `data` (a power loss too).
    pub(crate) sync: SyncMode,
    /// What leaves when there are more: `fifo`, the oldest, or `{ lowest_priority = { window = 4 } }`, what has the lowest
    /// priorities; the log then keeps `window` times the capacity.
    pub(crate) remover: Remover,
}

impl Default for ReplayTable {
    fn default() -> Self {
        let ReplayConfig { capacity, remover, sync, .. } = ReplayConfig::default();
        Self { capacity, priority_exponent: 0.0, sync, remover }
    }
}

/// Where the roles listen, and where they find each other.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, DocumentedFieldsOpt)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct NetworkConfig {
    /// The replay's gRPC address: it listens there, the others connect there. Of several replays all, separated by
    /// commas; `getup replay --shard N` says which one is which.
    pub(crate) replay: String,
    /// The learner's gRPC address, likewise.
    pub(crate) learner: String,
    /// Where an actor serves gRPC health; port 0 takes any.
    pub(crate) actor: String,
    /// Where a replay serves `/metrics`; port 0 takes any.
    pub(crate) replay_metrics: String,
    /// Where the learner does, and `getup train`.
    pub(crate) learner_metrics: String,
    /// Where an actor does.
    pub(crate) actor_metrics: String,
    /// Connections that a role's gRPC port takes.
    pub(crate) connections: usize,
    /// Those that it takes from one address: actors behind one address share it.
    pub(crate) connections_per_address: usize,
}

/// Where this machine reaches a service of this address: one that listens everywhere is here too, under the name that is in
/// every certificate.
pub(crate) fn reached_at(address: &str) -> String {
    let reached = |address: &str| match address.rsplit_once(':') {
        Some(("0.0.0.0" | "[::]", port)) => format!("localhost:{port}"),
        _ => address.to_owned(),
    };
    address.split(',').map(|address| reached(address.trim())).collect::<Vec<_>>().join(",")
}

/// Refuses what is no HOST:PORT, which would be found out by each role in its own way.
fn check_address(key: &str, address: &str) -> Result<()> {
    let parts = address.trim_end_matches('/').rsplit_once(':').filter(|(host, _)| !host.is_empty());
    let is_address = parts.is_some_and(|(_, port)| port.parse::<u16>().is_ok());
    ensure!(is_address, "network.{key} = {address:?}: HOST:PORT, such as replay:7401 or 127.0.0.1:9401");
    Ok(())
}

impl NetworkConfig {
    /// The addresses of all replays.
    pub(crate) fn replays(&self) -> Vec<String> {
        self.replay.split(',').map(|address| address.trim().to_owned()).collect()
    }

    fn validate(&self) -> Result<()> {
        ensure!(
            self.connections >= 1 && self.connections_per_address >= 1,
            "network.connections = {}, network.connections_per_address = {}: at least 1 each",
            self.connections,
            self.connections_per_address
        );
        let replays = self.replays();
        for (index, address) in replays.iter().enumerate() {
            ensure!(
                !address.is_empty() && !replays[..index].contains(address),
                "network.replay = {:?}: one address of each replay, such as replay-0:7401,replay-1:7401",
                self.replay
            );
            check_address("replay", address)?;
        }
        for (key, address) in [
            ("learner", &self.learner),
            ("actor", &self.actor),
            ("replay_metrics", &self.replay_metrics),
            ("learner_metrics", &self.learner_metrics),
            ("actor_metrics", &self.actor_metrics),
        ] {
            check_address(key, address)?;
        }
        Ok(())
    }
}

impl Default for NetworkConfig {
    fn default() -> Self {
        let local = |port: u16| format!("127.0.0.1:{port}");
        Self {
            replay: local(7401),
            learner: local(7402),
            actor: local(0),
            replay_metrics: local(9401),
            learner_metrics: local(9402),
            actor_metrics: local(0),
            connections: 1024,
            connections_per_address: 256,
        }
    }
}

impl Default for Config {
    fn default() -> Self {
        Self {
            format: FORMAT,
            preset: "laptop".into(),
            run: "getup".into(),
            seed: 0,
            steps: 0,
            task: TaskConfig::default(),
            actor: ActorConfig::default(),
            replay: ReplayTable::default(),
            sac: SacConfig::default(),
            curriculum: CurriculumConfig::default(),
            evaluation: EvaluationConfig::default(),
            learner: LearnerConfig::default(),
            network: NetworkConfig::default(),
            security: SecurityConfig::default(),
            traces: TracesConfig::default(),
        }
    }
}

/// Where a role's configuration comes from: what every role's command line shares.
#[derive(Args, Clone, Debug, Default)]
pub(crate) struct ConfigArgs {
    /// Settings to start from: `smoke` (a minute, for tests), `laptop` (two to eight cores), `standing` (with `--from`:
    /// what gets up learns to stay up), `paper` (Table 1 of the paper to the letter), `gpu`. [default: laptop]
    #[arg(long, value_name = "NAME")]
    pub(crate) preset: Option<String>,
    /// A configuration file over the preset, such as a run's own config.toml.
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<std::path::PathBuf>,
    /// One setting over everything else, such as `--set sac.batch=256`, or `--set traces.endpoint=http://HOST:4317` for
    /// traces; may be repeated. `getup settings` lists them all; GETUP_SAC__BATCH=256 in the environment does the same.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub(crate) set: Vec<String>,
}

impl ConfigArgs {
    /// Preset, file, environment (`GETUP_SAC__BATCH=256`), `--set`: each over the ones before.
    pub(crate) fn load(&self) -> Result<Config> {
        let mut layers = Layers::new()?;
        let file = self.config.as_deref().map(read_table).transpose()?;
        let from_file = file.as_ref().and_then(|table| table.get("preset")).and_then(|value| value.as_str());
        if let (Some(asked), Some(made)) = (&self.preset, from_file) {
            ensure!(
                asked == made,
                "--preset {asked}: the configuration was made from preset {made}; leave one out"
            );
        }
        let from_environment = match std::env::var(layers::PRESET_VARIABLE) {
            Ok(preset) => Some(preset),
            Err(std::env::VarError::NotPresent) => None,
            Err(error) => bail!("{}: {error}", layers::PRESET_VARIABLE),
        };
        let preset = self.preset.as_deref().or(from_file).or(from_environment.as_deref());
        layers.preset(preset.unwrap_or("laptop"))?;
        if let (Some(path), Some(table)) = (&self.config, file) {
            layers.overlay(&path.display().to_string(), table)?;
        }
        layers.environment(std::env::vars_os())?;
        for assignment in &self.set {
            layers.set("--set", assignment)?;
        }
        layers.finish()
    }
}

fn read_table(path: &Path) -> Result<toml::Table> {
    let text = std::fs::read_to_string(path)
        .with_context(|| format!("cannot read the configuration {}", path.display()))?;
    text.parse().with_context(|| format!("{} is not TOML", path.display()))
}

impl Config {
    /// Refuses settings that cannot work, alone or together.
    pub(crate) fn validate(&self) -> Result<()> {
        ensure!(
            self.format == FORMAT,
            "format = {}: this getup reads configurations of format {FORMAT}; use the getup that wrote it",
            self.format
        );
        self.task.validate()?;
        self.actor.validate()?;
        self.sac.validate()?;
        let exponent = self.replay.priority_exponent;
        ensure!(
            exponent.is_finite() && exponent >= 0.0,
            "replay.priority_exponent = {exponent}: at least 0, and 0 for uniform draws"
        );
        ensure!(
            self.sac.uniform_steps <= self.replay.capacity as u64,
            "sac.uniform_steps = {}: at most replay.capacity ({}), or they would never all be there",
            self.sac.uniform_steps,
            self.replay.capacity
        );
        self.network.validate()?;
        self.security.validate()?;
        self.traces.validate()?;
        self.replay_config(self.network.replays().len()).validate_for(&self.run_spec()?)?;
        self.curriculum.validate()?;
        self.evaluation.validate()?;
        self.learner.validate()?;
        ensure!(
            !self.run.is_empty() && self.run.len() <= 128,
            "run = {:?}: a run's name has 1 to 128 bytes",
            self.run
        );
        ensure!(
            !self.run.contains('/') && self.run != "." && self.run != "..",
            "run = {:?}: a name without a `/`; `getup train` and `getup learner` take its folder by --run",
            self.run
        );
        Ok(())
    }

    /// All settings, in the order of the file.
    pub(crate) fn settings(&self) -> Result<Vec<Setting>> {
        let table = toml::Table::try_from(self);
        table
            .and_then(|table| Setting::all("", table))
            .context("the configuration is not expressible in TOML")
    }

    /// The file's text, with what each setting means.
    #[cfg(any(test, feature = "learner"))]
    pub(crate) fn to_toml(&self) -> Result<String> {
        Ok(explained(&self.settings()?))
    }

    /// The settings of one of so many replays: they are sampled as often as `[sac]` says, once its uniform steps are
    /// there, each with its part of them.
    pub(crate) fn replay_config(&self, replays: usize) -> ReplayConfig {
        let samples_per_insert = self.sac.updates_per_step * self.sac.batch as f64;
        let min_size = self.sac.uniform_steps.div_ceil(replays as u64).max(1);
        let middle = min_size as f64 * samples_per_insert;
        let segment = self.actor.segment_steps as f64 * samples_per_insert;
        ReplayConfig {
            capacity: self.replay.capacity,
            sync: self.replay.sync,
            min_size,
            samples_per_insert: Some(samples_per_insert),
            // A tenth of the first minibatches, and room for two of the longest segments and for a minibatch.
            error_buffer: Some((0.1 * middle).max(2.0 * segment).max(2.0 * self.sac.batch as f64)),
            sampler: match self.replay.priority_exponent {
                0.0 => ItemSelector::Uniform,
                exponent => ItemSelector::Prioritized { exponent },
            },
            max_times_sampled: None,
            remover: self.replay.remover,
        }
    }

    /// What the run's transitions look like.
    pub(crate) fn run_spec(&self) -> Result<RunSpec> {
        let task = GetUp::new(&self.task, self.control_limit())?;
        let column = |name: &str, width, rows| ColumnSpec { name: name.into(), width, rows };
        Ok(RunSpec {
            run: self.run.clone(),
            // Whoever simulates otherwise is refused: transitions and evaluations must be of one kind.
            task: format!(
                "{}/{}, {} Hz, falls of {} steps with {}, {} steps{}, stand {:?}, clamp {}",
                self.task.name,
                self.task.character,
                self.task.physics_hz,
                self.task.ragdoll_steps,
                self.task.ragdoll_std,
                self.task.episode_steps,
                if self.task.fall_ends { " or to a fall" } else { "" },
                self.task.stand,
                self.control_limit()
            ),
            columns: vec![
                column(columns::OBSERVATION, task.observation_width(), Rows::StepsPlusOne),
                column(columns::ACTION, task.action_width(), Rows::Steps),
                column(columns::REWARD, 1, Rows::Steps),
                column(columns::BETA, 1, Rows::Once),
            ],
            max_segment_steps: self.actor.segment_steps,
        })
    }

    /// How an episode's β̂ is drawn around β^i.
    pub(crate) fn beta_draw(&self) -> BetaDraw {
        let CurriculumConfig { beta_std, beta_floor, .. } = self.curriculum;
        BetaDraw { std: beta_std, floor: beta_floor, ceiling: self.control_limit() }
    }

    /// The clamp of the actuators: β̂ above 1 widens it.
    pub(crate) fn control_limit(&self) -> f64 {
        self.curriculum.beta_start.max(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use getup_learner::config::{NetworkKind, Precision};

    fn load(arguments: &[&str], environment: &[(&str, &str)]) -> Result<Config> {
        let mut layers = Layers::new()?;
        layers.preset("paper")?;
        layers.environment(environment.iter().map(|(key, value)| (key.into(), value.into())))?;
        for assignment in arguments {
            layers.set("--set", assignment)?;
        }
        layers.finish()
    }

    #[test]
    fn every_preset_is_valid() {
        for preset in layers::PRESETS {
            let arguments = ConfigArgs { preset: Some(preset.0.into()), ..ConfigArgs::default() };
            let config = arguments.load().unwrap();
            assert_eq!(config.preset, preset.0);
            let text = config.to_toml().unwrap();
            assert_eq!(toml::from_str::<Config>(&text).unwrap(), config);
        }
    }

    #[test]
    fn the_paper_preset_is_table_1() {
        let config = load(&[], &[]).unwrap();
        let sac = &config.sac;
        assert_eq!((sac.hidden.as_slice(), sac.critics, sac.batch), ([1024, 1024].as_slice(), 2, 1024));
        assert_eq!((sac.actor_lr, sac.critic_lr, sac.temperature_lr), (1e-5, 1e-4, 1e-4));
        assert_eq!((sac.gamma, sac.tau, sac.initial_temperature, sac.n_step), (0.97, 0.005, 0.1, 1));
        assert_eq!(
            (sac.updates_per_step, sac.uniform_steps, sac.normalize_observations),
            (1.0, 10_000, false)
        );
        assert_eq!(sac.target_entropy.nats(21), -21.0);
        assert_eq!(config.replay.capacity, 1_000_000);
        assert!(config.actor.store_limp);
        let curriculum = &config.curriculum;
        assert_eq!((curriculum.beta_start, curriculum.beta_floor, curriculum.decay), (1.0, 0.4, 0.95));
        assert_eq!((curriculum.omega, curriculum.beta_std), (60.0, 0.04));
        assert_eq!((curriculum.n_min, curriculum.n_max), (300_000, 800_000));
        assert_eq!((config.evaluation.every, config.evaluation.episodes), (20_000, 10));
        assert_eq!(config.task, TaskConfig::default());
        // What the recipes add is off.
        assert_eq!((sac.network, sac.precision), (NetworkKind::Mlp, Precision::Fp32));
        assert_eq!(
            (sac.weight_decay, sac.temperature_floor, sac.lr_steps, sac.critics_first, sac.policy_delay),
            (0.0, 0.0, 0, 0, 1)
        );
        assert_eq!((config.actor.fall_pool, config.actor.noise_hold), (0, 1));
        assert_eq!((curriculum.high_starts, curriculum.fixed, config.task.fall_ends), (0.0, false, false));
    }

    #[test]
    fn later_layers_win() {
        let environment =
            [("GETUP_SAC__BATCH", "64"), ("GETUP_SEED", "7"), ("GETUP_UPDATE_DOCS", "1"), ("HOME", "/")];
        let config =
            load(&["sac.batch=32", "sac.hidden=[8, 8]", "run=arms", "sac.target_entropy=-4"], &environment);
        let config = config.unwrap();
        assert_eq!((config.sac.batch, config.seed, config.run.as_str()), (32, 7, "arms"));
        assert_eq!((config.sac.hidden, config.sac.target_entropy.nats(21)), (vec![8, 8], -4.0));
    }

    #[test]
    fn what_the_compose_files_are_told_by_the_environment_is_no_unknown_setting() {
        let files = [include_str!("../deploy/compose.yaml"), include_str!("../deploy/compose.bench.yaml")];
        let names = files.iter().flat_map(|file| file.split("${").skip(1)).map(|rest| {
            let end = rest.find(|char: char| !char.is_ascii_uppercase() && char != '_');
            &rest[..end.unwrap_or(rest.len())]
        });
        let names: std::collections::BTreeSet<&str> = names.collect();
        assert!(names.contains("GETUP_GRAFANA_PORT") && names.contains("GETUP_ACTOR_CPUS"), "{names:?}");
        for name in names {
            load(&[], &[(name, "1")]).unwrap();
        }
        // A setting of such a table is one still.
        assert_eq!(load(&[], &[("GETUP_ACTOR__LANES", "3")]).unwrap().actor.lanes, 3);
        for misspelled in ["GETUP_ACTOR__LANS", "GETUP_ACTOR_LANES", "GETUP_LEARNER_DEVICE"] {
            assert!(load(&[], &[(misspelled, "3")]).is_err(), "{misspelled}");
        }
    }

    #[test]
    fn what_leaves_a_full_replay_is_a_setting_and_stays_one_in_the_runs_folder() {
        let by_priority =
            ["replay.priority_exponent=0.6", "replay.remover={ lowest_priority = { window = 2 } }"];
        let lowest = Remover::LowestPriority { window: 2 };
        let config = load(&by_priority, &[]).unwrap();
        assert_eq!((config.replay.remover, config.replay_config(1).remover), (lowest, lowest));
        assert_eq!(toml::from_str::<Config>(&config.to_toml().unwrap()).unwrap(), config);
        // Later layers win, part by part or as a whole.
        let longer = [by_priority[0], by_priority[1], "replay.remover.lowest_priority.window=8"];
        let remover = |arguments: &[&str]| load(arguments, &[]).unwrap().replay.remover;
        assert_eq!(remover(&longer), Remover::LowestPriority { window: 8 });
        assert_eq!(remover(&[by_priority[1], "replay.remover=fifo"]), Remover::Fifo);
        let refused = format!("{:#}", load(&by_priority[1..], &[]).unwrap_err());
        assert!(refused.contains("or a run's replay.priority_exponent"), "{refused}");
    }

    #[test]
    fn an_unknown_key_suggests_the_nearest_and_a_bad_value_is_named() {
        let error = |arguments: &[&str]| format!("{:#}", load(arguments, &[]).unwrap_err());
        assert_eq!(error(&["sac.bach=3"]), "--set: unknown setting sac.bach; did you mean sac.batch?");
        assert!(error(&["sac=3"]).contains("sac is a table"), "{}", error(&["sac=3"]));
        assert!(error(&["batch"]).contains("KEY=VALUE"));
        let text = error(&["sac.batch=many"]);
        assert!(text.contains("sac.batch") && text.contains("many"), "{text}");
        assert!(error(&["curriculum.n_min=900000"]).contains("curriculum.n_min = 900000"));
        let text = format!("{:#}", load(&[], &[("GETUP_SAC__BACH", "3")]).unwrap_err());
        assert_eq!(text, "GETUP_SAC__BACH: unknown setting sac.bach; did you mean sac.batch?");
        assert!(Layers::new().unwrap().preset("labtop").unwrap_err().to_string().contains("laptop"));
    }
}
