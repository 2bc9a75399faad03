//! Structured logs: pretty lines for people, or one JSON object a line for machines.

use std::io::IsTerminal;

use thiserror::Error;
use tracing_subscriber::filter::{EnvFilter, FromEnvError, LevelFilter};
use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::{SubscriberInitExt, TryInitError};
use tracing_subscriber::{Layer, Registry};

/// Why logging could not be set up.
#[derive(Debug, Error)]
pub enum LoggingError {
    /// The variable `RUST_LOG` holds something else than filter directives.
    #[error("RUST_LOG cannot be read: {0}; an example is RUST_LOG=info,getup_actor=debug")]
    Filter(#[from] FromEnvError),
    /// Logging was set up before in this process.
    #[error("logging is set up already: {0}")]
    Again(#[from] TryInitError),
}

/// Sends all events of this process to `writer`, filtered by `RUST_LOG` (`info` where it is not set): as a JSON object a line,
/// or as a readable line, in colour on a terminal.
///
/// `writer` is [`std::io::stderr`], or one that moves a progress bar out of the way of each line.
///
/// # Errors
/// [`LoggingError::Filter`] and [`LoggingError::Again`].
pub fn init_logging<W>(json: bool, writer: W) -> Result<(), LoggingError>
where
    W: for<'a> MakeWriter<'a> + Send + Sync + 'static,
{
    let filter = EnvFilter::builder().with_default_directive(LevelFilter::INFO.into()).from_env()?;
    let layer: Box<dyn Layer<Registry> + Send + Sync> = if json {
        Box::new(tracing_subscriber::fmt::layer().json().flatten_event(true).with_writer(writer))
    } else {
        let colour = std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none();
        Box::new(tracing_subscriber::fmt::layer().with_ansi(colour).with_writer(writer))
    };
    Ok(tracing_subscriber::registry().with(layer.with_filter(filter)).try_init()?)
}
