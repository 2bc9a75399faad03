//! Training where its disk or its replay fails: what is kept, and what others hear of it.

#![cfg(feature = "torch")]

mod toy;

use std::fs;
use std::sync::Arc;
use std::time::{Duration, Instant};

use getup_learner::checkpoint::Checkpoint;
use getup_learner::config::{CurriculumConfig, EvaluationConfig, LearnerConfig};
use getup_learner::hub::Hub;
use getup_learner::run_folder::RunFolder;
use getup_learner::trainer::{Start, TrainError, Trainer, TrainerConfig};
use getup_proto::v1;
use getup_replay::{
    LocalSource, Minibatch, MinibatchSource, ReplayConfig, ReplayMetrics, SampleError, SampleOptions, Store,
};
use getup_telemetry::{Registry, Shutdown, Waits};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use tch::Device;
use tempfile::TempDir;

/// A run of the toy task, in a folder of its own.
struct Run {
    dir: TempDir,
    hub: Arc<Hub>,
    trainer: Trainer,
}

impl Run {
    fn new(learner: LearnerConfig) -> Self {
        let (dir, registry) = (TempDir::new().unwrap(), Registry::new());
        let folder = RunFolder::new(dir.path());
        let waits = Waits::new(&registry);
        let hub = Arc::new(Hub::new(toy::spec(), vec![1, 2], Duration::from_secs(10), 1, waits));
        let trainer =
            Trainer::new(config(learner), folder, hub.clone(), 1, Start::Newest, Device::Cpu, &registry);
        Self { dir, hub, trainer: trainer.unwrap() }
    }

    fn folder(&self) -> RunFolder {
        RunFolder::new(self.dir.path())
    }

    /// In the place of the folder of checkpoints, so that none can be written.
    fn block_checkpoints(&self) {
        let folder = self.folder().checkpoints();
        fs::remove_dir_all(&folder).unwrap();
        fs::write(folder, "no folder").unwrap();
    }

    /// Reports an evaluation that is on offer.
    fn evaluate(&self, returns: [f64; 2]) {
        let beat = v1::HeartbeatRequest { actor: "actor".into(), idle: true, ..Default::default() };
        let lease = self.hub.heartbeat(beat, Instant::now()).unwrap().lease.unwrap().id;
        let episode = |episode_return| v1::EpisodeResult { episode_return, ..Default::default() };
        let episodes = returns.map(episode).to_vec();
        self.hub.report(v1::EvaluationReport { lease, actor: "actor".into(), episodes }).unwrap();
    }

    /// Stage and version of the policy that actors hear of.
    fn heard(&self) -> (u32, u64) {
        let policy = self.hub.subscribe(&toy::spec()).unwrap();
        let policy = policy.borrow();
        (policy.stage, policy.version.unwrap().counter)
    }
}

fn config(learner: LearnerConfig) -> TrainerConfig {
    TrainerConfig {
        run: "toy".into(),
        character: "point".into(),
        physics_hz: 200,
        seed: 1,
        replays: 1,
        steps: None,
        shape: toy::shape(),
        sac: toy::config(),
        curriculum: CurriculumConfig::default(),
        evaluation: EvaluationConfig { every: 1_000_000, ..EvaluationConfig::default() },
        learner: LearnerConfig { threads: 1, ..learner },
    }
}

/// Minibatches of the toy task, and then what a replay says that was started with other settings.
struct Refusing {
    minibatches: LocalSource,
    left: u64,
    _dir: TempDir,
}

impl Refusing {
    fn after(minibatches: u64) -> Self {
        let (dir, registry) = (TempDir::new().unwrap(), Registry::new());
        let (metrics, waits) = (ReplayMetrics::new(&registry), Waits::new(&registry));
        let settings = ReplayConfig { capacity: 4096, min_size: 1, ..ReplayConfig::default() };
        let store = Store::open(dir.path(), &toy::spec(), &settings, metrics, waits).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        store.append((1..=64).map(|sequence| toy::segment(sequence, &mut rng)).collect()).unwrap();
        let options = SampleOptions { batch: 64, n_step: 1, gamma: 0.8, seed: 2, segments: false };
        let source = LocalSource::new(Arc::new(store), options, "learner", Shutdown::new());
        Self { minibatches: source.unwrap(), left: minibatches, _dir: dir }
    }
}

impl MinibatchSource for Refusing {
    fn poll(&mut self, patience: Duration) -> Result<Option<Minibatch>, SampleError> {
        if self.left == 0 {
            let (endpoint, reason) = ("127.0.0.1:7401".into(), "another spec".into());
            return Err(SampleError::Refused { endpoint, reason });
        }
        self.left -= 1;
        self.minibatches.poll(patience)
    }

    fn update_priorities(&mut self, priorities: Vec<(u64, f32)>) -> Result<(), SampleError> {
        self.minibatches.update_priorities(priorities)
    }
}

#[test]
fn where_the_replay_refuses_to_go_on_what_was_learned_is_kept() {
    let mut run = Run::new(LearnerConfig { checkpoint_seconds: 3600.0, ..LearnerConfig::default() });
    let error = run.trainer.run(&mut Refusing::after(30), &Shutdown::new()).unwrap_err();
    assert!(matches!(error, TrainError::Sample(SampleError::Refused { .. })), "{error}");
    let kept = Checkpoint::newest(&run.folder().checkpoints()).unwrap().expect("a checkpoint");
    assert!(kept.file_name().ends_with("-000000000030.safetensors"), "{}", kept.file_name());
}

#[test]
fn nobody_hears_of_a_next_stage_that_is_not_on_disk() {
    let mut run = Run::new(LearnerConfig::default());
    assert_eq!(run.heard(), (0, 0));
    run.block_checkpoints();
    run.evaluate([99.0, 98.0]);
    let error = run.trainer.take_reports().unwrap_err();
    assert!(matches!(error, TrainError::Checkpoint(_)), "{error}");
    assert_eq!(run.heard(), (0, 0));

    let mut run = Run::new(LearnerConfig::default());
    run.evaluate([99.0, 98.0]);
    run.trainer.take_reports().unwrap();
    assert_eq!(run.heard(), (1, 1));
    assert!(run.folder().model("stage-0").exists() && run.folder().has_checkpoint());
}

#[test]
fn training_goes_on_where_a_periodic_checkpoint_cannot_be_written() {
    let mut run = Run::new(LearnerConfig { checkpoint_seconds: 1e-3, ..LearnerConfig::default() });
    run.block_checkpoints();
    let mut source = Refusing::after(30);
    for _ in 0..30 {
        run.trainer.tick(source.poll(Duration::from_secs(10)).unwrap().unwrap()).unwrap();
        // Long enough for the next one to be due.
        std::thread::sleep(Duration::from_millis(5));
    }
    assert!(matches!(run.trainer.finish(), Err(TrainError::Checkpoint(_))), "the last one has to be written");
}

#[test]
fn an_evaluation_that_cannot_be_recorded_ends_training() {
    let mut run = Run::new(LearnerConfig::default());
    fs::create_dir(run.folder().evaluations()).unwrap();
    run.evaluate([1.0, 2.0]);
    let error = run.trainer.take_reports().unwrap_err();
    assert!(error.to_string().contains("evaluations.jsonl"), "{error}");
}
