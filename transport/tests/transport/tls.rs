//! Ports that want a certificate.

use std::sync::Arc;

use crate::support::{Folder, Port, call, channel, eventually, refusal};
use getup_transport::{SecurityConfig, generate_token, make_authority};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, ServerName};
use rustls::{ClientConfig, RootCertStore};
use tokio::io::AsyncReadExt;
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tonic::Code;

/// A folder with an authority and a peer of it.
fn authority() -> Folder {
    let folder = Folder::new();
    make_authority(folder.path(), folder.path(), &[], false).unwrap();
    folder
}

/// Another peer of the same authority.
fn another_peer(of: &Folder) -> Folder {
    let folder = Folder::new();
    for name in ["ca.pem", "ca.key"] {
        folder.write(name, of.text(name));
    }
    make_authority(folder.path(), folder.path(), &[], false).unwrap();
    folder
}

#[tokio::test]
async fn peers_of_one_authority_reach_each_other_by_name_and_by_address() {
    let server = authority();
    let port = Port::open(&server.tls()).await;
    let peer = another_peer(&server);
    let client = peer.tls();
    call(&port.channel(&client)).await.unwrap();
    for host in ["localhost", "http://localhost", "https://127.0.0.1"] {
        call(&channel(&format!("{host}:{}", port.address.port()), &client)).await.unwrap();
    }
    assert_eq!(port.refused("handshake"), 0);
}

#[tokio::test]
async fn a_certificate_does_not_replace_the_token() {
    let folder = authority();
    let config = SecurityConfig { token_file: folder.write("token", generate_token()), ..folder.tls() };
    let port = Port::open(&config).await;
    call(&port.channel(&config)).await.unwrap();
    assert_eq!(refusal(&port.channel(&folder.tls())).await.0, Code::Unauthenticated);
}

#[tokio::test]
async fn a_client_without_a_certificate_is_refused() {
    let server = authority();
    let port = Port::open(&server.tls()).await;
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_slice(server.text("ca.pem").as_bytes()).unwrap()).unwrap();
    let config = ClientConfig::builder_with_provider(rustls::crypto::ring::default_provider().into())
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .with_root_certificates(roots)
        .with_no_client_auth();
    let stream = TcpStream::connect(port.address).await.unwrap();
    let name = ServerName::try_from("localhost").unwrap();
    let mut stream = TlsConnector::from(Arc::new(config)).connect(name, stream).await.unwrap();
    let error = stream.read_u8().await.unwrap_err().to_string();
    assert!(error.contains("CertificateRequired"), "{error}");
    eventually(async || port.refused("handshake") == 1).await;

    refusal(&port.channel(&SecurityConfig::default())).await;
    eventually(async || port.refused("handshake") == 2).await;
}

#[tokio::test]
async fn peers_of_different_authorities_refuse_each_other() {
    let (server, client) = (authority(), authority());
    let port = Port::open(&server.tls()).await;
    let (code, message) = refusal(&port.channel(&client.tls())).await;
    assert_eq!(code, Code::Unavailable);
    assert!(message.contains("are the certificates of both ends from one authority?"), "{message}");
    // A client that believes the server and shows a certificate of its own authority.
    let mixed = SecurityConfig { ca: server.tls().ca, ..client.tls() };
    let status = call(&port.channel(&mixed)).await.unwrap_err();
    let reason = getup_transport::reason(&status);
    assert!(status.code() != Code::Unauthenticated && reason.contains("fatal alert"), "{reason}");
    eventually(async || port.refused("handshake") == 2).await;
}

#[tokio::test]
async fn a_client_with_certificates_does_not_talk_to_a_port_without() {
    let port = Port::open(&SecurityConfig::default()).await;
    let (code, message) = refusal(&port.channel(&authority().tls())).await;
    assert_eq!(code, Code::Unavailable);
    assert!(message.contains("no TLS with 127.0.0.1"), "{message}");
}

#[tokio::test]
async fn while_the_authority_changes_peers_of_both_are_let_in_and_then_those_of_the_new_one_alone() {
    let (old, new) = (authority(), authority());
    let both = old.text("ca.pem") + &new.text("ca.pem");
    let port = Port::open(&SecurityConfig { ca: old.write("both.pem", &both), ..old.tls() }).await;
    let peer = SecurityConfig { ca: new.write("both.pem", &both), ..new.tls() };
    call(&port.channel(&old.tls())).await.unwrap();
    call(&port.channel(&peer)).await.unwrap();
    old.write("both.pem", new.text("ca.pem"));
    eventually(async || call(&port.channel(&old.tls())).await.is_err()).await;
    call(&port.channel(&peer)).await.unwrap();
}

#[tokio::test]
async fn a_renewed_certificate_is_shown_to_new_connections_without_a_restart() {
    let server = authority();
    let peer = another_peer(&server);
    let client = peer.tls();
    let port = Port::open(&server.tls()).await;
    let open = port.channel(&client);
    call(&open).await.unwrap();
    // The certificate does not name this address.
    let other_name = channel(&format!("127.0.0.2:{}", port.address.port()), &client);
    let (_, message) = refusal(&other_name).await;
    assert!(message.contains("not valid for name"), "{message}");
    make_authority(server.path(), server.path(), &["127.0.0.2".to_owned()], false).unwrap();
    eventually(async || call(&other_name).await.is_ok()).await;
    call(&open).await.unwrap();
}

#[tokio::test]
async fn a_client_takes_a_new_certificate_at_its_next_connection() {
    let (server, client) = (authority(), authority());
    let port = Port::open(&server.tls()).await;
    let channel = port.channel(&client.tls());
    refusal(&channel).await;
    let right = another_peer(&server);
    for name in ["ca.pem", "peer.key", "peer.pem"] {
        client.write(name, right.text(name));
    }
    eventually(async || call(&channel).await.is_ok()).await;
}
