//! What a port lets its peers take.

use std::time::Duration;

use crate::support::{Folder, PATIENCE, Port, call, channel, eventually, refusal};
use getup_transport::{ChannelOptions, Credentials, Limits, SecurityConfig, generate_token, make_authority};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tonic::Code;

fn open() -> SecurityConfig {
    SecurityConfig::default()
}

#[tokio::test]
async fn one_address_has_so_many_connections_and_another_has_its_own() {
    let limits = Limits { connections_per_peer: 2, ..Limits::default() };
    let port = Port::limited(&open(), limits).await;
    let channels = [port.channel(&open()), port.channel(&open())];
    for channel in &channels {
        call(channel).await.unwrap();
    }
    let third = port.channel(&open());
    assert_ne!(refusal(&third).await.0, Code::Unauthenticated);
    assert!(port.refused("peer_connections") >= 1);
    assert_eq!(port.connections(), 2);
    let socket = tokio::net::TcpSocket::new_v4().unwrap();
    socket.bind("127.0.0.2:0".parse().unwrap()).unwrap();
    let elsewhere = socket.connect(port.address).await.unwrap();
    eventually(async || port.connections() == 3).await;
    drop(channels);
    eventually(async || call(&third).await.is_ok()).await;
    drop(elsewhere);
    eventually(async || port.connections() == 1).await;
    assert_eq!((port.refused("connections"), port.refused("handshake")), (0, 0));
}

#[tokio::test]
async fn there_are_so_many_connections_in_all() {
    let port = Port::limited(&open(), Limits { connections: 1, ..Limits::default() }).await;
    let first = port.channel(&open());
    call(&first).await.unwrap();
    refusal(&port.channel(&open())).await;
    assert!(port.refused("connections") >= 1);
    call(&first).await.unwrap();
}

#[tokio::test]
async fn a_connection_without_a_call_that_is_let_in_is_closed_and_one_with_such_a_call_stays() {
    let folder = Folder::new();
    let config = folder.token(&generate_token());
    let limits = Limits { handshake_timeout: Duration::from_millis(500), ..Limits::default() };
    let port = Port::limited(&config, limits).await;
    let channel = port.channel(&config);
    eventually(async || call(&channel).await.is_ok()).await;
    let mut silent = TcpStream::connect(port.address).await.unwrap();
    let stranger = port.channel(&open());
    refusal(&stranger).await;
    let mut buffer = Vec::new();
    // Whatever the server says at first, it ends.
    let _ = silent.read_to_end(&mut buffer).await;
    eventually(async || port.refused("handshake") >= 2 && port.connections() == 1).await;
    call(&channel).await.unwrap();
    assert_eq!(port.connections(), 1);
}

#[tokio::test]
async fn a_peer_that_does_not_finish_the_tls_handshake_is_dropped() {
    let folder = Folder::new();
    make_authority(folder.path(), folder.path(), &[], false).unwrap();
    let limits = Limits { handshake_timeout: Duration::from_millis(100), ..Limits::default() };
    let port = Port::limited(&folder.tls(), limits).await;
    let mut silent = TcpStream::connect(port.address).await.unwrap();
    assert_eq!(silent.read_to_end(&mut Vec::new()).await.unwrap(), 0);
    eventually(async || (port.refused("handshake"), port.connections()) == (1, 0)).await;
}

#[tokio::test]
async fn a_peer_that_reads_nothing_is_dropped() {
    let limits = Limits {
        send_timeout: Duration::from_millis(300),
        handshake_timeout: Duration::from_secs(3600),
        ..Limits::default()
    };
    let port = Port::limited(&open(), limits).await;
    flood(&port).await;
    eventually(async || port.connections() == 0).await;
}

/// Pings a port and reads nothing, until it is dropped.
async fn flood(port: &Port) {
    let mut peer = TcpStream::connect(port.address).await.unwrap();
    // The preface and empty settings of HTTP/2, and then pings whose answers stay in the socket.
    peer.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0").await.unwrap();
    let pings = b"\0\0\x08\x06\0\0\0\0\0pingpong".repeat(1000);
    let flood = async { while peer.write_all(&pings).await.is_ok() {} };
    tokio::time::timeout(PATIENCE, flood).await.expect("the peer should be dropped");
}

#[tokio::test]
async fn a_stranger_that_reads_nothing_has_no_longer_than_others() {
    let folder = Folder::new();
    let config = folder.token(&generate_token());
    let limits = Limits {
        send_timeout: Duration::from_secs(3600),
        handshake_timeout: Duration::from_millis(500),
        ..Limits::default()
    };
    let port = Port::limited(&config, limits).await;
    flood(&port).await;
    eventually(async || port.refused("handshake") == 1 && port.connections() == 0).await;
}

#[tokio::test]
async fn a_port_is_closed_at_once_by_a_shutdown() {
    let port = Port::open(&open()).await;
    call(&port.channel(&open())).await.unwrap();
    port.close();
    eventually(async || TcpStream::connect(port.address).await.is_err()).await;
}

#[tokio::test]
async fn a_call_to_nobody_names_the_address_and_what_is_wrong() {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    drop(listener);
    let status = call(&channel(&address, &open())).await.unwrap_err();
    assert_eq!(status.code(), Code::Unavailable);
    let reason = getup_transport::reason(&status);
    assert!(reason.contains(&address) && reason.matches("refused").count() == 1, "{reason}");
}

#[tokio::test]
async fn what_is_no_address_is_refused_with_the_reason() {
    let wrong = [
        ("replay", "host and a port"),
        (":7400", ""),
        ("", ""),
        ("ftp://replay:7400", "neither http nor https"),
        ("https://replay:7400", "security.ca"),
        ("replay:7400/path", "nothing follows the port"),
        ("replay:7400#part", "nothing else"),
        ("somebody@replay:7400", "nothing else"),
        ("replay:port", ""),
    ];
    let credentials = Credentials::default();
    for (address, reason) in wrong {
        let error = credentials.channel(address, ChannelOptions::default()).unwrap_err().to_string();
        assert!(error.starts_with(&format!("{address:?} is not the address of a service")), "{error}");
        assert!(error.contains(reason), "{error}");
    }
    for address in ["replay:7400", "http://replay:7400", "http://10.0.0.1:7400/", "[::1]:7400"] {
        credentials.channel(address, ChannelOptions::default()).unwrap();
    }
}
