//! The health service, probed as a container's health check probes it.

use std::net::SocketAddr;

use getup_telemetry::health;
use getup_telemetry::health::ServingStatus;
use tonic::transport::{Channel, Server};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

#[tokio::test]
async fn a_probe_sees_serving_and_then_the_drain() {
    let (reporter, service) = health();
    let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address: SocketAddr = free.local_addr().unwrap();
    drop(free);
    tokio::spawn(Server::builder().add_service(service).serve(address));
    let endpoint = Channel::from_shared(format!("http://{address}")).unwrap();
    let channel = loop {
        match endpoint.connect().await {
            Ok(channel) => break channel,
            Err(_) => tokio::time::sleep(std::time::Duration::from_millis(20)).await,
        }
    };
    let mut client = HealthClient::new(channel);
    let status = async |client: &mut HealthClient<Channel>| {
        client.check(HealthCheckRequest::default()).await.unwrap().into_inner().status
    };
    assert_eq!(status(&mut client).await, ServingStatus::Serving as i32);
    reporter.set_service_status("", ServingStatus::NotServing).await;
    assert_eq!(status(&mut client).await, 2, "NOT_SERVING");
}
