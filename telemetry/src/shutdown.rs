//! The end of a process: one small type that everything awaits.

use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

/// Exit code after a second signal: that of a process that SIGINT ended.
const INTERRUPTED: i32 = 130;

/// A latch that is triggered once, by a signal or by the program itself; clones share it.
#[derive(Clone, Debug, Default)]
pub struct Shutdown {
    token: CancellationToken,
}

impl Shutdown {
    /// One that nothing has triggered.
    pub fn new() -> Self {
        Self::default()
    }

    /// Triggers on SIGTERM or SIGINT; a second signal ends the process at once with exit code 130.
    ///
    /// # Errors
    /// When the operating system refuses a signal handler.
    ///
    /// # Panics
    /// Outside a tokio runtime.
    pub fn on_signals(&self) -> std::io::Result<()> {
        let mut terminate = signal(SignalKind::terminate())?;
        let mut interrupt = signal(SignalKind::interrupt())?;
        let shutdown = self.clone();
        tokio::spawn(async move {
            let mut next = async || {
                tokio::select! {
                    _ = terminate.recv() => "SIGTERM",
                    _ = interrupt.recv() => "SIGINT",
                }
            };
            // The first may come when the end has begun by itself: it asks for nothing else.
            let first = next().await;
            tracing::info!("{first}: shutting down");
            shutdown.trigger();
            let second = next().await;
            tracing::warn!("{second} during shutdown: ending at once");
            std::process::exit(INTERRUPTED);
        });
        Ok(())
    }

    /// Begins the shutdown; again is as once.
    pub fn trigger(&self) {
        self.token.cancel();
    }

    /// Whether the shutdown has begun.
    pub fn is_triggered(&self) -> bool {
        self.token.is_cancelled()
    }

    /// Returns when the shutdown begins, at once where it has.
    pub async fn wait(&self) {
        self.token.cancelled().await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_trigger_reaches_every_clone_that_waits_and_any_that_asks_later() {
        let shutdown = Shutdown::new();
        let waiting = shutdown.clone();
        let task = tokio::spawn(async move { waiting.wait().await });
        assert!(!shutdown.is_triggered());
        shutdown.trigger();
        task.await.unwrap();
        shutdown.clone().wait().await;
        assert!(shutdown.is_triggered());
    }
}
