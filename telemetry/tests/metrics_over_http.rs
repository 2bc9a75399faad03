//! `serve_http`, asked as Prometheus asks it.

use std::sync::Arc;
use std::time::Duration;

use getup_telemetry::http::Guard;
use getup_telemetry::{Ready, Registry, Shown, Shutdown, Waits, build_info, registry, serve_http};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

async fn get(address: std::net::SocketAddr, path: &str) -> String {
    let mut stream = TcpStream::connect(address).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    answer
}

fn open(registry: Registry) -> Shown {
    Shown { registry, ready: Ready::default(), guard: Arc::new(|_| true) }
}

#[tokio::test]
async fn a_get_of_metrics_shows_roles_and_waits_and_any_other_path_is_not_found() {
    let registry = registry("laptop-0");
    build_info(&registry, "actor");
    build_info(&registry, "replay");
    let waits = Waits::new(&registry);
    let _guard = waits.begin("sampler", "812 of 1,000 transitions".into());
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let shutdown = Shutdown::new();
    let server = tokio::spawn(serve_http(listener, open(registry), shutdown.clone()));

    let answer = get(address, "/metrics").await;
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    assert!(answer.contains("content-type: text/plain; version=0.0.4"), "{answer}");
    assert!(
        answer.contains("getup_build_info{role=\"actor\",version=\"0.1.0\",run=\"laptop-0\"} 1"),
        "{answer}"
    );
    assert!(
        answer.contains("getup_build_info{role=\"replay\",version=\"0.1.0\",run=\"laptop-0\"} 1"),
        "{answer}"
    );
    assert!(answer.contains("getup_wait_seconds{what=\"sampler\",run=\"laptop-0\"} "), "{answer}");
    assert!(get(address, "/").await.starts_with("HTTP/1.1 404"));

    shutdown.trigger();
    server.await.unwrap().unwrap();
}

#[tokio::test]
async fn a_client_that_never_ends_its_request_does_not_hold_up_the_end() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let mut client = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
    let shutdown = Shutdown::new();
    let server = tokio::spawn(serve_http(listener, open(Registry::new()), shutdown.clone()));
    client.write_all(b"GET /met").await.unwrap();
    tokio::time::sleep(Duration::from_millis(50)).await;
    shutdown.trigger();
    tokio::time::timeout(Duration::from_secs(3), server).await.unwrap().unwrap().unwrap();
}

#[tokio::test]
async fn health_follows_the_roles_work_and_a_guard_keeps_metrics_alone() {
    let ready = Ready::default();
    let guard: Guard = Arc::new(|headers| headers.contains_key("authorization"));
    let shown = Shown { registry: registry("laptop-0"), ready: ready.clone(), guard };
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let shutdown = Shutdown::new();
    let server = tokio::spawn(serve_http(listener, shown, shutdown.clone()));
    assert!(get(address, "/healthz").await.starts_with("HTTP/1.1 503"));
    assert!(get(address, "/livez").await.starts_with("HTTP/1.1 200"));
    ready.set();
    assert!(get(address, "/healthz").await.starts_with("HTTP/1.1 200"));
    let refused = get(address, "/metrics").await;
    assert!(
        refused.starts_with("HTTP/1.1 401") && refused.contains("security.metrics_token_file"),
        "{refused}"
    );
    assert!(!refused.contains("process_resident_memory_bytes"));
    shutdown.trigger();
    server.await.unwrap().unwrap();
}
