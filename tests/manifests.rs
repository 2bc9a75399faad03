//! What `deploy/` holds, against the schemas of those who read it: Grafana, Kubernetes, Compose.

mod common;

use std::path::{Path, PathBuf};
use std::process::Command;

/// The script's exit code where a package is missing.
const SKIPPED: i32 = 77;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The files of a folder whose names end so.
fn files(folder: &str, ending: &str) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(root().join(folder)).expect("a folder of this repository");
    let files = entries.map(|entry| entry.expect("a readable folder").path());
    files.filter(|path| path.to_string_lossy().ends_with(ending)).collect()
}

/// Has `manifests.py` check files, or says what was not checked.
fn check(kind: &str, files: &[PathBuf]) {
    assert!(!files.is_empty(), "nothing to check");
    let python = std::env::var("GETUP_TEST_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let script = root().join("tests/manifests.py");
    let output = match Command::new(&python).arg(script).arg(kind).args(files).output() {
        Ok(output) => output,
        Err(error) => return common::skip(format!("{kind}: {python} does not start: {error}")),
    };
    let said = String::from_utf8_lossy(&output.stdout);
    match output.status.code() {
        Some(0) => {}
        Some(SKIPPED) => common::skip(format!("{kind}: {python}: {said}")),
        _ => panic!("{said}{}", String::from_utf8_lossy(&output.stderr)),
    }
}

#[test]
fn dashboards_have_no_field_that_grafana_does_not_know() {
    check("dashboards", &files("deploy/grafana/dashboards", ".json"));
}

#[test]
fn compose_files_follow_the_specification() {
    let compose = files("deploy", ".yaml");
    assert_eq!(compose.len(), 3, "compose.yaml, compose.bench.yaml and compose.test.yaml: {compose:?}");
    check("compose", &compose);
}

/// Rendered as `kubectl apply -k` does it, and then as the API would take them.
#[test]
fn kubernetes_would_take_the_manifests() {
    let folder = tempfile::tempdir().unwrap();
    let mut rendered = Vec::new();
    for place in ["base", "overlays/gpu", "overlays/shards"] {
        let path = root().join("deploy/kubernetes").join(place);
        let output = match Command::new("kubectl").arg("kustomize").arg(&path).output() {
            Ok(output) => output,
            Err(error) => {
                return common::skip(format!("manifests of Kubernetes: kubectl does not start: {error}"));
            }
        };
        let stderr = String::from_utf8_lossy(&output.stderr);
        if !output.status.success() && kubectl_is_old() {
            return common::skip("manifests of Kubernetes: kubectl is older than 1.22");
        }
        assert!(output.status.success(), "{place}: {stderr}");
        let file = folder.path().join(place.replace('/', "-") + ".yaml");
        std::fs::write(&file, output.stdout).unwrap();
        rendered.push(file);
    }
    check("kubernetes", &rendered);
}

/// Whether its kustomize is one of those before 4, such as Debian 12's.
fn kubectl_is_old() -> bool {
    let output = Command::new("kubectl").args(["version", "--client", "--output=json"]).output();
    let version: serde_json::Value = serde_json::from_slice(&output.unwrap().stdout).unwrap();
    let minor = version["clientVersion"]["minor"].as_str().unwrap_or_default();
    minor.trim_end_matches('+').parse::<u32>().unwrap() < 22
}
