//! Certificates for a cluster that has no authority of its own.
//!
//! One machine keeps the authority: `ca.pem` for everyone, and `ca.key` for nobody else. Each process gets `ca.pem`
//! and a `peer.pem` with its `peer.key`; it is client and server with the same certificate.

use std::fs::Permissions;
use std::io::{self, ErrorKind, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
    KeyUsagePurpose,
};
use rustls::client::WebPkiServerVerifier;
use rustls::client::danger::ServerCertVerifier;
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use thiserror::Error;
use time::OffsetDateTime;

use crate::reload::File;
use crate::{SecurityError, tls};

const DAY: Duration = Duration::from_secs(24 * 3600);
/// How long an authority is good for: 10 years, with their leap days.
const AUTHORITY_LASTS: Duration = Duration::from_secs(3652 * 24 * 3600);
/// How long a peer's certificate is good for.
const PEER_LASTS: Duration = Duration::from_secs(365 * 24 * 3600);
/// A certificate with less than this left is as good as none.
const PEER_LEFT: Duration = Duration::from_secs(30 * 24 * 3600);
/// What every peer is called on its own machine.
const LOCAL: [&str; 3] = ["localhost", "127.0.0.1", "::1"];

/// What [`make_authority`] did.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Issued {
    /// Nothing: the certificate that is there will do.
    Nothing,
    /// A certificate for a peer, by the authority that was there.
    Peer,
    /// An authority, and a certificate for a peer by it.
    AuthorityAndPeer,
}

/// Why certificates could not be made.
#[derive(Debug, Error)]
pub enum CertsError {
    /// Not a name that a certificate can carry.
    #[error("{0:?} is neither a DNS name nor an IP address: name hosts as peers do, like replay or 10.0.0.5")]
    Name(String),
    /// The authority's certificate without its key.
    #[error(
        "{} is here and its key {} is not: issue certificates where the key is, or choose an empty folder for a \
         new authority", certificate.display(), key.display()
    )]
    NoKey {
        /// The certificate that is here.
        certificate: PathBuf,
        /// The key that is not.
        key: PathBuf,
    },
    /// An authority that cannot sign for peers to believe.
    #[error(
        "{} cannot issue certificates ({reason}): choose an empty folder for a new authority", path.display()
    )]
    Authority {
        /// The file of the authority.
        path: PathBuf,
        /// What it lacks.
        reason: String,
    },
    /// A file could not be read or written.
    #[error("{}: {source}", path.display())]
    File {
        /// The file, or its folder.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The cryptography failed.
    #[error("a certificate could not be made: {0}")]
    Making(#[from] rcgen::Error),
}

/// Issues `peer.pem` and `peer.key` in `dir` for a peer that is reached by `names` (DNS names, `*.` before them
/// included, and IP addresses), or from its own machine. The authority, `ca.pem` in `dir` and `ca.key` in `vault`, is made
/// if it is not there; the two may be one folder. Keys can be read by their owner alone; files are replaced as a whole.
///
/// With `if_missing` nothing is done while `peer.pem` is good for all the names and for another 30 days.
///
/// # Errors
/// [`CertsError`].
pub fn make_authority(
    dir: &Path,
    vault: &Path,
    names: &[String],
    if_missing: bool,
) -> Result<Issued, CertsError> {
    let names = subject_names(names)?;
    if if_missing && check(dir, &names, SystemTime::now() + PEER_LEFT).is_ok() {
        return Ok(Issued::Nothing);
    }
    for folder in [dir, vault] {
        let error = |source| CertsError::File { path: folder.to_owned(), source };
        std::fs::create_dir_all(folder).map_err(error)?;
    }
    let authority = Authority::open(dir, vault)?;
    let key = KeyPair::generate()?;
    let certificate =
        peer_params(&names)?.signed_by(&key, &Issuer::from_params(&params(), &authority.key))?;
    // An authority that was made elsewhere, or whose files do not belong together, must not go unnoticed.
    verify(&authority.certificate, certificate.der(), &names, SystemTime::now())
        .map_err(|reason| CertsError::Authority { path: dir.join("ca.pem"), reason })?;
    write(dir, "peer.key", key.serialize_pem().as_bytes(), 0o600)?;
    write(dir, "peer.pem", certificate.pem().as_bytes(), 0o644)?;
    Ok(if authority.is_new { Issued::AuthorityAndPeer } else { Issued::Peer })
}

/// Whoever signs.
struct Authority {
    key: KeyPair,
    /// `ca.pem`.
    certificate: File,
    is_new: bool,
}

impl Authority {
    /// The one of the folders, or a new one. A key without a certificate, as a crash leaves it, gets one.
    fn open(dir: &Path, vault: &Path) -> Result<Self, CertsError> {
        let (certificate, key_file) = (dir.join("ca.pem"), vault.join("ca.key"));
        let key = read(&key_file)?;
        if let Some(bytes) = read(&certificate)? {
            let Some(key) = key else { return Err(CertsError::NoKey { certificate, key: key_file }) };
            let key = parse_key(&key_file, &key)?;
            let certificate = File { setting: "ca", path: certificate, bytes };
            return Ok(Self { key, certificate, is_new: false });
        }
        let is_new = key.is_none();
        let key = match key {
            Some(key) => parse_key(&key_file, &key)?,
            None => {
                let key = KeyPair::generate()?;
                write(vault, "ca.key", key.serialize_pem().as_bytes(), 0o600)?;
                key
            }
        };
        let bytes = params().self_signed(&key)?.pem().into_bytes();
        write(dir, "ca.pem", &bytes, 0o644)?;
        Ok(Self { key, certificate: File { setting: "ca", path: certificate, bytes }, is_new })
    }
}

fn parse_key(path: &Path, pem: &[u8]) -> Result<KeyPair, CertsError> {
    KeyPair::from_pem(&String::from_utf8_lossy(pem))
        .map_err(|error| CertsError::Authority { path: path.to_owned(), reason: error.to_string() })
}

/// The names, and those of the peer's own machine.
fn subject_names(names: &[String]) -> Result<Vec<String>, CertsError> {
    if let Some(name) = names.iter().find(|name| example(name).is_none()) {
        return Err(CertsError::Name(name.clone()));
    }
    let mut all = names.to_vec();
    all.extend(LOCAL.map(str::to_owned));
    all.sort();
    all.dedup();
    Ok(all)
}

/// A name that a certificate for `name` is good for.
fn example(name: &str) -> Option<ServerName<'static>> {
    let name = name.strip_prefix("*.").map_or_else(|| name.to_owned(), |domain| format!("any.{domain}"));
    ServerName::try_from(name).ok()
}

/// The authority's own certificate.
fn params() -> CertificateParams {
    let mut params = CertificateParams::default();
    params.distinguished_name.push(DnType::CommonName, "getup authority");
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    lasting(&mut params, AUTHORITY_LASTS);
    params
}

fn peer_params(names: &[String]) -> Result<CertificateParams, CertsError> {
    let mut params = CertificateParams::new(names)?;
    params.distinguished_name.push(DnType::CommonName, "getup peer");
    params.use_authority_key_identifier_extension = true;
    params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
    params.extended_key_usages =
        vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
    lasting(&mut params, PEER_LASTS);
    Ok(params)
}

/// From yesterday, as clocks differ, until `lasts` from now.
fn lasting(params: &mut CertificateParams, lasts: Duration) {
    let now = SystemTime::now();
    params.not_before = OffsetDateTime::from(now - DAY);
    params.not_after = OffsetDateTime::from(now + lasts);
}

/// Whether the folder's files belong together and are good for all names at `when`.
fn check(dir: &Path, names: &[String], when: SystemTime) -> Result<(), String> {
    let files = [("ca", "ca.pem"), ("certificate", "peer.pem"), ("key", "peer.key")]
        .map(|(setting, name)| File::read(setting, &dir.join(name)));
    let files = files.into_iter().collect::<Result<Vec<File>, SecurityError>>().map_err(text)?;
    tls::Tls::parse(&files).map_err(text)?;
    let chain = tls::certificates(&files[1]).map_err(text)?;
    verify(&files[0], &chain[0], names, when)
}

/// Whether a peer that knows `authority` believes the certificate at `when`.
fn verify(
    authority: &File,
    certificate: &CertificateDer<'_>,
    names: &[String],
    when: SystemTime,
) -> Result<(), String> {
    let roots = tls::roots(authority).map_err(text)?;
    let verifier =
        WebPkiServerVerifier::builder_with_provider(roots.into(), tls::provider()).build().map_err(text)?;
    let when = UnixTime::since_unix_epoch(when.duration_since(SystemTime::UNIX_EPOCH).map_err(text)?);
    for name in names.iter().filter_map(|name| example(name)) {
        verifier.verify_server_cert(certificate, &[], &name, &[], when).map_err(text)?;
    }
    Ok(())
}

fn text(error: impl std::error::Error) -> String {
    error.to_string()
}

fn read(path: &Path) -> Result<Option<Vec<u8>>, CertsError> {
    match std::fs::read(path) {
        Ok(bytes) => Ok(Some(bytes)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(source) => Err(CertsError::File { path: path.to_owned(), source }),
    }
}

/// Replaces a file as a whole; it has its mode from the beginning.
fn write(dir: &Path, name: &str, bytes: &[u8], mode: u32) -> Result<(), CertsError> {
    let path = dir.join(name);
    let replace = || {
        let mut file = tempfile::Builder::new().permissions(Permissions::from_mode(mode)).tempfile_in(dir)?;
        file.write_all(bytes)?;
        file.as_file().sync_all()?;
        file.persist(&path)?;
        io::Result::Ok(())
    };
    replace().map_err(|source| CertsError::File { path: path.clone(), source })
}
