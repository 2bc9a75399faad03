//! Traces: one segment in so many is followed from its first step to the minibatch that it is in, and told to an OpenTelemetry
//! collector. Off where no collector is configured, and then nothing is done but to look whether it is on.
//!
//! A span is recorded when it is over, with its begin and its end: nothing has to be held open from role to role, and what
//! is under way at a crash leaves no half of a span. Training never waits for a collector: spans queue up to
//! [`QUEUE_SPANS`], a thread of the OpenTelemetry SDK exports them in batches once a second, and what does not fit, or is
//! not taken after its retries, is lost and counted.

use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use documented::DocumentedFieldsOpt;
use getup_proto::{SegmentTrace, TraceContext, mix};
use opentelemetry::InstrumentationScope;
use opentelemetry::trace::{SpanContext, SpanId, Status, TraceFlags, TraceId, TraceState};
pub use opentelemetry::{KeyValue, trace::SpanKind};
use opentelemetry_otlp::{SpanExporter as OtlpExporter, WithExportConfig, WithTonicConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::error::OTelSdkResult;
use opentelemetry_sdk::trace::{
    BatchConfigBuilder, BatchSpanProcessor, SpanData, SpanEvents, SpanExporter, SpanLinks, SpanProcessor,
};
use prometheus::{IntCounter, IntCounterVec, Opts, Registry};
use serde::{Deserialize, Serialize};
use thiserror::Error;
use tokio::runtime::Runtime;
use tonic::transport::Endpoint;

/// Spans that may wait to be exported, those on their way included; beyond, they are lost.
pub const QUEUE_SPANS: usize = 2048;
/// Spans of one request.
const BATCH_SPANS: usize = 512;
/// How often what waits is exported.
const EXPORT_EVERY: Duration = Duration::from_secs(1);
/// How long a collector may take for a batch.
const EXPORT_PATIENCE: Duration = Duration::from_secs(5);
/// How long the end of a process waits for its last spans.
const LAST_EXPORT: Duration = Duration::from_secs(1);
/// Losses are logged this often at most.
const WARN_EVERY: Duration = Duration::from_secs(60);

/// `[traces]`: which segments are followed, and who is told.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize, DocumentedFieldsOpt)]
#[serde(default, deny_unknown_fields)]
pub struct TracesConfig {
    /// The collector that takes OTLP over gRPC, such as `http://collector:4317`; empty turns traces off.
    pub endpoint: String,
    /// Share of the segments that are followed, over 0 and at most 1.
    pub share: f64,
}

impl Default for TracesConfig {
    fn default() -> Self {
        Self { endpoint: String::new(), share: 0.001 }
    }
}

/// Why traces cannot be exported.
#[derive(Debug, Error)]
pub enum TracesError {
    /// A collector that only TLS reaches.
    #[error(
        "traces.endpoint is {0:?}: traces go over plain http; run an OpenTelemetry Collector beside the roles that \
         passes them on over TLS"
    )]
    Tls(String),
    /// Not an address.
    #[error(
        "traces.endpoint is {0:?}: it must be of the form http://HOST:PORT (OTLP over gRPC, usually port 4317)"
    )]
    Endpoint(String),
    /// Not a share.
    #[error(
        "traces.share is {0}: it must be over 0 and at most 1; an empty traces.endpoint turns traces off"
    )]
    Share(f64),
    /// The exporter refuses its settings.
    #[error("cannot export traces to {endpoint}: {reason}")]
    Exporter {
        /// Where to.
        endpoint: String,
        /// Its words.
        reason: String,
    },
}

impl TracesConfig {
    /// Checks every setting.
    ///
    /// # Errors
    /// [`TracesError`] with the first setting that cannot work.
    pub fn validate(&self) -> Result<(), TracesError> {
        if !(self.share > 0.0 && self.share <= 1.0) {
            return Err(TracesError::Share(self.share));
        }
        if self.endpoint.is_empty() {
            return Ok(());
        }
        let malformed = || TracesError::Endpoint(self.endpoint.clone());
        let uri: http::Uri = self.endpoint.parse().map_err(|_| malformed())?;
        match (uri.scheme_str(), uri.port(), uri.path()) {
            (Some("https"), ..) => Err(TracesError::Tls(self.endpoint.clone())),
            (Some("http"), Some(_), "/") => Ok(()),
            _ => Err(malformed()),
        }
    }
}

/// Who records spans, for the resource that they belong to.
#[derive(Clone, Copy, Debug)]
pub struct Recorder<'a> {
    /// The role: `actor`.
    pub role: &'a str,
    /// The run's name.
    pub run: &'a str,
    /// The run's seed, which decides what is followed.
    pub seed: u64,
    /// The machine.
    pub host: &'a str,
}

/// The traces of a process; clones share them. The default is off.
#[derive(Clone, Debug, Default)]
pub struct Traces(Option<Arc<Exporting>>);

/// What is there where traces are on.
struct Exporting {
    seed: u64,
    /// Of the segments.
    share: f64,
    processor: BatchSpanProcessor,
    toll: Arc<Toll>,
    /// Connects to the collector; of its own, for it must outlive the roles' to send their last spans.
    runtime: Option<Runtime>,
}

/// What became of spans.
struct Toll {
    /// That wait, or are on their way.
    queued: AtomicUsize,
    /// Nothing is exported any more.
    closed: AtomicBool,
    exported: IntCounter,
    lost: IntCounter,
    warned: Mutex<Option<Instant>>,
}

impl Traces {
    /// Traces as configured, counted in `registry`.
    ///
    /// # Errors
    /// [`TracesError`]; that nobody listens at the endpoint is none.
    ///
    /// # Panics
    /// When `registry` counts traces already.
    pub fn start(config: &TracesConfig, who: Recorder<'_>, registry: &Registry) -> Result<Self, TracesError> {
        config.validate()?;
        let toll = Arc::new(Toll::new(registry));
        if config.endpoint.is_empty() {
            return Ok(Self::default());
        }
        let refused = |reason: String| TracesError::Exporter { endpoint: config.endpoint.clone(), reason };
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("traces")
            .enable_all()
            .build()
            .map_err(|error| refused(error.to_string()))?;
        let exporter = {
            let _entered = runtime.enter();
            let endpoint = Endpoint::from_shared(config.endpoint.clone());
            let endpoint = endpoint.map_err(|error| refused(error.to_string()))?;
            // A collector whose packets are lost is given up as soon as one that does not answer.
            let channel = endpoint.connect_timeout(EXPORT_PATIENCE).timeout(EXPORT_PATIENCE).connect_lazy();
            let builder = OtlpExporter::builder().with_tonic().with_channel(channel);
            builder.with_timeout(EXPORT_PATIENCE).build().map_err(|error| refused(error.to_string()))?
        };
        let batches = BatchConfigBuilder::default()
            .with_max_queue_size(QUEUE_SPANS)
            .with_max_export_batch_size(BATCH_SPANS)
            .with_scheduled_delay(EXPORT_EVERY);
        let exporter = Counted { exporter, endpoint: config.endpoint.clone(), toll: toll.clone() };
        let mut processor = BatchSpanProcessor::new(exporter, batches.build());
        processor.set_resource(&resource(who));
        tracing::info!(share = config.share, "traces of segments go to {}", config.endpoint);
        let (seed, share) = (who.seed, config.share);
        Ok(Self(Some(Arc::new(Exporting { seed, share, processor, toll, runtime: Some(runtime) }))))
    }

    /// Whether anything is followed.
    pub fn is_on(&self) -> bool {
        self.0.is_some()
    }

    /// Begins to follow a segment, where it is one of those that are: `segment` names it, and decides with the run's seed.
    pub fn begin(&self, segment: [u64; 4]) -> Option<SegmentTrace> {
        let Exporting { seed, share, .. } = **self.0.as_ref()?;
        let followed = mix(seed, &segment) as f64 <= share * 2f64.powi(64);
        followed.then(|| SegmentTrace::arrived(TraceContext::root(&segment, SystemTime::now())))
    }

    /// Records a span that begins a trace, and is over.
    pub fn root(
        &self,
        context: TraceContext,
        name: &'static str,
        from: SystemTime,
        to: SystemTime,
        attributes: Vec<KeyValue>,
    ) {
        self.record(context, None, name, SpanKind::Internal, from, to, attributes);
    }

    /// Records a span under another, and returns it for those under this one.
    pub fn child(
        &self,
        parent: TraceContext,
        (name, kind): (&'static str, SpanKind),
        from: SystemTime,
        to: SystemTime,
        attributes: Vec<KeyValue>,
    ) -> TraceContext {
        let context = parent.child(name);
        self.record(context, Some(parent), name, kind, from, to, attributes);
        context
    }

    #[expect(clippy::too_many_arguments, reason = "a span has as many parts")]
    fn record(
        &self,
        context: TraceContext,
        parent: Option<TraceContext>,
        name: &'static str,
        span_kind: SpanKind,
        start_time: SystemTime,
        end_time: SystemTime,
        attributes: Vec<KeyValue>,
    ) {
        let Some(Exporting { processor, toll, .. }) = self.0.as_deref() else { return };
        if !toll.admit() {
            return;
        }
        let span_id = |context: TraceContext| SpanId::from_bytes(context.span_id.to_be_bytes());
        processor.on_end(SpanData {
            span_context: SpanContext::new(
                TraceId::from_bytes(context.trace_id.to_be_bytes()),
                span_id(context),
                TraceFlags::SAMPLED,
                false,
                TraceState::NONE,
            ),
            parent_span_id: parent.map_or(SpanId::INVALID, span_id),
            parent_span_is_remote: false,
            span_kind,
            name: name.into(),
            start_time,
            end_time: end_time.max(start_time),
            attributes,
            dropped_attributes_count: 0,
            events: SpanEvents::default(),
            links: SpanLinks::default(),
            status: Status::Unset,
            instrumentation_scope: InstrumentationScope::builder("getup")
                .with_version(env!("CARGO_PKG_VERSION"))
                .build(),
        });
    }

    /// Exports what waits, for a second at most; spans that come later are lost.
    pub fn shutdown(&self) {
        let Some(Exporting { processor, toll, .. }) = self.0.as_deref() else { return };
        toll.closed.store(true, Ordering::Relaxed);
        if processor.shutdown_with_timeout(LAST_EXPORT).is_err() {
            let left = toll.queued.load(Ordering::Relaxed);
            tracing::warn!(
                "{left} spans of traces are lost: the collector did not take them within {LAST_EXPORT:?}"
            );
        }
    }
}

impl fmt::Debug for Exporting {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Exporting").field("share", &self.share).finish_non_exhaustive()
    }
}

impl Drop for Exporting {
    fn drop(&mut self) {
        // The last handle may be dropped by a task, which must not wait for a runtime to end.
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

impl Toll {
    fn new(registry: &Registry) -> Self {
        let options = Opts::new(
            "getup_trace_spans_total",
            "Spans of traces, by what became of them: exported, or lost for want of a collector or of room in the queue.",
        );
        let spans = IntCounterVec::new(options, &["result"]).expect("the name and labels are well-formed");
        registry.register(Box::new(spans.clone())).expect("a process counts its traces once");
        let [exported, lost] = ["exported", "lost"].map(|result| spans.with_label_values(&[result]));
        Self {
            queued: AtomicUsize::new(0),
            closed: AtomicBool::new(false),
            exported,
            lost,
            warned: Mutex::default(),
        }
    }

    /// Makes room for a span in the queue; false where there is none.
    fn admit(&self) -> bool {
        if self.closed.load(Ordering::Relaxed) {
            self.lose(1, "the process ends");
            return false;
        }
        let room = |queued: usize| (queued < QUEUE_SPANS).then_some(queued + 1);
        let admitted = self.queued.fetch_update(Ordering::Relaxed, Ordering::Relaxed, room).is_ok();
        if !admitted {
            self.lose(1, "the collector is slower than they come: lower traces.share");
        }
        admitted
    }

    fn lose(&self, spans: usize, why: &str) {
        self.lost.inc_by(spans as u64);
        let mut warned = self.warned.lock().unwrap_or_else(PoisonError::into_inner);
        if warned.is_none_or(|at| at.elapsed() >= WARN_EVERY) {
            *warned = Some(Instant::now());
            let lost = self.lost.get();
            tracing::warn!("{lost} spans of traces are lost so far: {why}; all else goes on");
        }
    }
}

/// Exports over OTLP, and counts.
#[derive(Debug)]
struct Counted {
    exporter: OtlpExporter,
    endpoint: String,
    toll: Arc<Toll>,
}

impl fmt::Debug for Toll {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Toll").field("queued", &self.queued).finish_non_exhaustive()
    }
}

impl SpanExporter for Counted {
    async fn export(&self, batch: Vec<SpanData>) -> OTelSdkResult {
        let spans = batch.len();
        let result = self.exporter.export(batch).await;
        self.toll.queued.fetch_sub(spans, Ordering::Relaxed);
        match &result {
            Ok(()) => self.toll.exported.inc_by(spans as u64),
            Err(error) => self.toll.lose(spans, &format!("{} does not take them ({error})", self.endpoint)),
        }
        result
    }

    fn shutdown_with_timeout(&self, timeout: Duration) -> OTelSdkResult {
        self.exporter.shutdown_with_timeout(timeout)
    }

    fn set_resource(&mut self, resource: &Resource) {
        self.exporter.set_resource(resource);
    }
}

fn resource(who: Recorder<'_>) -> Resource {
    Resource::builder()
        .with_service_name(format!("getup-{}", who.role))
        .with_attributes([
            KeyValue::new("service.namespace", "getup"),
            KeyValue::new("service.version", env!("CARGO_PKG_VERSION")),
            KeyValue::new("getup.role", who.role.to_owned()),
            KeyValue::new("getup.run", who.run.to_owned()),
            KeyValue::new("host.name", who.host.to_owned()),
            KeyValue::new("process.pid", i64::from(std::process::id())),
        ])
        .build()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(endpoint: &str, share: f64) -> TracesConfig {
        TracesConfig { endpoint: endpoint.into(), share }
    }

    fn start(share: f64, registry: &Registry) -> Traces {
        let who = Recorder { role: "actor", run: "test", seed: 3, host: "host" };
        // Port 9 (discard): nobody listens.
        Traces::start(&config("http://127.0.0.1:9", share), who, registry).unwrap()
    }

    #[test]
    fn an_endpoint_is_plain_http_with_a_port_and_a_share_is_one() {
        assert!(TracesConfig::default().validate().is_ok());
        assert!(config("http://collector:4317", 1.0).validate().is_ok());
        for endpoint in
            ["collector:4317", "http://collector", "http://collector:4317/v1/traces", "grpc://c:1"]
        {
            let error = config(endpoint, 1.0).validate().unwrap_err().to_string();
            assert!(error.contains(endpoint) && error.contains("http://HOST:PORT"), "{error}");
        }
        assert!(
            config("https://collector:4317", 1.0).validate().unwrap_err().to_string().contains("plain http")
        );
        for share in [0.0, -0.5, 1.5, f64::NAN] {
            assert!(config("", share).validate().unwrap_err().to_string().contains("traces.share"));
        }
    }

    #[test]
    fn the_seed_decides_which_segments_are_followed() {
        let chosen = |traces: &Traces| (0..1000).filter(|n| traces.begin([1, 2, 3, *n]).is_some()).count();
        let begun = |traces: &Traces, n| traces.begin([1, 2, 3, n]).is_some();
        let (some, again) = (start(0.2, &Registry::new()), start(0.2, &Registry::new()));
        assert!((0..1000).all(|n| begun(&some, n) == begun(&again, n)));
        assert!((100..300).contains(&chosen(&some)), "{}", chosen(&some));
        assert_eq!(chosen(&start(1.0, &Registry::new())), 1000);
        assert_eq!(chosen(&Traces::default()), 0, "off by default");
    }

    #[test]
    fn spans_that_nobody_takes_are_lost_counted_and_wait_no_longer_than_their_time() {
        let registry = Registry::new();
        let traces = start(1.0, &registry);
        let trace = traces.begin([1, 2, 3, 4]).unwrap();
        for _ in 0..3 * QUEUE_SPANS {
            traces.root(trace.context, "segment", trace.begun, SystemTime::now(), Vec::new());
        }
        let started = Instant::now();
        traces.shutdown();
        // A machine with other work to do gets time for it.
        assert!(started.elapsed() < LAST_EXPORT + Duration::from_secs(10));
        let toll = &traces.0.as_ref().unwrap().toll;
        assert_eq!(toll.exported.get(), 0);
        assert!(toll.lost.get() >= 2 * QUEUE_SPANS as u64 - BATCH_SPANS as u64, "{}", toll.lost.get());
    }
}
