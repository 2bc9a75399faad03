//! The files of `[security]`, read once and again whenever they change.

use std::fmt;
use std::path::Path;
use std::sync::Arc;

use http::header::AUTHORIZATION;
use http::{HeaderMap, HeaderValue};

use crate::config::given;
use crate::reload::Reloaded;
use crate::tls::Tls;
use crate::token::{Tokens, presented};
use crate::{SecurityConfig, SecurityError};

/// What a process shows to others and wants to be shown; clones share it. The default is nothing.
#[derive(Clone, Default)]
pub struct Credentials {
    pub(crate) tokens: Option<Arc<Reloaded<Tokens>>>,
    pub(crate) tls: Option<Arc<Reloaded<Tls>>>,
    metrics_tokens: Option<Arc<Reloaded<Tokens>>>,
}

impl Credentials {
    /// Reads all files that are set.
    ///
    /// # Errors
    /// As [`SecurityConfig::validate`]; [`SecurityError::Unreadable`] and [`SecurityError::Malformed`] name the file.
    pub fn load(config: &SecurityConfig) -> Result<Self, SecurityError> {
        config.validate()?;
        let tokens = |setting: &'static str, path: &Path| {
            given(path).then(|| Reloaded::load(&[(setting, path)], Tokens::parse).map(Arc::new)).transpose()
        };
        let files = [
            ("ca", config.ca.as_path()),
            ("certificate", config.certificate.as_path()),
            ("key", config.key.as_path()),
        ];
        Ok(Self {
            tokens: tokens("token_file", &config.token_file)?,
            tls: config.has_tls().then(|| Reloaded::load(&files, Tls::parse).map(Arc::new)).transpose()?,
            metrics_tokens: tokens("metrics_token_file", &config.metrics_token_file)?,
        })
    }

    /// Whether a request for `/metrics` with these headers is to be answered: it carries a token of
    /// `security.metrics_token_file`, or none is wanted.
    pub fn may_read_metrics(&self, headers: &HeaderMap) -> bool {
        self.metrics_tokens.as_ref().is_none_or(|tokens| {
            let header = headers.get(AUTHORIZATION).map(HeaderValue::as_bytes);
            header.and_then(presented).is_some_and(|token| tokens.current().accept(token))
        })
    }
}

impl fmt::Debug for Credentials {
    /// What there is, and never what it says.
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("Credentials")
            .field("token", &self.tokens.is_some())
            .field("tls", &self.tls.is_some())
            .field("metrics_token", &self.metrics_tokens.is_some())
            .finish()
    }
}
