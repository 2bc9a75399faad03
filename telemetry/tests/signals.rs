//! The signal watcher: signals are a process's, so this test has one of its own.

use std::time::Duration;

use getup_telemetry::Shutdown;

#[tokio::test]
async fn the_first_sigterm_triggers_the_shutdown_and_ends_nothing_at_once_where_it_has_begun_by_itself() {
    let (shutdown, begun) = (Shutdown::new(), Shutdown::new());
    shutdown.on_signals().unwrap();
    begun.on_signals().unwrap();
    begun.trigger();
    assert!(!shutdown.is_triggered());
    // SAFETY: raising a signal that has a handler, in our own process.
    assert_eq!(unsafe { libc::raise(libc::SIGTERM) }, 0);
    tokio::time::timeout(Duration::from_secs(5), shutdown.wait()).await.unwrap();
    // The other watcher has seen it, too: this process would be gone.
    tokio::time::sleep(Duration::from_millis(100)).await;
}
