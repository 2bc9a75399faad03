//! A process's log of a long wait, as JSON lines: logging is global, so this test has a process of its own.

use std::io::{self, Write};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use getup_telemetry::{LoggingError, Registry, Waits, init_logging};

#[derive(Clone, Default)]
struct Lines(Arc<Mutex<Vec<u8>>>);

impl Write for Lines {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[test]
fn a_wait_of_more_than_five_seconds_is_logged_with_who_waits_and_why() {
    let lines = Lines::default();
    let writer = lines.clone();
    init_logging(true, move || writer.clone()).unwrap();
    assert!(matches!(init_logging(true, io::stderr), Err(LoggingError::Again(_))));

    let waits = Waits::new(&Registry::new());
    let guard = waits.begin("sampler", "812 of 1,000 transitions".into());
    let began = Instant::now();
    while lines.0.lock().unwrap().is_empty() {
        assert!(began.elapsed() < Duration::from_secs(60), "nothing is logged");
        thread::sleep(Duration::from_millis(50));
    }
    assert!(began.elapsed() >= Duration::from_secs(4), "after {:?}", began.elapsed());
    drop(guard);

    let text = String::from_utf8(lines.0.lock().unwrap().clone()).unwrap();
    let event: serde_json::Value = serde_json::from_str(text.lines().next().unwrap()).unwrap();
    assert_eq!(event["level"], "INFO");
    assert_eq!(event["what"], "sampler");
    let message = event["message"].as_str().unwrap();
    assert!(message.starts_with("sampler waits: 812 of 1,000 transitions (for "), "{message}");
}
