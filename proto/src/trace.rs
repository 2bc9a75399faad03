//! What a trace needs to cross from role to role: [`TraceContext`], and [`SegmentTrace`] beside a segment.

use std::fmt;
use std::str::FromStr;
use std::time::{SystemTime, UNIX_EPOCH};

/// A place in a trace: a span, under which further ones are hung. On the wire it is a `traceparent` of W3C Trace Context.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct TraceContext {
    /// Names the trace; not 0.
    pub trace_id: u128,
    /// Names the span in it; not 0.
    pub span_id: u64,
}

/// Not the `traceparent` of a trace that is recorded.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
#[error("not a traceparent of version 00 that is sampled: 00-<32 hex digits>-<16 hex digits>-01")]
pub struct TraceparentError;

impl TraceContext {
    /// The root of a new trace of `what`, which began at this time. Nothing is drawn: what is followed names its trace.
    pub fn root(what: &[u64], begun: SystemTime) -> Self {
        let nanoseconds = begun.duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos() as u64;
        let number = |salt| mix(mix(salt, what), &[nanoseconds]);
        let trace_id = (u128::from(number(0)) << 64) | u128::from(number(1));
        Self { trace_id: trace_id.max(1), span_id: number(2).max(1) }
    }

    /// The span of this name under this one; there is one of each name.
    pub fn child(&self, name: &str) -> Self {
        let bytes = name.bytes().map(u64::from).collect::<Vec<_>>();
        Self { span_id: mix(self.span_id, &bytes).max(1), ..*self }
    }
}

/// A number from 0 to 2⁶⁴ − 1 that looks like drawn, and is the same for the same `parts` everywhere: SplitMix64's
/// finalizer over each in turn.
pub fn mix(seed: u64, parts: &[u64]) -> u64 {
    parts.iter().fold(seed, |state, part| {
        let mut mixed = (state ^ part).wrapping_add(0x9e37_79b9_7f4a_7c15);
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ (mixed >> 31)
    })
}

/// As a `traceparent`.
impl fmt::Display for TraceContext {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "00-{:032x}-{:016x}-01", self.trace_id, self.span_id)
    }
}

impl FromStr for TraceContext {
    type Err = TraceparentError;

    fn from_str(traceparent: &str) -> Result<Self, TraceparentError> {
        let mut fields = traceparent.split('-');
        let mut field = || fields.next().ok_or(TraceparentError);
        let (version, trace, span, flags) = (field()?, field()?, field()?, field()?);
        let hex = |field: &str, digits: usize| {
            let whole = field.len() == digits && field.bytes().all(|byte| byte.is_ascii_hexdigit());
            whole.then(|| u128::from_str_radix(field, 16).ok()).flatten().ok_or(TraceparentError)
        };
        let (trace_id, span_id, flags) = (hex(trace, 32)?, hex(span, 16)? as u64, hex(flags, 2)?);
        let whole = version == "00" && fields.next().is_none();
        let recorded = whole && trace_id != 0 && span_id != 0 && flags & 1 == 1;
        recorded.then_some(Self { trace_id, span_id }).ok_or(TraceparentError)
    }
}

/// What is known of a segment that is followed, in the process where it is now.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct SegmentTrace {
    /// What the next span hangs under.
    pub context: TraceContext,
    /// When this process first saw the segment: in the actor when its first step was played, in the replay when it arrived.
    pub begun: SystemTime,
    /// Since when it is where it is.
    pub since: SystemTime,
}

impl SegmentTrace {
    /// That of a segment that arrives now, under `context`.
    pub fn arrived(context: TraceContext) -> Self {
        let now = SystemTime::now();
        Self { context, begun: now, since: now }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;
    use std::time::Duration;

    #[test]
    fn a_context_survives_the_wire_and_what_is_none_is_refused() {
        let example = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01";
        let context: TraceContext = example.parse().unwrap();
        assert_eq!(context.trace_id, 0x4bf9_2f35_77b3_4da6_a3ce_929d_0e0e_4736);
        assert_eq!(context.span_id, 0x00f0_67aa_0ba9_02b7);
        assert_eq!(context.to_string(), example);
        for wrong in [
            "",
            "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7",
            "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-00",
            "ff-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01",
            "00-00000000000000000000000000000000-00f067aa0ba902b7-01",
            "00-4bf92f3577b34da6a3ce929d0e0e4736-0000000000000000-01",
            "00-+bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01",
            "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01-more",
        ] {
            assert_eq!(wrong.parse::<TraceContext>(), Err(TraceparentError), "{wrong:?}");
        }
    }

    #[test]
    fn traces_and_their_spans_have_names_of_their_own() {
        let begun = UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        let roots: Vec<TraceContext> =
            (0..10_000).map(|step| TraceContext::root(&[7, 0, step / 100, step % 100], begun)).collect();
        assert_eq!(roots.iter().map(|root| root.trace_id).collect::<HashSet<_>>().len(), roots.len());
        assert_ne!(roots[0], TraceContext::root(&[7, 0, 0, 0], begun + Duration::from_nanos(1)));
        let (root, names) = (roots[0], ["simulate", "queue", "append"]);
        let spans: HashSet<u64> = names.iter().map(|name| root.child(name).span_id).collect();
        assert_eq!(spans.len(), 3);
        assert!(!spans.contains(&root.span_id));
        assert_eq!(root.child("queue"), roots[0].child("queue"));
    }

    #[test]
    fn mixed_numbers_are_spread_evenly() {
        let below =
            |share: f64| (0..100_000).filter(move |n| (mix(3, &[9, *n, 5]) as f64) < share * 2f64.powi(64));
        let counts = [0.001, 0.1, 0.5].map(|share| below(share).count() as f64 / (share * 100_000.0));
        assert!(counts.iter().all(|ratio| (0.6..1.4).contains(ratio)), "{counts:?}");
    }
}
