//! Processes of this program, and what each takes of the machine.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, ensure};
use getup_telemetry::{Registry, Shutdown};
use getup_transport::{Credentials, Limits, Metrics, Server};
use serde_json::Value;
use tokio::io::AsyncBufReadExt;
use tokio::net::TcpListener;

/// How long a process may take to end.
const GRACE: Duration = Duration::from_secs(3);
/// Ticks a second in /proc: the same on every Linux.
const TICKS: f64 = 100.0;

/// Works on a runtime as a role's until the work ends or a signal comes.
pub(crate) fn work_until(shutdown: &Shutdown, work: impl Future<Output = Result<()>>) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let worked = runtime.block_on(async {
        shutdown.on_signals()?;
        tokio::select! {
            worked = work => worked,
            () = shutdown.wait() => Ok(()),
        }
    });
    shutdown.trigger();
    runtime.shutdown_timeout(GRACE / 6);
    worked
}

/// Answers every line of the process that started this one, until that has ended or lets go.
pub(crate) async fn answer(mut counts: impl FnMut() -> Value) -> Result<()> {
    let mut lines = tokio::io::BufReader::new(tokio::io::stdin()).lines();
    while lines.next_line().await?.is_some() {
        say(&counts().to_string())?;
    }
    Ok(())
}

pub(crate) fn say(line: &str) -> Result<()> {
    let mut output = std::io::stdout().lock();
    writeln!(output, "{line}")?;
    Ok(output.flush()?)
}

pub(crate) async fn listen() -> Result<TcpListener> {
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    say(&format!("listening on {}", listener.local_addr()?))?;
    Ok(listener)
}

/// An open port. All actors come from one address here, which has places for no more than 256 otherwise.
pub(crate) fn port(limits: Limits) -> Server {
    let limits = Limits { connections_per_peer: limits.connections, ..limits };
    Server::new(Credentials::default(), limits, Metrics::new(&Registry::new()))
}

/// A process of this program; it ends when this is dropped, or this process ends.
pub(crate) struct Process {
    child: Child,
    input: Option<ChildStdin>,
    output: BufReader<ChildStdout>,
    /// Its first line.
    greeting: String,
}

impl Process {
    pub(crate) fn start(arguments: &[&str]) -> Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        let mut child = command.args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let input = child.stdin.take();
        let output = BufReader::new(child.stdout.take().context("it is piped")?);
        let mut process = Self { child, input, output, greeting: String::new() };
        process.greeting = process.line()?;
        Ok(process)
    }

    fn line(&mut self) -> Result<String> {
        let mut line = String::new();
        self.output.read_line(&mut line)?;
        ensure!(!line.is_empty(), "a process of the fleet has ended: what it wrote above says why");
        Ok(line.trim().to_owned())
    }

    /// What follows these words in its first line.
    pub(crate) fn said(&self, words: &str) -> Result<&str> {
        let rest = self.greeting.strip_prefix(words);
        rest.with_context(|| format!("a process says {:?} and not {words:?}", self.greeting))
    }

    /// Its counts since it was last asked.
    pub(crate) fn ask(&mut self) -> Result<Value> {
        writeln!(self.input.as_mut().context("it is piped")?)?;
        Ok(serde_json::from_str(&self.line()?)?)
    }

    /// Processor seconds so far.
    pub(crate) fn cpu(&self) -> Result<f64> {
        let stat = fs::read_to_string(format!("/proc/{}/stat", self.child.id()))?;
        // The name before it, in parentheses, may contain spaces. After it the 12th and 13th fields.
        let (_, fields) = stat.rsplit_once(')').context("a process has a name")?;
        ticks(fields.split_whitespace().skip(11).take(2))
    }

    /// Resident bytes.
    pub(crate) fn resident(&self) -> Result<u64> {
        let status = fs::read_to_string(format!("/proc/{}/status", self.child.id()))?;
        let line =
            status.lines().find_map(|line| line.strip_prefix("VmRSS:")).context("a process has a size")?;
        Ok(1024 * line.trim().trim_end_matches(" kB").parse::<u64>()?)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        drop(self.input.take());
        let until = Instant::now() + GRACE;
        while Instant::now() < until && matches!(self.child.try_wait(), Ok(None)) {
            thread::sleep(Duration::from_millis(20));
        }
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Processor seconds of the whole machine so far.
pub(crate) fn machine_cpu() -> Result<f64> {
    let stat = fs::read_to_string("/proc/stat")?;
    let fields: Vec<&str> = stat.lines().next().context("/proc/stat has lines")?.split_whitespace().collect();
    // user, nice, system; irq, softirq.
    ticks([1, 2, 3, 6, 7].into_iter().filter_map(|place| fields.get(place).copied()))
}

fn ticks<'a>(fields: impl Iterator<Item = &'a str>) -> Result<f64> {
    let ticks: u64 = fields.map(str::parse::<u64>).sum::<Result<_, _>>()?;
    Ok(ticks as f64 / TICKS)
}

pub(crate) fn unix_seconds() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}
