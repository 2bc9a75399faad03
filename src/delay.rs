//! `getup delay`: a TCP proxy that holds up what passes, for faults of `getup chaos` where the kernel has no such network.

use std::time::Duration;

use anyhow::{Context, Result};
use futures::future::try_join_all;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep_until};

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
        println!("{} is {target}, {} s later", listener.local_addr()?, by.as_secs_f64());
        routes.push(serve(listener, target, by));
    }
    try_join_all(routes).await.map(drop)
}

async fn serve(listener: TcpListener, target: &str, by: Duration) -> Result<()> {
    loop {
        let (client, address) = listener.accept().await.context("cannot accept")?;
        let target = target.to_owned();
        tokio::spawn(async move {
            let ended = pass_on(client, &target, by).await;
            let how = ended.map_or_else(|error| error.to_string(), |()| "both sides ended it".to_owned());
            println!("{address} to {target}: {how}");
        });
    }
}

async fn pass_on(client: TcpStream, target: &str, by: Duration) -> std::io::Result<()> {
    let service = TcpStream::connect(target).await?;
    client.set_nodelay(true)?;
    service.set_nodelay(true)?;
    let ((from_client, to_client), (from_service, to_service)) = (client.into_split(), service.into_split());
    tokio::try_join!(pump(from_client, to_service, by), pump(from_service, to_client, by)).map(drop)
}

/// One direction, to its end.
async fn pump(mut from: OwnedReadHalf, mut to: OwnedWriteHalf, by: Duration) -> std::io::Result<()> {
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
    let write = async move {
        while let Some((due, chunk)) = chunks.recv().await {
            sleep_until(due).await;
            // An empty one is the end.
            if chunk.is_empty() { to.shutdown().await? } else { to.write_all(&chunk).await? }
        }
        Ok(())
    };
    tokio::try_join!(read, write).map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn everything_comes_whole_and_later_and_so_does_the_end() {
        const BY: Duration = Duration::from_millis(50);
        let service = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let proxy = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let (target, address) = (service.local_addr().unwrap().to_string(), proxy.local_addr().unwrap());
        tokio::spawn(async move { serve(proxy, &target, BY).await });
        // Answers with what it got, once that is all.
        let echo = async {
            let (mut stream, _) = service.accept().await.unwrap();
            let mut got = Vec::new();
            stream.read_to_end(&mut got).await.unwrap();
            stream.write_all(&got).await.unwrap();
        };
        let sent: Vec<u8> = (0..3 * CHUNK).map(|byte| byte as u8).collect();
        let ask = async {
            let mut stream = TcpStream::connect(address).await.unwrap();
            let started = Instant::now();
            stream.write_all(&sent).await.unwrap();
            stream.shutdown().await.unwrap();
            let mut got = Vec::new();
            stream.read_to_end(&mut got).await.unwrap();
            (got, started.elapsed())
        };
        let ((), (got, took)) = tokio::join!(echo, ask);
        assert!(got == sent, "{} bytes came of {}", got.len(), sent.len());
        assert!(took >= 2 * BY, "there and back in {took:?}");
    }
}
