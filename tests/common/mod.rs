//! What tests of whole processes share: starting, scraping, waiting, stopping.

#![allow(dead_code)]

use std::collections::BTreeSet;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// The program under test.
pub(crate) const GETUP: &str = env!("CARGO_BIN_EXE_getup");

/// A command of the program, without settings from this environment.
pub(crate) fn getup(arguments: &[&str]) -> Command {
    let mut command = Command::new(GETUP);
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("GETUP_")) {
        command.env_remove(name);
    }
    command.args(arguments).stdin(Stdio::null());
    command
}

/// Says what is not checked, past the test harness, which keeps to itself what a test that passes prints.
pub(crate) fn skip(what: impl std::fmt::Display) {
    let _ = writeln!(std::io::stderr(), "skipped: {what}");
}

/// Runs a command to its end.
pub(crate) fn output(command: &mut Command) -> Output {
    command.output().expect("the program starts")
}

/// Runs a command that must succeed; its stdout.
pub(crate) fn succeed(command: &mut Command) -> String {
    let output = output(command);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?} ended with {}:\n{stderr}", output.status);
    String::from_utf8(output.stdout).expect("output is text")
}

/// Runs a command that must fail; its stderr.
pub(crate) fn fail(command: &mut Command) -> String {
    let output = output(command);
    assert!(!output.status.success(), "{command:?} succeeded");
    String::from_utf8(output.stderr).expect("output is text")
}

/// A process that is killed when the test is over, its log in a file.
pub(crate) struct Process {
    child: Child,
    name: &'static str,
    log: PathBuf,
}

impl Process {
    /// Starts a command; its stderr goes to `folder/<name>.log`, after what is there.
    pub(crate) fn start(name: &'static str, folder: &Path, command: &mut Command) -> Self {
        let log = folder.join(format!("{name}.log"));
        let file = std::fs::OpenOptions::new().create(true).append(true).open(&log).expect("a log file");
        let child = command.stderr(file).stdout(Stdio::null()).spawn().expect("the program starts");
        Self { child, name, log }
    }

    /// Sends a signal by its name, such as `TERM`.
    pub(crate) fn signal(&self, signal: &str) {
        let status = Command::new("kill").args(["-s", signal, &self.child.id().to_string()]).status();
        assert!(status.expect("kill runs").success());
    }

    /// Waits for the end, at most `limit`.
    pub(crate) fn wait(&mut self, limit: Duration) -> ExitStatus {
        let until = Instant::now() + limit;
        loop {
            if let Some(status) = self.child.try_wait().expect("the process is ours") {
                return status;
            }
            assert!(Instant::now() < until, "{} did not end within {limit:?}:\n{}", self.name, self.log());
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Fails the test if the process has ended.
    pub(crate) fn assert_running(&mut self) {
        if let Some(status) = self.child.try_wait().expect("the process is ours") {
            panic!("{} ended with {status}:\n{}", self.name, self.log());
        }
    }

    /// What it has logged.
    pub(crate) fn log(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Addresses and folder of one cluster, of preset smoke.
pub(crate) struct Cluster {
    folder: tempfile::TempDir,
    addresses: [(&'static str, String); 5],
}

impl Cluster {
    /// Free addresses, and an empty folder.
    pub(crate) fn new() -> Self {
        Self::with_replay(free_address())
    }

    /// With the replays at these addresses.
    pub(crate) fn with_replay(replay: String) -> Self {
        let names = ["replay", "learner", "replay_metrics", "learner_metrics", "actor_metrics"];
        let address = |name| if name == "replay" { replay.clone() } else { free_address() };
        Self { folder: tempfile::tempdir().unwrap(), addresses: names.map(|name| (name, address(name))) }
    }

    /// One of the addresses.
    pub(crate) fn address(&self, name: &str) -> &str {
        &self.addresses.iter().find(|(known, _)| *known == name).unwrap().1
    }

    /// Where all its processes run.
    pub(crate) fn path(&self) -> &Path {
        self.folder.path()
    }

    /// A command of this cluster: preset, addresses, a curriculum that a limp body passes.
    pub(crate) fn command(&self, role: &str, omega: f64) -> Command {
        let mut command = getup(&[role, "--preset", "smoke", "--set", "run=smoke"]);
        command.args(["--set", &format!("curriculum.omega={omega}")]);
        for (name, address) in &self.addresses {
            command.args(["--set", &format!("network.{name}={address}")]);
        }
        command.current_dir(self.path());
        command
    }

    /// Starts a role; it joins the others, whoever came first.
    pub(crate) fn start(&self, role: &'static str, omega: f64) -> Process {
        Process::start(role, self.path(), self.command(role, omega).args(["--log-format", "json"]))
    }

    /// A metric of the learner, by its name without the prefix.
    pub(crate) fn learner_metric(&self, name: &str) -> Option<f64> {
        metric(self.address("learner_metrics"), &format!("getup_learner_{name}"))
    }

    /// What `getup status --json` says.
    pub(crate) fn status(&self) -> Option<serde_json::Value> {
        let output = self.command("status", 1.0).arg("--json").output().unwrap();
        serde_json::from_slice(&output.stdout).ok()
    }
}

/// An address on loopback that nobody listens at now, and that nobody else in this process was given.
pub(crate) fn free_address() -> String {
    static GIVEN: Mutex<BTreeSet<u16>> = Mutex::new(BTreeSet::new());
    loop {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = listener.local_addr().expect("it is bound");
        if GIVEN.lock().expect("nobody fails with it").insert(address.port()) {
            return address.to_string();
        }
    }
}

/// The text of `/metrics`; none where nobody answers.
pub(crate) fn scrape(address: &str) -> Option<String> {
    http_get(address, "/metrics")
}

/// What is at this path; none where nobody answers with 200.
pub(crate) fn http_get(address: &str, path: &str) -> Option<String> {
    let mut stream = TcpStream::connect(address).ok()?;
    stream.set_read_timeout(Some(Duration::from_secs(5))).ok()?;
    // HTTP/1.0: the body comes in one piece.
    let request = format!("GET {path} HTTP/1.0\r\nHost: {address}\r\n\r\n");
    stream.write_all(request.as_bytes()).ok()?;
    let mut response = String::new();
    stream.read_to_string(&mut response).ok()?;
    let (head, body) = response.split_once("\r\n\r\n")?;
    head.split(' ').nth(1).is_some_and(|code| code == "200").then(|| body.to_owned())
}

/// The first sample of this name in `/metrics`.
pub(crate) fn metric(address: &str, name: &str) -> Option<f64> {
    let text = scrape(address)?;
    let value = |line: &str| {
        let rest = line.strip_prefix(name)?;
        // Behind its labels, where it has some.
        let value =
            rest.strip_prefix('{').map_or(rest.strip_prefix(' '), |labels| Some(labels.split_once("} ")?.1));
        value?.parse().ok()
    };
    text.lines().find_map(value)
}

/// Waits until `condition` gives something, at most `limit`; `what` names it where it does not.
pub(crate) fn wait_for<T>(what: &str, limit: Duration, mut condition: impl FnMut() -> Option<T>) -> T {
    let until = Instant::now() + limit;
    loop {
        if let Some(value) = condition() {
            return value;
        }
        assert!(Instant::now() < until, "not within {limit:?}: {what}");
        std::thread::sleep(Duration::from_millis(100));
    }
}
