//! Structured logs: pretty lines for people, or one JSON object a line for machines.

use std::fmt;
use std::io::IsTerminal;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use thiserror::Error;
use tracing_subscriber::filter::{EnvFilter, FromEnvError, LevelFilter};
use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::{SubscriberInitExt, TryInitError};
use tracing_subscriber::{Layer, Registry};

/// How log lines are written.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// A readable line an event, in colour on a terminal.
    #[default]
    Pretty,
    /// A JSON object a line.
    Json,
}

impl fmt::Display for LogFormat {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Pretty => "pretty",
            Self::Json => "json",
        })
    }
}

impl FromStr for LogFormat {
    type Err = LoggingError;

    fn from_str(name: &str) -> Result<Self, LoggingError> {
        match name {
            "pretty" => Ok(Self::Pretty),
            "json" => Ok(Self::Json),
            _ => Err(LoggingError::UnknownFormat(name.to_owned())),
        }
    }
}

/// Why logging could not be set up.
#[derive(Debug, Error)]
pub enum LoggingError {
    /// Not a format.
    #[error("unknown log format {0:?}: use pretty or json")]
    UnknownFormat(String),
    /// The variable `RUST_LOG` holds something else than filter directives.
    #[error("RUST_LOG cannot be read: {0}; an example is RUST_LOG=info,getup_actor=debug")]
    Filter(#[from] FromEnvError),
    /// Logging was set up before in this process.
    #[error("logging is set up already: {0}")]
    Again(#[from] TryInitError),
}

/// Sends all events of this process to `writer`, filtered by `RUST_LOG` (`info` where it is not set).
///
/// `writer` is [`std::io::stderr`], or one that moves a progress bar out of the way of each line.
///
/// # Errors
/// [`LoggingError::Filter`] and [`LoggingError::Again`].
pub fn init_logging<W>(format: LogFormat, writer: W) -> Result<(), LoggingError>
where
    W: for<'a> MakeWriter<'a> + Send + Sync + 'static,
{
    let filter = EnvFilter::builder().with_default_directive(LevelFilter::INFO.into()).from_env()?;
    let layer: Box<dyn Layer<Registry> + Send + Sync> = match format {
        LogFormat::Pretty => {
            let colour = std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none();
            Box::new(tracing_subscriber::fmt::layer().with_ansi(colour).with_writer(writer))
        }
        LogFormat::Json => {
            Box::new(tracing_subscriber::fmt::layer().json().flatten_event(true).with_writer(writer))
        }
    };
    Ok(tracing_subscriber::registry().with(layer.with_filter(filter)).try_init()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_format_is_read_as_it_is_written() {
        for format in [LogFormat::Pretty, LogFormat::Json] {
            assert_eq!(format.to_string().parse::<LogFormat>().unwrap(), format);
        }
    }

    #[test]
    fn an_unknown_format_is_named_beside_the_known_ones() {
        let error = "xml".parse::<LogFormat>().unwrap_err().to_string();
        assert_eq!(error, "unknown log format \"xml\": use pretty or json");
    }
}
