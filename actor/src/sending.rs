//! Segments that are followed, on their way from the lanes to a replay: [`Sending`].
//!
//! A trace begins with a segment's first step. Its root `segment` lasts until the replay has acknowledged it; below it
//! `simulate` is the time in the lane, `queue` that in the actor's queue, and `append` that of handing it over, retries
//! included. What the replay does, and the learner after it, hangs under `append`.

use std::time::SystemTime;

use getup_proto::{Segment, SegmentTrace};
use getup_telemetry::Traces;
use getup_telemetry::traces::{KeyValue, SpanKind};

/// The span that crosses to the replay.
const APPEND: &str = "append";

/// Those of the segments of one append that are followed.
#[derive(Debug)]
pub struct Sending {
    traces: Traces,
    begun: SystemTime,
    followed: Vec<(SegmentTrace, Vec<KeyValue>)>,
}

impl Sending {
    /// Notes that these segments of the actor `actor` are handed to a replay now, which goes on with their traces.
    pub fn begin(traces: &Traces, actor: &str, segments: &mut [Segment]) -> Self {
        let begun = SystemTime::now();
        let follow = |segment: &mut Segment| {
            let attributes = attributes(actor, segment);
            let trace = segment.trace.as_mut()?;
            let whole = **trace;
            traces.child(whole.context, ("queue", SpanKind::Internal), whole.since, begun, Vec::new());
            **trace = SegmentTrace { context: whole.context.child(APPEND), since: begun, ..whole };
            Some((whole, attributes))
        };
        let followed =
            segments.iter_mut().filter(|segment| segment.trace.is_some()).filter_map(follow).collect();
        Self { traces: traces.clone(), begun, followed }
    }

    /// Notes that the replay has them all, durably.
    pub fn acknowledged(self) {
        let now = SystemTime::now();
        for (trace, attributes) in self.followed {
            self.traces.child(trace.context, (APPEND, SpanKind::Producer), self.begun, now, Vec::new());
            self.traces.root(trace.context, "segment", trace.begun, now, attributes);
        }
    }
}

/// Whose a segment is.
fn attributes(actor: &str, segment: &Segment) -> Vec<KeyValue> {
    let mut attributes = vec![
        KeyValue::new("getup.actor", actor.to_owned()),
        KeyValue::new("getup.lane", i64::from(segment.lane)),
        KeyValue::new("getup.episode", segment.episode as i64),
        KeyValue::new("getup.first_step", i64::from(segment.first_step)),
        KeyValue::new("getup.steps", segment.steps as i64),
        KeyValue::new("getup.env_steps", i64::from(segment.env_steps)),
        KeyValue::new("getup.stage", i64::from(segment.stage)),
        KeyValue::new("getup.policy_version", segment.last_version.to_string()),
    ];
    if let Some(end) = &segment.end {
        attributes.push(KeyValue::new("getup.episode_end", end.reason.clone()));
        attributes.push(KeyValue::new("getup.episode_return", f64::from(end.episode_return)));
    }
    attributes
}
