//! Traces, as a collector receives them: one follows a segment from its first step to the update that it is first used in,
//! across processes and within one; nothing is exported where none is configured; and a collector that is away or hangs
//! holds nobody up.

#![cfg(feature = "learner")]

mod common;

use std::collections::{BTreeMap, BTreeSet};
use std::net::TcpListener;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use common::{Cluster, Process, free_address, getup, metric, succeed, wait_for};
use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::{
    TraceService, TraceServiceServer,
};
use opentelemetry_proto::tonic::collector::trace::v1::{
    ExportTraceServiceRequest, ExportTraceServiceResponse,
};
use opentelemetry_proto::tonic::common::v1::{KeyValue, any_value::Value};
use opentelemetry_proto::tonic::trace::v1::{Span, span::SpanKind};
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Request, Response, Status};

const LIMIT: Duration = Duration::from_secs(60);
const ROLES: [&str; 3] = ["replay", "learner", "actor"];
/// The spans of a whole trace: name, parent, who records it, and its kind.
const WHOLE: [(&str, &str, &str, SpanKind); 8] = [
    ("segment", "", "actor", SpanKind::Internal),
    ("simulate", "segment", "actor", SpanKind::Internal),
    ("queue", "segment", "actor", SpanKind::Internal),
    ("append", "segment", "actor", SpanKind::Producer),
    ("limiter", "append", "replay", SpanKind::Internal),
    ("commit", "append", "replay", SpanKind::Consumer),
    ("sample", "append", "replay", SpanKind::Producer),
    ("update", "sample", "learner", SpanKind::Consumer),
];

/// A span, and the resource that recorded it.
#[derive(Clone, Debug)]
struct Recorded {
    resource: BTreeMap<String, String>,
    attributes: BTreeMap<String, String>,
    span: Span,
}

/// Spans of one trace, by name.
type Trace = BTreeMap<String, Recorded>;

/// A collector in this process, which keeps what it is told.
struct Collector {
    recorded: Arc<Mutex<Vec<Recorded>>>,
    endpoint: String,
    _runtime: tokio::runtime::Runtime,
}

struct Receiver(Arc<Mutex<Vec<Recorded>>>);

#[tonic::async_trait]
impl TraceService for Receiver {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        let mut recorded = self.0.lock().unwrap();
        for from in request.into_inner().resource_spans {
            let resource = text(from.resource.unwrap().attributes);
            for span in from.scope_spans.into_iter().flat_map(|scope| scope.spans) {
                let attributes = text(span.attributes.clone());
                recorded.push(Recorded { resource: resource.clone(), attributes, span });
            }
        }
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

/// Attributes as text.
fn text(attributes: Vec<KeyValue>) -> BTreeMap<String, String> {
    let value = |attribute: KeyValue| match attribute.value.and_then(|value| value.value) {
        Some(Value::StringValue(value)) => (attribute.key, value),
        Some(Value::IntValue(value)) => (attribute.key, value.to_string()),
        Some(Value::DoubleValue(value)) => (attribute.key, value.to_string()),
        other => panic!("{} is {other:?}", attribute.key),
    };
    attributes.into_iter().map(value).collect()
}

impl Collector {
    fn start() -> Self {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
        let recorded = Arc::new(Mutex::new(Vec::new()));
        let listener = runtime.block_on(tokio::net::TcpListener::bind("127.0.0.1:0")).unwrap();
        let endpoint = format!("http://{}", listener.local_addr().unwrap());
        let server = tonic::transport::Server::builder()
            .add_service(TraceServiceServer::new(Receiver(recorded.clone())))
            .serve_with_incoming(TcpListenerStream::new(listener));
        runtime.spawn(server);
        Self { recorded, endpoint, _runtime: runtime }
    }

    /// What has come, by trace.
    fn traces(&self) -> BTreeMap<Vec<u8>, Trace> {
        let mut traces: BTreeMap<Vec<u8>, Trace> = BTreeMap::new();
        for recorded in self.recorded.lock().unwrap().iter().cloned() {
            let (id, name) = (recorded.span.trace_id.clone(), recorded.span.name.clone());
            let before = traces.entry(id).or_default().insert(name, recorded);
            assert!(before.is_none(), "twice in one trace: {before:?}");
        }
        traces
    }

    /// Those that are whole.
    fn whole(&self) -> Vec<Trace> {
        self.traces().into_values().filter(|trace| trace.len() == WHOLE.len()).collect()
    }

    fn wait_for_whole(&self, least: usize) -> Vec<Trace> {
        wait_for("whole traces", LIMIT, || Some(self.whole()).filter(|whole| whole.len() >= least))
    }
}

/// Settings that follow every segment.
fn settings(endpoint: &str) -> [String; 4] {
    ["--set".into(), format!("traces.endpoint={endpoint}"), "--set".into(), "traces.share=1".into()]
}

/// A cluster whose roles follow every segment.
fn start(cluster: &Cluster, role: &'static str, endpoint: &str) -> Process {
    // Nothing passes its threshold: the run goes on until it is told to end.
    let mut command = cluster.command(role, 1_000.0);
    command.args(settings(endpoint)).args(["--log-format", "json"]);
    Process::start(role, cluster.path(), &mut command)
}

fn end(processes: &mut [Process]) {
    processes.iter().for_each(|process| process.signal("TERM"));
    for process in processes {
        let status = process.wait(Duration::from_secs(10));
        assert!(status.success(), "{status}:\n{}", process.log());
    }
}

/// A whole trace has its spans from the roles that record them, under their parents, in the order of what happened.
fn check(trace: &Trace, service: impl Fn(&str) -> String) {
    for (name, parent, role, kind) in WHOLE {
        let Recorded { resource, span, .. } = &trace[name];
        assert_eq!(resource["service.name"], service(role), "{name}");
        let parent = trace.get(parent).map_or(&[][..], |parent| &parent.span.span_id);
        assert_eq!(span.parent_span_id, parent, "{name} of {trace:#?}");
        assert_eq!((span.kind, span.trace_id.len(), span.span_id.len()), (kind as i32, 16, 8), "{name}");
    }
    let begin = |name: &str| trace[name].span.start_time_unix_nano;
    let end = |name: &str| trace[name].span.end_time_unix_nano;
    let order = [
        begin("segment"),
        begin("simulate"),
        end("simulate"),
        begin("queue"),
        end("queue"),
        begin("append"),
        begin("limiter"),
        end("limiter"),
        begin("commit"),
        end("commit"),
    ];
    assert!(order.is_sorted(), "{order:?} of {trace:#?}");
    assert!(end("commit") <= end("append") && end("append") <= end("segment"), "{trace:#?}");
    let after = [end("commit"), begin("sample"), end("sample"), begin("update"), end("update")];
    assert!(after.is_sorted(), "{after:?} of {trace:#?}");
}

#[test]
fn a_segment_is_followed_from_actor_to_minibatch_through_three_processes() {
    let (cluster, collector) = (Cluster::new(), Collector::start());
    let mut processes = ROLES.map(|role| start(&cluster, role, &collector.endpoint));
    collector.wait_for_whole(10);
    let exported = "getup_trace_spans_total{result=\"exported\"";
    wait_for("the learner counts its spans", LIMIT, || {
        let text = common::scrape(cluster.address("learner_metrics"))?;
        let line = text.lines().find(|line| line.starts_with(exported))?.to_owned();
        line.rsplit_once(' ')?.1.parse::<f64>().ok().filter(|spans| *spans >= 10.0)
    });
    end(&mut processes);
    let whole = collector.whole();
    for trace in &whole {
        check(trace, |role| format!("getup-{role}"));
        assert!(trace.values().all(|recorded| recorded.resource["getup.run"] == "smoke"));
    }
    // Names alone tell whose segment a trace is of.
    let mut segments = BTreeSet::new();
    for Recorded { attributes, .. } in whole.iter().map(|trace| &trace["segment"]) {
        let number = |name: &str| attributes[name].parse::<u64>().unwrap();
        assert!(number("getup.lane") < 4 && (1..=64).contains(&number("getup.steps")), "{attributes:?}");
        assert!(attributes["getup.policy_version"].starts_with("1."), "{attributes:?}");
        assert!(attributes.contains_key("getup.stage") && !attributes["getup.actor"].is_empty());
        segments.insert(["lane", "episode", "first_step"].map(|name| number(&format!("getup.{name}"))));
    }
    assert_eq!(segments.len(), whole.len(), "one trace a segment");
    let updates: BTreeSet<&String> =
        whole.iter().map(|trace| &trace["update"].attributes["getup.update"]).collect();
    assert!(updates.len() > 1, "each trace ends in the minibatch that is its own: {updates:?}");
}

#[test]
fn training_in_one_process_gives_the_same_traces_without_a_network() {
    for mode in [&["--steps", "1500"][..], &["--steps", "1500", "--deterministic"]] {
        let (folder, collector) = (tempfile::tempdir().unwrap(), Collector::start());
        let mut command = getup(&["train", "--preset", "smoke", "--run", "run"]);
        command.args(["--set", "network.learner_metrics=127.0.0.1:0"]);
        command.args(settings(&collector.endpoint)).args(mode).current_dir(folder.path());
        succeed(&mut command);
        let whole = collector.whole();
        assert!(whole.len() >= 10, "{} of {} traces are whole", whole.len(), collector.traces().len());
        whole.iter().for_each(|trace| check(trace, |_| "getup-train".to_owned()));
    }
}

#[test]
fn nothing_is_exported_where_no_collector_is_configured() {
    let (cluster, collector) = (Cluster::new(), Collector::start());
    let start = |role| {
        let mut command = cluster.command(role, 1_000.0);
        // The settings decide, and not what other programs are told.
        command.env("OTEL_EXPORTER_OTLP_ENDPOINT", &collector.endpoint).args(["--log-format", "json"]);
        Process::start(role, cluster.path(), command.args(["--set", "traces.share=1"]))
    };
    let mut processes = ROLES.map(start);
    wait_for("updates", LIMIT, || cluster.learner_metric("updates_total").filter(|updates| *updates >= 50.0));
    for role in ROLES {
        let spans = metric(cluster.address(&format!("{role}_metrics")), "getup_trace_spans_total");
        assert_eq!(spans, Some(0.0), "{role}");
    }
    end(&mut processes);
    assert!(collector.traces().is_empty());
}

#[test]
fn a_collector_that_is_away_or_hangs_holds_nobody_up() {
    let cluster = Cluster::new();
    // Connections come about, and nobody ever answers on them.
    let hanging = TcpListener::bind("127.0.0.1:0").unwrap();
    let (hangs, away) = (hanging.local_addr().unwrap().to_string(), free_address());
    let started = Instant::now();
    let endpoints = [("replay", &away), ("learner", &hangs), ("actor", &hangs)];
    let mut processes = endpoints.map(|(role, address)| start(&cluster, role, &format!("http://{address}")));
    wait_for("updates, and losses", LIMIT, || {
        cluster.learner_metric("updates_total").filter(|updates| *updates >= 50.0)?;
        let lost = |role: &str| {
            let text = common::scrape(cluster.address(&format!("{role}_metrics")))?;
            let line =
                text.lines().find(|line| line.starts_with("getup_trace_spans_total{result=\"lost\""))?;
            line.rsplit_once(' ')?.1.parse::<f64>().ok().filter(|spans| *spans > 0.0)
        };
        ROLES.iter().all(|role| lost(role).is_some()).then_some(())
    });
    end(&mut processes);
    for process in processes {
        let warnings = process.log().lines().filter(|line| line.contains("are lost so far")).count() as u64;
        assert!((1..=1 + started.elapsed().as_secs() / 60).contains(&warnings), "{}", process.log());
    }
}
