//! A prioritized table end to end: priorities go from the learner's errors to the store and come back as draws, and
//! what is learned is right.

#![cfg(feature = "torch")]

mod toy;

use getup_learner::sac::{Batch, Sac};
use getup_replay::{
    ItemSelector, LocalSource, MinibatchSource, RemoteOptions, RemoteSource, ReplayConfig, ReplayMetrics,
    SampleOptions, Store, serve,
};
use getup_telemetry::{Registry, Shutdown, Waits};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::sync::Arc;
use tch::Device;
use tempfile::TempDir;
use tokio::net::TcpListener;

fn store(dir: &TempDir) -> Arc<Store> {
    let registry = Registry::new();
    let settings = ReplayConfig {
        capacity: 4096,
        min_size: 1,
        sampler: ItemSelector::Prioritized { exponent: 0.6 },
        ..ReplayConfig::default()
    };
    let (metrics, waits) = (ReplayMetrics::new(&registry), Waits::new(&registry));
    let store = Store::open(dir.path(), &toy::spec(), &settings, metrics, waits).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    store.append((1..=256).map(|sequence| toy::segment(sequence, &mut rng)).collect()).unwrap();
    Arc::new(store)
}

/// Trains as a learner does, and checks what it has learned.
fn learns(mut source: impl MinibatchSource) {
    let mut sac = Sac::new(&toy::shape(), &toy::config(), 3, Device::Cpu, 1);
    let mut q = 0.0;
    let mut unequal = 0;
    for _ in 0..1500 {
        let mut minibatch = source.next().unwrap();
        let keys: Vec<u64> = minibatch.items.iter().map(|item| item.key).collect();
        assert_eq!(keys.len(), 64);
        let mut batch = Batch::from_minibatch(&mut minibatch).unwrap();
        batch.weight = minibatch.importance_weights(1.0);
        assert!(batch.weight.iter().all(|&weight| weight > 0.0 && weight <= 1.0));
        unequal += u32::from(batch.weight.iter().any(|&weight| weight < 0.9));
        q = sac.update(&batch).unwrap().q;
        let errors = sac.td_errors();
        assert!(errors.len() == 64 && errors.iter().all(|error| error.is_finite() && *error >= 0.0));
        source.update_priorities(keys.into_iter().zip(errors.iter().copied()).collect()).unwrap();
    }
    assert!(unequal > 1000, "only {unequal} minibatches were drawn by priorities that differ");
    let mut forward = getup_policy::Forward::new(&sac.policy(), 9);
    let positions: Vec<f32> = (-4..=4).map(|i| i as f32 / 4.0).collect();
    for (position, mean) in positions.iter().zip(forward.run(&positions).mean) {
        assert!((mean.tanh() - 0.5).abs() < 0.1, "at {position}: {}", mean.tanh());
    }
    // The value of uniform actions, 1 − 7/12 + 4, over those that were drawn: large errors come more often.
    assert!((q - 4.42).abs() < 0.6, "Q {q}");
}

fn options() -> SampleOptions {
    SampleOptions { batch: 64, n_step: 1, gamma: 0.8, seed: 2, segments: false }
}

#[test]
fn the_toy_task_is_learned_from_a_prioritized_store_in_the_same_process() {
    let dir = TempDir::new().unwrap();
    learns(LocalSource::new(store(&dir), options(), "learner", Shutdown::new()).unwrap());
}

#[test]
fn the_toy_task_is_learned_from_a_prioritized_table_over_grpc() {
    let dir = TempDir::new().unwrap();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0")).unwrap();
    let endpoint = listener.local_addr().unwrap().to_string();
    let shutdown = Shutdown::new();
    let serving = runtime.spawn(serve(listener, store(&dir), shutdown.clone()));
    let remote = RemoteOptions {
        spec: toy::spec(),
        sample: options(),
        name: "learner".to_owned(),
        table: String::new(),
        prefetch: 8,
    };
    let waits = Waits::new(&Registry::new());
    learns(RemoteSource::new(&endpoint, remote, runtime.handle(), waits, shutdown.clone()));
    shutdown.trigger();
    runtime.block_on(serving).unwrap().unwrap();
}
