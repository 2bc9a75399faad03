//! Mutual TLS: both ends show a certificate of an authority that the other knows.

use std::sync::Arc;

use rustls::client::Resumption;
use rustls::crypto::{CryptoProvider, ring};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::{NoServerSessionStorage, WebPkiClientVerifier};
use rustls::{ClientConfig, RootCertStore, ServerConfig};

use crate::SecurityError;
use crate::reload::File;

/// What gRPC speaks, for both ends to agree on.
const ALPN: &[u8] = b"h2";

/// The two ends of TLS, from the same three files.
pub(crate) struct Tls {
    pub(crate) client: Arc<ClientConfig>,
    pub(crate) server: Arc<ServerConfig>,
}

impl Tls {
    /// Reads `ca`, `certificate` and `key`, in this order.
    pub(crate) fn parse(files: &[File]) -> Result<Self, SecurityError> {
        let [ca, certificate, key] = files else { unreachable!("mutual TLS has three files") };
        let roots = Arc::new(roots(ca)?);
        let chain = certificates(certificate)?;
        let key = private_key(key)?;
        let unfit = |error: rustls::Error| {
            certificate
                .malformed(format!("cannot be used with security.key: {error}; do they belong together?"))
        };
        let verifier = WebPkiClientVerifier::builder_with_provider(Arc::clone(&roots), provider())
            .build()
            .map_err(|error| ca.malformed(format!("cannot verify peers: {error}")))?;
        let mut server = ServerConfig::builder_with_provider(provider())
            .with_protocol_versions(&[&rustls::version::TLS13])
            .expect("the provider knows TLS 1.3")
            .with_client_cert_verifier(verifier)
            .with_single_cert(chain.clone(), key.clone_key())
            .map_err(unfit)?;
        server.alpn_protocols = vec![ALPN.to_vec()];
        // A resumed session is not asked for its certificate again, which may have expired since.
        server.send_tls13_tickets = 0;
        server.session_storage = Arc::new(NoServerSessionStorage {});
        let mut client = ClientConfig::builder_with_provider(provider())
            .with_protocol_versions(&[&rustls::version::TLS13])
            .expect("the provider knows TLS 1.3")
            .with_root_certificates(roots)
            .with_client_auth_cert(chain, key)
            .map_err(unfit)?;
        client.alpn_protocols = vec![ALPN.to_vec()];
        client.resumption = Resumption::disabled();
        Ok(Self { client: Arc::new(client), server: Arc::new(server) })
    }
}

/// The cryptography that TLS uses here; none is installed for the whole process.
pub(crate) fn provider() -> Arc<CryptoProvider> {
    Arc::new(ring::default_provider())
}

/// The authorities of a file.
pub(crate) fn roots(file: &File) -> Result<RootCertStore, SecurityError> {
    let mut roots = RootCertStore::empty();
    for certificate in certificates(file)? {
        roots.add(certificate).map_err(|error| file.malformed(format!("holds no authority: {error}")))?;
    }
    Ok(roots)
}

/// The certificates of a file, at least one.
pub(crate) fn certificates(file: &File) -> Result<Vec<CertificateDer<'static>>, SecurityError> {
    let found: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&file.bytes).collect();
    match found {
        Ok(found) if !found.is_empty() => Ok(found),
        Ok(_) => Err(file.malformed("holds no certificate in PEM (`-----BEGIN CERTIFICATE-----`)")),
        Err(error) => Err(file.malformed(format!("is not PEM: {error}"))),
    }
}

fn private_key(file: &File) -> Result<PrivateKeyDer<'static>, SecurityError> {
    PrivateKeyDer::from_pem_slice(&file.bytes)
        .map_err(|_| file.malformed("holds no private key in PEM (`-----BEGIN PRIVATE KEY-----`)"))
}
