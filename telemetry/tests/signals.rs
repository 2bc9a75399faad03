//! The signal watcher: signals are a process's, so this test has one of its own.

use std::process::Command;
use std::time::{Duration, Instant};

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

const CHILD: &str = "GETUP_TEST_SIGNALLED_TWICE";

/// The process that is signalled twice: without its variable there is nothing to prove here.
#[tokio::test]
async fn is_signalled_twice() {
    if std::env::var_os(CHILD).is_none() {
        return;
    }
    let shutdown = Shutdown::new();
    shutdown.on_signals().unwrap();
    for _ in 0..2 {
        // SAFETY: as above.
        assert_eq!(unsafe { libc::raise(libc::SIGTERM) }, 0);
        shutdown.wait().await;
    }
    // As a role that something holds up.
    tokio::time::sleep(Duration::from_secs(60)).await;
}

#[test]
fn a_second_signal_ends_the_process_at_once() {
    let started = Instant::now();
    let output = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "is_signalled_twice"])
        .env(CHILD, "1")
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(130), "{output:?}");
    assert!(started.elapsed() < Duration::from_secs(30), "after {:?}", started.elapsed());
}
