//! The health service, probed as a container's health check probes it.

use std::time::Duration;

use getup_telemetry::{Shutdown, health};
use tonic::transport::server::TcpIncoming;
use tonic::transport::{Channel, Server};
use tonic_health::ServingStatus;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

#[tokio::test]
async fn a_probe_sees_serving_and_from_the_shutdown_on_the_drain() {
    let shutdown = Shutdown::new();
    let port = TcpIncoming::bind("127.0.0.1:0".parse().unwrap()).unwrap();
    let address = port.local_addr().unwrap();
    tokio::spawn(Server::builder().add_service(health(shutdown.clone())).serve_with_incoming(port));
    let endpoint = Channel::from_shared(format!("http://{address}")).unwrap();
    let mut client = HealthClient::new(endpoint.connect().await.unwrap());
    let mut answers = client.watch(HealthCheckRequest::default()).await.unwrap().into_inner();
    let mut next = async || {
        let answer = tokio::time::timeout(Duration::from_secs(15), answers.message()).await;
        answer.expect("an answer in time").unwrap().expect("the service goes on").status
    };
    assert_eq!(next().await, ServingStatus::Serving as i32);
    shutdown.trigger();
    assert_eq!(next().await, 2, "NOT_SERVING");
}
