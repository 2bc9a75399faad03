//! What the actor's tests share: a run's spec, small policies, and gRPC servers of replay and learner.

pub(crate) mod learner;
pub(crate) mod replay;

use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use getup_actor::{ActorConfig, ActorSetup, BetaDraw, Identity, PolicyUpdate};
use getup_policy::{Body, Policy, PolicyShape};
use getup_proto::columns::{ACTION, BETA, OBSERVATION, REWARD};
use getup_proto::{ColumnSpec, PolicyVersion, Rows, RunSpec};
use getup_sim::TaskConfig;
use getup_telemetry::{Shutdown, Traces};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use tokio::net::TcpListener;

pub(crate) fn spec() -> RunSpec {
    let column = |name: &str, width, rows| ColumnSpec { name: name.to_owned(), width, rows };
    RunSpec {
        run: "test".to_owned(),
        task: "getup/standard".to_owned(),
        columns: vec![
            column(OBSERVATION, 68, Rows::StepsPlusOne),
            column(ACTION, 21, Rows::Steps),
            column(REWARD, 1, Rows::Steps),
            column(BETA, 1, Rows::Once),
        ],
        max_segment_steps: 64,
    }
}

pub(crate) fn policy(seed: u64) -> Policy {
    let shape = PolicyShape { observation: 68, action: 21, body: Body::Mlp { hidden: vec![32, 32] } };
    Policy::init(shape, &mut ChaCha8Rng::seed_from_u64(seed))
}

pub(crate) fn update(counter: u64) -> PolicyUpdate {
    PolicyUpdate {
        version: PolicyVersion { incarnation: 1, counter },
        policy: Arc::new(policy(counter)),
        beta: 0.8,
        high_starts: 0.0,
        values: [("beta".to_owned(), 0.8)].into(),
        stage: 3,
        env_steps: 0,
        uniform: false,
        finished: false,
    }
}

pub(crate) fn setup(folder: &Path) -> ActorSetup {
    ActorSetup {
        config: ActorConfig { lanes: 4, threads: 2, segment_steps: 16, ..ActorConfig::default() },
        task: TaskConfig { ragdoll_steps: 20, episode_steps: 40, ..TaskConfig::default() },
        spec: spec(),
        identity: Identity { name: "actor-1".to_owned(), run_seed: 7, writer: 1 },
        beta: BetaDraw { std: 0.04, floor: 0.4, ceiling: 1.0 },
        diverged_folder: folder.to_owned(),
        traces: Traces::default(),
    }
}

/// A listener at an address that stays free for a server that comes back.
pub(crate) async fn listen(address: SocketAddr) -> TcpListener {
    let deadline = Instant::now() + Duration::from_secs(5);
    loop {
        match TcpListener::bind(address).await {
            Ok(listener) => return listener,
            Err(error) => assert!(Instant::now() < deadline, "{error}"),
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

pub(crate) fn any_port() -> SocketAddr {
    ([127, 0, 0, 1], 0).into()
}

/// A server on a runtime of its own, so that killing it cuts its connections as a crash would.
pub(crate) struct Server {
    pub(crate) address: SocketAddr,
    end: Shutdown,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Server {
    pub(crate) fn start(address: SocketAddr, router: tonic::transport::server::Router) -> Self {
        let end = Shutdown::new();
        let ended = end.clone();
        let (sender, receiver) = std::sync::mpsc::channel();
        let thread = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            runtime.block_on(async move {
                let listener = listen(address).await;
                sender.send(listener.local_addr().unwrap()).unwrap();
                let incoming = tokio_stream::wrappers::TcpListenerStream::new(listener);
                tokio::select! {
                    result = router.serve_with_incoming(incoming) => result.unwrap(),
                    () = ended.wait() => {}
                }
            });
        });
        Self { address: receiver.recv().unwrap(), end, thread: Some(thread) }
    }

    pub(crate) fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    /// Ends it at once, connections and all; its address is free again afterwards.
    pub(crate) fn kill(mut self) -> SocketAddr {
        self.stop();
        self.address
    }

    fn stop(&mut self) {
        self.end.trigger();
        if let Some(thread) = self.thread.take() {
            thread.join().unwrap();
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop();
    }
}

/// Waits until `condition` holds.
pub(crate) async fn eventually(what: &str, condition: impl Fn() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(20);
    while !condition() {
        assert!(Instant::now() < deadline, "{what} did not come about");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}
