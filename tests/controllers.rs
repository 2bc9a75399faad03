//! The controllers that are shipped in `models/`, and the reader of them in NumPy.

#![cfg(all(feature = "learner", feature = "render"))]

mod common;

use std::path::{Path, PathBuf};
use std::process::Command;

use common::{getup, skip, succeed};
use getup_policy::{Forward, Policy, squash};
use serde_json::Value;

/// The script's exit code where NumPy is missing.
const NO_MODULE: i32 = 1;

fn model(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("models").join(name).with_extension("safetensors")
}

/// Of twenty unseen falls, at each one's own β. The shares of a thousand are in `models/README.md`.
#[test]
fn they_rise_from_nearly_every_fall_and_standing_stands() {
    for (name, stands) in [("strong", 0.0), ("weak", 0.0), ("standing", 0.7)] {
        let report =
            succeed(getup(&["evaluate", "--episodes", "20", "--seed", "77", "--json"]).arg(model(name)));
        let report: Value = serde_json::from_str(&report).unwrap();
        let share = |share: &str| report[share].as_f64().unwrap();
        assert!(share("rise_rate") >= 0.8, "{name}: {report}");
        assert!(share("stand_rate") >= stands, "{name}: {report}");
    }
}

#[test]
fn numpy_acts_as_we_do() {
    let python = std::env::var("GETUP_TEST_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let script = model("policy").with_extension("py");
    for name in ["strong", "weak", "standing"] {
        let output = match Command::new(&python).arg(&script).arg(model(name)).output() {
            Ok(output) => output,
            Err(error) => return skip(format!("the controllers in NumPy: {python} does not start: {error}")),
        };
        let (said, complaint) = (text(&output.stdout), text(&output.stderr));
        if output.status.code() == Some(NO_MODULE) && complaint.contains("No module named 'numpy'") {
            return skip("the controllers in NumPy: it is not installed");
        }
        assert!(output.status.success(), "{complaint}");
        let theirs = said.split(['[', ']', ' ', '\n']).filter(|number| !number.is_empty());
        let theirs: Vec<f32> = theirs.map(|number| number.parse().unwrap()).collect();

        let policy = Policy::load(model(name)).unwrap();
        let beta: f32 = policy.metadata["beta"].parse().unwrap();
        let mut observation = vec![0.0; policy.shape.observation];
        *observation.last_mut().unwrap() = beta;
        let mut forward = Forward::new(&policy, 1);
        let ours: Vec<f32> = forward.run(&observation).mean.iter().map(|mean| squash(*mean, beta)).collect();
        assert_eq!((ours.len(), theirs.len()), (policy.shape.action, policy.shape.action), "{said}");
        for (ours, theirs) in ours.iter().zip(&theirs) {
            assert!((ours - theirs).abs() < 1e-4, "{name}: {ours} and {theirs}");
        }
    }
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}
