//! What can be wrong with addresses and credentials, and the way out.

use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;

use thiserror::Error;

/// Why the security that is configured cannot be had.
#[derive(Debug, Error)]
pub enum SecurityError {
    /// Mutual TLS wants three files, and some are not named.
    #[error(
        "security.{set} is set and security.{missing} is not: mutual TLS wants security.ca, security.certificate \
         and security.key, so set all three or none"
    )]
    Incomplete {
        /// A setting that is there.
        set: &'static str,
        /// One that is not.
        missing: &'static str,
    },
    /// A file that cannot be read.
    #[error(
        "cannot read security.{setting} = {path:?}: {source}; `getup certs` makes such files, or leave the setting \
         empty"
    )]
    Unreadable {
        /// The setting that names it.
        setting: &'static str,
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A file that holds something else.
    #[error("security.{setting} = {path:?} {problem}")]
    Malformed {
        /// The setting that names it.
        setting: &'static str,
        /// The file.
        path: PathBuf,
        /// What is wrong, and what to do.
        problem: String,
    },
    /// A port that other machines reach and that lets everyone in.
    #[error(
        "{address} is reached from other machines, and nothing protects it: set security.token_file to a file with \
         a token, or security.ca, security.certificate and security.key for mutual TLS, or \
         security.accept_open_port = true if the network itself keeps strangers out"
    )]
    Unprotected {
        /// Where the port listens.
        address: SocketAddr,
    },
}

/// An address that is none.
#[derive(Debug, Error)]
#[error("{address:?} is not the address of a service: write it like replay:7401 ({reason})")]
pub struct AddressError {
    pub(crate) address: String,
    pub(crate) reason: String,
}
