//! The signal watcher: signals are a process's, so this test has one of its own.

use std::time::Duration;

use getup_telemetry::Shutdown;

#[tokio::test]
async fn sigterm_triggers_the_shutdown() {
    let shutdown = Shutdown::new();
    shutdown.on_signals().unwrap();
    assert!(!shutdown.is_triggered());
    // SAFETY: raising a signal that has a handler, in our own process.
    assert_eq!(unsafe { libc::raise(libc::SIGTERM) }, 0);
    tokio::time::timeout(Duration::from_secs(5), shutdown.wait()).await.unwrap();
}
