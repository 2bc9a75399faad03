//! `getup delay`: a TCP proxy that holds up what passes, for faults of tests and of `getup chaos` where the kernel has no
//! such network.

use std::io::Write as _;
use std::num::NonZeroU32;
use std::time::Duration;

use anyhow::{Context, Result};
use futures::future::try_join_all;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep, sleep_until};

use crate::output::say;

/// Bytes that are passed on at a time, at most.
const CHUNK: usize = 16 << 10;
/// So many chunks are on their way in one direction of a connection, at most: 16 MiB.
const CHUNKS: usize = 1024;

/// Pass TCP connections on, and all that they carry later.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Where to listen, and where what connects there is passed on to: `127.0.0.1:17401=replay:7401`.
    #[arg(required = true, value_name = "LISTEN=TARGET")]
    routes: Vec<String>,
    /// So many seconds later, in each direction.
    #[arg(long, value_name = "SECONDS", default_value_t = 0.2)]
    by: f64,
    /// Only so many bytes a second come back from each target's connection; without this, as many as it sends.
    #[arg(long, value_name = "BYTES")]
    back: Option<NonZeroU32>,
}

/// What a connection suffers.
#[derive(Clone, Copy)]
struct Slowness {
    /// Each way.
    by: Duration,
    /// Bytes a second from the service to the client.
    back: Option<NonZeroU32>,
}

#[tokio::main(flavor = "current_thread")]
pub(crate) async fn run(arguments: Args) -> Result<()> {
    let by = Duration::try_from_secs_f64(arguments.by).with_context(|| format!("--by {}", arguments.by))?;
    let mut routes = Vec::new();
    for route in &arguments.routes {
        let (listen, target) =
            route.split_once('=').with_context(|| format!("{route} is not LISTEN=TARGET"))?;
        let listener =
            TcpListener::bind(listen).await.with_context(|| format!("cannot listen at {listen}"))?;
        say!("{} is {target}, {} s later", listener.local_addr()?, by.as_secs_f64());
        routes.push(serve(listener, target, Slowness { by, back: arguments.back }));
    }
    try_join_all(routes).await.map(drop)
}

async fn serve(listener: TcpListener, target: &str, slowness: Slowness) -> Result<()> {
    loop {
        let (client, address) = listener.accept().await.context("cannot accept")?;
        let target = target.to_owned();
        tokio::spawn(async move {
            let ended = pass_on(client, &target, slowness).await;
            let how = ended.map_or_else(|error| error.to_string(), |()| "both sides ended it".to_owned());
            // Whoever read it may have gone; the other connections have not.
            let _ = writeln!(std::io::stdout(), "{address} to {target}: {how}");
        });
    }
}

async fn pass_on(client: TcpStream, target: &str, slowness: Slowness) -> std::io::Result<()> {
    let service = TcpStream::connect(target).await?;
    client.set_nodelay(true)?;
    service.set_nodelay(true)?;
    let ((from_client, to_client), (from_service, to_service)) = (client.into_split(), service.into_split());
    let Slowness { by, back } = slowness;
    tokio::try_join!(pump(from_client, to_service, by, None), pump(from_service, to_client, by, back))
        .map(drop)
}

/// One direction, to its end, at `rate` bytes a second if there is one.
async fn pump(
    mut from: OwnedReadHalf,
    mut to: OwnedWriteHalf,
    by: Duration,
    rate: Option<NonZeroU32>,
) -> std::io::Result<()> {
    let (sender, mut chunks) = mpsc::channel(CHUNKS);
    let read = async move {
        loop {
            let mut chunk = Vec::with_capacity(CHUNK);
            let ended = from.read_buf(&mut chunk).await? == 0;
            // Where nobody writes any more, that has failed.
            if sender.send((Instant::now() + by, chunk)).await.is_err() || ended {
                return Ok(());
            }
        }
    };
    // Of a slow direction, a tenth of a second's bytes at a time.
    let piece = rate.map_or(CHUNK, |rate| (rate.get() as usize / 10).max(1));
    let write = async move {
        while let Some((due, chunk)) = chunks.recv().await {
            sleep_until(due).await;
            // An empty one is the end.
            if chunk.is_empty() {
                to.shutdown().await?;
            }
            for piece in chunk.chunks(piece) {
                to.write_all(piece).await?;
                if let Some(rate) = rate {
                    sleep(Duration::from_secs_f64(piece.len() as f64 / f64::from(rate.get()))).await;
                }
            }
        }
        Ok(())
    };
    tokio::try_join!(read, write).map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;

    const BY: Duration = Duration::from_millis(50);

    /// What an echo through the proxy gives back for some bytes, once it has them all, and after how long.
    async fn echo(sent: &[u8], slowness: Slowness) -> (Vec<u8>, Duration) {
        let service = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let proxy = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let (target, address) = (service.local_addr().unwrap().to_string(), proxy.local_addr().unwrap());
        tokio::spawn(async move { serve(proxy, &target, slowness).await });
        let answer = async {
            let (mut stream, _) = service.accept().await.unwrap();
            let mut got = Vec::new();
            stream.read_to_end(&mut got).await.unwrap();
            stream.write_all(&got).await.unwrap();
        };
        let ask = async {
            let mut stream = TcpStream::connect(address).await.unwrap();
            let started = Instant::now();
            stream.write_all(sent).await.unwrap();
            stream.shutdown().await.unwrap();
            let mut got = Vec::new();
            stream.read_to_end(&mut got).await.unwrap();
            (got, started.elapsed())
        };
        tokio::join!(answer, ask).1
    }

    fn bytes(count: usize) -> Vec<u8> {
        (0..count).map(|byte| byte as u8).collect()
    }

    #[tokio::test]
    async fn everything_comes_whole_and_later_and_so_does_the_end() {
        let sent = bytes(3 * CHUNK);
        let (got, took) = echo(&sent, Slowness { by: BY, back: None }).await;
        assert!(got == sent, "{} bytes came of {}", got.len(), sent.len());
        assert!(took >= 2 * BY, "there and back in {took:?}");
    }

    #[tokio::test]
    async fn a_narrow_way_back_carries_so_many_bytes_a_second() {
        let sent = bytes(3_000);
        let (got, took) = echo(&sent, Slowness { by: Duration::ZERO, back: NonZeroU32::new(10_000) }).await;
        assert!(got == sent, "{} bytes came of {}", got.len(), sent.len());
        assert!(took >= Duration::from_millis(300), "there and back in {took:?}");
    }
}
