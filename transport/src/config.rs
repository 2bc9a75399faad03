//! `[security]` of the configuration, and when it is enough.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use documented::DocumentedFieldsOpt;
use serde::{Deserialize, Serialize};

use crate::SecurityError;

/// `[security]`: who may reach a role's ports. An empty path is none.
///
/// A token alone keeps strangers out of a network where nobody listens in; mutual TLS does so in any network.
#[derive(Clone, PartialEq, Eq, Debug, Default, Serialize, Deserialize, DocumentedFieldsOpt)]
#[serde(default, deny_unknown_fields)]
pub struct SecurityConfig {
    /// A file of tokens, one a line: the first is sent, and each is accepted, so that a new one can be brought in
    /// without a gap.
    pub token_file: PathBuf,
    /// Certificates of the authorities that peers must have theirs from (PEM).
    pub ca: PathBuf,
    /// This process's certificate, with what lies between it and the authority (PEM).
    pub certificate: PathBuf,
    /// The private key of the certificate (PEM).
    pub key: PathBuf,
    /// Lets ports that other machines reach be open to all of them.
    pub accept_open_port: bool,
    /// A file of tokens, one a line, of which `/metrics` over HTTP wants one.
    pub metrics_token_file: PathBuf,
}

impl SecurityConfig {
    /// Whether the settings fit together; files are not looked at.
    ///
    /// # Errors
    /// [`SecurityError::Incomplete`].
    pub fn validate(&self) -> Result<(), SecurityError> {
        let files = [("ca", &self.ca), ("certificate", &self.certificate), ("key", &self.key)];
        let named =
            |wanted: bool| files.iter().find(|(_, path)| given(path) == wanted).map(|(name, _)| *name);
        match (named(true), named(false)) {
            (Some(set), Some(missing)) => Err(SecurityError::Incomplete { set, missing }),
            _ => Ok(()),
        }
    }

    /// Whether there is mutual TLS.
    pub(crate) fn has_tls(&self) -> bool {
        given(&self.ca)
    }
}

/// Refuses a gRPC port that other machines reach unless it wants a token or a certificate, or is meant to be open.
///
/// # Errors
/// [`SecurityError::Unprotected`], and as [`SecurityConfig::validate`].
pub fn require_protection(listen: SocketAddr, config: &SecurityConfig) -> Result<(), SecurityError> {
    config.validate()?;
    if listen.ip().to_canonical().is_loopback() || config.has_tls() || given(&config.token_file) {
        return Ok(());
    }
    if config.accept_open_port {
        tracing::warn!("{listen} is open to everyone who reaches it: security.accept_open_port is set");
        return Ok(());
    }
    Err(SecurityError::Unprotected { address: listen })
}

/// Whether a path is set.
pub(crate) fn given(path: &Path) -> bool {
    !path.as_os_str().is_empty()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(change: impl FnOnce(&mut SecurityConfig)) -> SecurityConfig {
        let mut config = SecurityConfig::default();
        change(&mut config);
        config
    }

    #[test]
    fn all_three_files_of_mutual_tls_are_set_or_none() {
        assert!(SecurityConfig::default().validate().is_ok());
        let tls = config(|c| (c.ca, c.certificate, c.key) = ("a".into(), "b".into(), "c".into()));
        assert!(tls.validate().is_ok());
        let error = config(|c| (c.ca, c.key) = ("a".into(), "c".into())).validate().unwrap_err().to_string();
        assert!(error.contains("security.ca is set and security.certificate is not"), "{error}");
    }

    #[test]
    fn a_loopback_may_be_open_and_any_other_address_wants_protection_or_a_word() {
        let local = ["127.0.0.1:7400", "127.9.9.9:7400", "[::1]:7400", "[::ffff:127.0.0.1]:7400"];
        let reached = ["0.0.0.0:7400", "[::]:7400", "10.0.0.1:7400", "[::ffff:10.0.0.1]:7400"];
        let open = SecurityConfig::default();
        for address in local {
            require_protection(address.parse().unwrap(), &open).unwrap();
        }
        for address in reached {
            let address = address.parse().unwrap();
            let error = require_protection(address, &open).unwrap_err().to_string();
            let ways = ["security.token_file", "security.ca", "security.accept_open_port = true"];
            assert!(error.contains(&address.to_string()), "{error}");
            assert!(ways.iter().all(|way| error.contains(way)), "{error}");
            let protected = [
                config(|c| c.token_file = "token".into()),
                config(|c| (c.ca, c.certificate, c.key) = ("a".into(), "b".into(), "c".into())),
                config(|c| c.accept_open_port = true),
            ];
            assert!(protected.iter().all(|config| require_protection(address, config).is_ok()));
        }
    }

    #[test]
    fn the_configuration_is_read_as_it_is_written_and_knows_no_other_keys() {
        let config = config(|c| c.token_file = "token".into());
        assert_eq!(toml::from_str::<SecurityConfig>(&toml::to_string(&config).unwrap()).unwrap(), config);
        assert_eq!(toml::from_str::<SecurityConfig>("").unwrap(), SecurityConfig::default());
        assert!(toml::from_str::<SecurityConfig>("tokenfile = \"token\"").is_err());
    }
}
