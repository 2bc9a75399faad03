//! The health service, probed as a container's health check probes it.

use getup_telemetry::health;
use getup_telemetry::health::ServingStatus;
use tonic::transport::server::TcpIncoming;
use tonic::transport::{Channel, Server};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

#[tokio::test]
async fn a_probe_sees_serving_and_then_the_drain() {
    let (reporter, service) = health();
    let port = TcpIncoming::bind("127.0.0.1:0".parse().unwrap()).unwrap();
    let address = port.local_addr().unwrap();
    tokio::spawn(Server::builder().add_service(service).serve_with_incoming(port));
    let endpoint = Channel::from_shared(format!("http://{address}")).unwrap();
    let mut client = HealthClient::new(endpoint.connect().await.unwrap());
    let status = async |client: &mut HealthClient<Channel>| {
        client.check(HealthCheckRequest::default()).await.unwrap().into_inner().status
    };
    assert_eq!(status(&mut client).await, ServingStatus::Serving as i32);
    reporter.set_service_status("", ServingStatus::NotServing).await;
    assert_eq!(status(&mut client).await, 2, "NOT_SERVING");
}
