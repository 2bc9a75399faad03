//! Ports that want a token.

use crate::support::{Folder, Port, call, eventually, refusal};
use getup_transport::{Credentials, SecurityConfig, generate_token};
use http::HeaderMap;
use http::header::AUTHORIZATION;
use tonic::Code;

#[tokio::test]
async fn a_call_with_the_token_is_let_in_and_any_other_is_told_what_to_do() {
    let (folder, other) = (Folder::new(), Folder::new());
    let config = folder.token(&generate_token());
    let port = Port::open(&config).await;
    call(&port.channel(&config)).await.unwrap();
    assert_eq!(port.refused("token"), 0);

    let (code, message) = refusal(&port.channel(&SecurityConfig::default())).await;
    assert_eq!(code, Code::Unauthenticated);
    assert!(message.contains("this port wants a token: set security.token_file"), "{message}");
    assert_eq!(port.refused("token"), 1);

    let (code, message) = refusal(&port.channel(&other.token(&generate_token()))).await;
    assert_eq!(code, Code::Unauthenticated);
    assert!(message.contains("this port wants another token: security.token_file must hold"), "{message}");
    assert_eq!(port.refused("token"), 2);
}

#[tokio::test]
async fn a_port_without_a_token_takes_calls_with_one() {
    let port = Port::open(&SecurityConfig::default()).await;
    call(&port.channel(&Folder::new().token(&generate_token()))).await.unwrap();
    call(&port.channel(&SecurityConfig::default())).await.unwrap();
}

#[tokio::test]
async fn a_token_is_changed_under_open_connections() {
    let (server, client, other) = (Folder::new(), Folder::new(), Folder::new());
    let (old, new) = (generate_token(), generate_token());
    let port = Port::open(&server.token(&old)).await;
    let channel = port.channel(&client.token(&old));
    call(&channel).await.unwrap();
    // First both are accepted, then all clients send the new one, then the old one goes.
    server.token(&format!("{old}\n{new}\n"));
    let newcomer = port.channel(&other.token(&new));
    eventually(async || call(&newcomer).await.is_ok()).await;
    call(&channel).await.unwrap();
    client.token(&new);
    server.token(&new);
    let late = Folder::new();
    let late = port.channel(&late.token(&old));
    eventually(async || call(&late).await.is_err()).await;
    eventually(async || call(&channel).await.is_ok()).await;
    call(&newcomer).await.unwrap();
}

#[test]
fn metrics_want_their_own_token_where_one_is_set() {
    let folder = Folder::new();
    let token = generate_token();
    let metrics_token_file = folder.write("metrics", &token);
    let config = SecurityConfig { metrics_token_file, ..folder.token(&generate_token()) };
    let headers = |value: &str| HeaderMap::from_iter([(AUTHORIZATION, value.parse().unwrap())]);
    let credentials = Credentials::load(&config).unwrap();
    assert!(credentials.may_read_metrics(&headers(&format!("Bearer {token}"))));
    assert!(!credentials.may_read_metrics(&headers(&format!("Bearer {}", folder.text("token")))));
    assert!(!credentials.may_read_metrics(&HeaderMap::new()));
    assert!(Credentials::default().may_read_metrics(&HeaderMap::new()));
}
