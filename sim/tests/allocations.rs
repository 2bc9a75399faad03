//! Stepping a lane allocates nothing: MuJoCo works in an arena made with the lane, and what is counted here is all the
//! rest. In a binary of its own, because the allocator it counts with is the process's.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::Arc;

use getup_sim::{GetUp, Lane, Phase, TaskConfig};

thread_local! {
    /// Allocations of this thread: the test harness has threads of its own.
    static ALLOCATIONS: Cell<usize> = const { Cell::new(0) };
}

struct Counting;

// SAFETY: every call goes to the system's allocator unchanged; counting touches a thread-local that needs neither
// allocation nor destructor.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.set(ALLOCATIONS.get() + 1);
        // SAFETY: the caller's promise about `layout` is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promise about `pointer` and `layout` is passed on.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        ALLOCATIONS.set(ALLOCATIONS.get() + 1);
        // SAFETY: the caller's promise about all three is passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn whole_episodes_from_reset_to_time_limit_allocate_nothing() {
    for physics_hz in [200, 800] {
        let config = TaskConfig { physics_hz, ..TaskConfig::default() };
        let mut lane = Lane::new(Arc::new(GetUp::new(&config, 1.0).unwrap()));
        let mut action = [0.0; 21];
        let mut observation = [0.0; 68];
        let before = ALLOCATIONS.get();
        let mut episodes = 0;
        for seed in 0..3 {
            lane.begin(seed, 0.9);
            loop {
                if lane.phase() == Phase::Limp {
                    lane.limp_action(&mut action);
                } else {
                    action.fill(if lane.steps().is_multiple_of(2) { 1.0 } else { -1.0 });
                }
                let step = lane.step(&action).unwrap();
                lane.observe(&mut observation);
                if step.truncated {
                    episodes += 1;
                    break;
                }
            }
        }
        let after = ALLOCATIONS.get();
        assert_eq!((episodes, after - before), (3, 0), "at {physics_hz} Hz");
    }
    assert!(ALLOCATIONS.get() > 0, "the counter counts");
}
