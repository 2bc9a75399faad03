//! `getup health`: what a container's health check asks.

use std::io::{Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::Duration;

use anyhow::{Context, Result, anyhow, bail, ensure};
use clap::ValueEnum;

use crate::config::{ConfigArgs, reached_at};
use crate::output::say;

const PATIENCE: Duration = Duration::from_secs(3);

/// Ask a role on this machine whether it does its work: ends with 0 if it does.
///
/// It asks the role's own HTTP port, network.ROLE_metrics, which also serves /metrics.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Whom to ask.
    role: Asked,
    #[command(flatten)]
    config: ConfigArgs,
}

#[derive(Clone, Copy, ValueEnum)]
enum Asked {
    Replay,
    Learner,
    Actor,
}

pub(crate) fn run(arguments: Args) -> Result<()> {
    let network = arguments.config.load()?.network;
    let (name, address) = match arguments.role {
        Asked::Replay => ("replay", network.replay_metrics),
        Asked::Learner => ("learner", network.learner_metrics),
        Asked::Actor => ("actor", network.actor_metrics),
    };
    ensure!(
        !address.ends_with(":0"),
        "network.{name}_metrics = {address}: a role that takes any port cannot be found; give it one, there and here"
    );
    let address = reached_at(&address);
    let answer = ask(&address).with_context(|| format!("the {name} does not answer at {address}"))?;
    let (head, body) = answer.split_once("\r\n\r\n").unwrap_or((&answer, ""));
    if head.split(' ').nth(1) != Some("200") {
        bail!("the {name} is there and does not work yet or any more: {}", body.trim());
    }
    say!("{}", body.trim());
    Ok(())
}

fn ask(address: &str) -> Result<String> {
    let mut stream = connect(address)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    write!(stream, "GET /healthz HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n")?;
    let mut answer = String::new();
    // More than this no role answers.
    stream.take(1 << 16).read_to_string(&mut answer)?;
    Ok(answer)
}

/// A name may have several addresses, and the role listens at one of them.
fn connect(address: &str) -> Result<TcpStream> {
    let mut refused = None;
    for resolved in address.to_socket_addrs()? {
        match TcpStream::connect_timeout(&resolved, PATIENCE) {
            Ok(stream) => return Ok(stream),
            Err(error) => refused = Some(error),
        }
    }
    Err(refused.map_or_else(|| anyhow!("the name has no address"), Into::into))
}
