//! The threads that share an update.
//!
//! A phase of an update is over within a tenth of a millisecond to a few, and the next one follows within microseconds. A
//! thread that was put to sleep in between would take tens of them to wake, on a virtual machine a hundred: so threads wait
//! awake for a while, and only then sleep.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle, Thread};
use std::time::{Duration, Instant};

/// How long a thread waits awake.
const AWAKE: Duration = Duration::from_micros(200);

/// The caller's thread and others.
pub(super) struct Team {
    shared: Arc<Shared>,
    others: Vec<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    /// Jobs so far.
    jobs: AtomicUsize,
    /// The newest.
    job: Mutex<Option<Job>>,
    /// Threads that have not done their part of it.
    busy: AtomicUsize,
    /// What the first of them that panicked said.
    panic: Mutex<Option<Box<dyn Any + Send>>>,
    over: AtomicBool,
}

/// What every thread calls with its index, and who waits for them.
#[derive(Clone)]
struct Job {
    part: &'static (dyn Fn(usize) + Sync),
    caller: Thread,
}

impl Team {
    /// A team of `threads`, the caller's own among them; of fewer, where there are no more to be had.
    pub(super) fn new(threads: usize) -> Self {
        let shared = Arc::<Shared>::default();
        let start = |index| {
            let shared = shared.clone();
            thread::Builder::new().name(format!("update-{index}")).spawn(move || shared.help(index))
        };
        let mut others = Vec::new();
        for index in 1..threads {
            match start(index) {
                Ok(thread) => others.push(thread),
                Err(error) => {
                    tracing::warn!("{index} of {threads} threads update: {error}");
                    break;
                }
            }
        }
        Self { shared, others }
    }

    /// How many threads.
    pub(super) fn threads(&self) -> usize {
        self.others.len() + 1
    }

    /// Calls `work` with every item, and with the index of the thread that does.
    ///
    /// # Panics
    /// Where `work` does.
    pub(super) fn each<T: Send>(&mut self, items: &mut [T], work: impl Fn(usize, &mut T) + Sync) {
        let rest = Mutex::new(items.iter_mut());
        let next = || lock(&rest).next();
        self.run(&|thread| {
            while let Some(item) = next() {
                work(thread, item);
            }
        });
    }

    /// Calls `part` on every thread.
    fn run(&mut self, part: &(dyn Fn(usize) + Sync)) {
        let shared = &*self.shared;
        // SAFETY: the threads call it before `busy` is 0 and not after, and this function ends, in a panic, too, after that.
        let erased =
            unsafe { std::mem::transmute::<&(dyn Fn(usize) + Sync), &'static (dyn Fn(usize) + Sync)>(part) };
        *lock(&shared.job) = Some(Job { part: erased, caller: thread::current() });
        shared.busy.store(self.others.len(), Ordering::Relaxed);
        shared.jobs.fetch_add(1, Ordering::Release);
        self.others.iter().for_each(|other| other.thread().unpark());
        let own = catch_unwind(AssertUnwindSafe(|| part(0)));
        wait(|| shared.busy.load(Ordering::Acquire) == 0);
        let theirs = lock(&shared.panic).take();
        if let Some(panic) = own.err().or(theirs) {
            resume_unwind(panic);
        }
    }
}

impl Shared {
    /// Does its part of every job.
    fn help(&self, index: usize) {
        for done in 0.. {
            wait(|| self.jobs.load(Ordering::Acquire) > done || self.over.load(Ordering::Relaxed));
            if self.over.load(Ordering::Relaxed) {
                return;
            }
            let Some(Job { part, caller }) = lock(&self.job).clone() else { return };
            if let Err(panic) = catch_unwind(AssertUnwindSafe(|| part(index))) {
                lock(&self.panic).get_or_insert(panic);
            }
            if self.busy.fetch_sub(1, Ordering::Release) == 1 {
                caller.unpark();
            }
        }
    }
}

impl Drop for Team {
    fn drop(&mut self) {
        self.shared.over.store(true, Ordering::Relaxed);
        for other in self.others.drain(..) {
            other.thread().unpark();
            // It catches what its parts panic with.
            let _ = other.join();
        }
    }
}

/// Waits until it `is_time`: awake for a while, then asleep until this thread is unparked.
fn wait(is_time: impl Fn() -> bool) {
    let start = Instant::now();
    while !is_time() {
        if start.elapsed() < AWAKE { (0..16).for_each(|_| std::hint::spin_loop()) } else { thread::park() }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_item_is_worked_on_once_whether_the_threads_are_awake_or_asleep() {
        for threads in [1, 2, 3] {
            let mut team = Team::new(threads);
            assert_eq!(team.threads(), threads);
            for round in 0..200 {
                // Fewer than threads, as many, and more.
                let mut items = vec![0; round % 7];
                team.each(&mut items, |thread, item| {
                    assert!(thread < threads);
                    *item += 1;
                });
                assert!(items.iter().all(|times| *times == 1), "{items:?}");
                if round % 50 == 0 {
                    thread::sleep(10 * AWAKE);
                }
            }
        }
    }

    #[test]
    fn all_threads_work_at_the_same_time() {
        let mut team = Team::new(3);
        // Each waits for the others: were they to work one after another, this would not end.
        let barrier = std::sync::Barrier::new(3);
        team.each(&mut [(); 3], |_, ()| {
            barrier.wait();
        });
    }

    #[test]
    fn a_panic_reaches_the_caller_once_all_have_ended_and_the_team_goes_on() {
        let mut team = Team::new(2);
        for guilty in [0, 1] {
            let barrier = std::sync::Barrier::new(2);
            let mut ended = [false; 2];
            let mut work = || {
                team.each(&mut ended, |thread, ended| {
                    barrier.wait();
                    assert_ne!(thread, guilty, "on purpose");
                    thread::sleep(10 * AWAKE);
                    *ended = true;
                });
            };
            assert!(catch_unwind(AssertUnwindSafe(&mut work)).is_err());
            assert_eq!(ended.iter().filter(|ended| **ended).count(), 1, "the other one went on to its end");
        }
        let mut items = [0; 5];
        team.each(&mut items, |_, item| *item += 1);
        assert_eq!(items, [1; 5]);
    }
}
