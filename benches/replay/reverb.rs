//! The peer: Reverb, with its best settings.

use std::path::Path;

use anyhow::{Context, Result};
use serde_json::Value;

use crate::FULL;
use crate::common::Peer;

/// Reverb, with its best settings.
pub(crate) struct Reverb(Peer);

pub(crate) struct Answer(Value);

impl Reverb {
    pub(crate) fn start() -> Result<Self> {
        let settings = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/replay_reverb.json");
        let arguments = [settings.display().to_string(), FULL.to_string()];
        let arguments = [arguments[0].as_str(), arguments[1].as_str()];
        Ok(Self(Peer::start_with("GETUP_REVERB_PYTHON", "replay_reverb.py", &arguments)?))
    }

    pub(crate) fn ask(&mut self, request: &Value) -> Result<Answer> {
        let answer = self.0.ask_line(&request.to_string())?;
        Ok(Answer(serde_json::from_str(&answer).with_context(|| format!("the peer answers {answer:?}"))?))
    }
}

impl Answer {
    pub(crate) fn number(&self, name: &str) -> Result<f64> {
        self.0[name].as_f64().with_context(|| format!("the peer's answer has no {name}: {}", self.0))
    }
}
