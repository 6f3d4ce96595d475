// SPDX-License-Identifier: MIT OR Apache-2.0
//! The hot path does not touch the heap: counted per thread, over 10,000 cycles.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::future::poll_fn;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::thread::{Thread, current, park};
use std::time::Duration;

use futures::stream;
use futures::task::AtomicWaker;
use tautline_executor::{
    CallbackGroup, CallbackOptions, Executor, ForeignCallback, ForeignExecutor, ForeignStatistics,
    MomentKind, ProcessInfo, Realtime, StatisticsFile, foreign, job,
};

struct Counting;

thread_local!(static HEAP_CALLS: Cell<u64> = const { Cell::new(0) });

fn count() {
    let _ = HEAP_CALLS.try_with(|calls| calls.set(calls.get() + 1));
}

// SAFETY: every call is handed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        count();
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(block, layout) }
    }
    unsafe fn realloc(&self, block: *mut u8, layout: Layout, bytes: usize) -> *mut u8 {
        count();
        // SAFETY: the caller's promises are passed on.
        unsafe { System.realloc(block, layout, bytes) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const WARM_UP: u64 = 100;
const CYCLES: u64 = 10_000;

/// Rung by the test, answered by callbacks.
struct Trigger {
    waker: AtomicWaker,
    rung: AtomicU64,
    answers: AtomicU64,
    /// The heap calls of the answering thread, so far.
    heap_calls: AtomicU64,
    ringer: Thread,
}

impl Trigger {
    fn new() -> Arc<Trigger> {
        let (waker, rung, answers, heap_calls) = Default::default();
        Arc::new(Trigger { waker, rung, answers, heap_calls, ringer: current() })
    }

    /// Ready with the number of the ring after `heard`.
    fn poll(&self, heard: u64, cx: &mut Context<'_>) -> Poll<u64> {
        self.waker.register(cx.waker());
        if self.rung.load(Ordering::Acquire) > heard { Poll::Ready(heard + 1) } else { Poll::Pending }
    }

    fn answer(&self) {
        self.heap_calls.store(HEAP_CALLS.get(), Ordering::Relaxed);
        self.answers.fetch_add(1, Ordering::Release);
        self.ringer.unpark();
    }

    fn wait_for(&self, answers: u64) {
        while self.answers.load(Ordering::Acquire) < answers {
            park();
        }
    }
}

/// Rings all triggers again and again; returns the heap calls after the warm-up: the ringer's and each trigger's.
fn cycle(triggers: &[&Trigger]) -> Vec<u64> {
    let calls = || -> Vec<u64> {
        let ringer = HEAP_CALLS.get();
        let answering = triggers.iter().map(|trigger| trigger.heap_calls.load(Ordering::Relaxed));
        [ringer].into_iter().chain(answering).collect()
    };
    let mut warm = calls();
    for ring in 1..=WARM_UP + CYCLES {
        for trigger in triggers {
            trigger.rung.store(ring, Ordering::Release);
            trigger.waker.wake();
        }
        triggers.iter().for_each(|trigger| trigger.wait_for(ring));
        if ring == WARM_UP {
            warm = calls();
            // Not counting the list itself.
            warm[0] = HEAP_CALLS.get();
        }
    }
    calls().iter().zip(&warm).map(|(now, warm)| now - warm).collect()
}

/// Every job violates both limits, and tells so.
fn watched(told: &Arc<AtomicU64>) -> CallbackOptions {
    let (overruns, misses) = (told.clone(), told.clone());
    CallbackOptions::other()
        .budget(Duration::from_nanos(1))
        .deadline(Duration::from_nanos(1))
        .on_overrun(move |overrun| {
            overruns.fetch_add(overrun.job.min(1), Ordering::Relaxed);
        })
        .on_deadline_miss(move |miss| {
            misses.fetch_add(miss.job.min(1), Ordering::Relaxed);
        })
}

/// Both tests are traced. What is traced is the process's, so one after the other where they share one; each has a domain
/// of its own, for a domain has one recorder.
struct Traced {
    _turn: MutexGuard<'static, ()>,
    domain: u32,
    membership: Option<tautline_trace::Membership>,
}

/// No domain of ROS 2's: no topic is opened.
fn traced(domain: u32) -> Traced {
    static TURN: Mutex<()> = Mutex::new(());
    let turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    tautline_trace::configure(tautline_trace::TraceMode::On.into());
    Traced { _turn: turn, domain, membership: Some(tautline_trace::join(domain).unwrap()) }
}

impl Drop for Traced {
    fn drop(&mut self) {
        drop(self.membership.take());
        let mut lost = 0;
        tautline_trace::Recorder::start(self.domain).unwrap().finish(&mut |record| {
            if let tautline_trace::Record::Lost { events, .. } = record {
                lost += events;
            }
        });
        assert!(lost > CYCLES || std::thread::panicking(), "a ring went round");
    }
}

#[test]
fn waking_and_polling_a_callback() {
    let _traced = traced(1206);
    let told = Arc::new(AtomicU64::new(0));
    let watched = watched(&told);
    let unmeasured = CallbackOptions::other().execution_time(false);
    let (plain, late) = (CallbackOptions::other(), CallbackOptions::other().bound(Duration::from_nanos(1)));
    for (options, accounts) in [(plain, false), (unmeasured, false), (watched, false), (late, true)] {
        let limits = u64::from(options.budget.is_some()) + u64::from(options.deadline.is_some());
        let trigger = Trigger::new();
        let (callback_trigger, mut heard, mut job) = (trigger.clone(), 0, None);
        // As a stream does it: a job ends when the next one is asked for.
        let future = poll_fn(move |cx| {
            loop {
                if let Some(job) = job.take() {
                    job::Job::finish(job);
                }
                heard = std::task::ready!(callback_trigger.poll(heard, cx));
                job = Some(job::begin(0));
                job::note_queue(job::QueueState { lost: 1, max_queue: heard, depth: 10 });
                job::set_input_size(1 << (heard % 64));
                callback_trigger.answer();
            }
        });
        let notes = accounts || options.budget.is_some();
        let executor = Executor::new(Realtime::Off).account_core_time(accounts.then_some(Duration::ZERO));
        let callback = executor.spawn_callback(options, future).unwrap();
        assert_eq!(cycle(&[&trigger]), [0, 0]);
        assert!(callback.stats().completions() >= CYCLES);
        let seen = tautline_executor::CallbackSnapshot::of(callback.stats()).unwrap();
        assert_eq!((seen.accounts_core_time, seen.older_moments >= CYCLES - 128), (accounts, notes));
        let jobs: u64 = seen.inputs.iter().map(|class| class.jobs).sum();
        let measured = seen.measures_execution;
        assert_eq!((jobs >= CYCLES, seen.inputs.len()), (measured, if measured { 32 } else { 0 }));
        assert!(told.load(Ordering::Relaxed) >= limits * CYCLES);
        executor.shutdown().unwrap();
    }
}

#[test]
fn turns_of_a_group() {
    let _traced = traced(1230);
    let triggers = [Trigger::new(), Trigger::new(), Trigger::new()];
    let mut group = CallbackGroup::new();
    let mut stats = Vec::new();
    let told = Arc::new(AtomicU64::new(0));
    for trigger in &triggers {
        let (stream_trigger, callback_trigger, mut heard) = (trigger.clone(), trigger.clone(), 0);
        let rings = stream::poll_fn(move |cx| {
            let ring = std::task::ready!(stream_trigger.poll(heard, cx));
            heard = ring;
            Poll::Ready(Some(ring))
        });
        stats.push(group.add(
            watched(&told).name("trigger"),
            rings,
            |ring| *ring,
            move |_| {
                let trigger = callback_trigger.clone();
                async move { trigger.answer() }
            },
        ));
    }
    let executor = Executor::new(Realtime::Off);
    executor.spawn_group(CallbackOptions::other(), group).unwrap();
    assert_eq!(cycle(&[&triggers[0], &triggers[1], &triggers[2]]), [0, 0, 0, 0]);
    executor.shutdown().unwrap();
    assert!(stats.iter().all(|member| member.completions() >= CYCLES));
    assert!(told.load(Ordering::Relaxed) >= 2 * 3 * CYCLES);
}

/// Two threads run one callback of another executor, at once: nothing is lost of the counts, and nothing allocated.
#[test]
fn jobs_of_other_executors_are_counted_without_allocation() {
    let prefix = format!("taut_test_foreign_{}_", std::process::id());
    let file = StatisticsFile::create(&prefix, &ProcessInfo::of_this()).unwrap();
    let (deadline, budget) = (Duration::from_secs(100), Duration::from_nanos(1));
    let options = CallbackOptions::other().name("detect").deadline(deadline).budget(budget);
    let callback = ForeignCallback::new(&file, &options).unwrap();
    let timer = ForeignCallback::by_publications(&file, &options.clone().name("tick")).unwrap();
    let executors = [false, true].map(|is_alone| ForeignExecutor::new(&file, "rclcpp", is_alone).unwrap());
    let jobs = || {
        let run = |count: u64| {
            for _ in 0..count {
                foreign::idle();
                let release_ns = tautline_rt::clock::monotonic_ns();
                callback.begin(Some(release_ns), job::QueueState { lost: 1, max_queue: 2, depth: 3 });
                let before_ns = foreign::used_ns().unwrap();
                assert!(callback.end(Some(release_ns)).unwrap() >= before_ns);
                executors.iter().for_each(|executor| executor.record(2, 3));
                timer.publish(release_ns);
            }
        };
        run(WARM_UP);
        let before = HEAP_CALLS.get();
        run(CYCLES);
        HEAP_CALLS.get() - before
    };
    let heap_calls = std::thread::scope(|scope| {
        let threads = [scope.spawn(jobs), scope.spawn(jobs)];
        threads.map(|thread| thread.join().unwrap())
    });
    assert_eq!(heap_calls, [0, 0]);
    let all = 2 * (WARM_UP + CYCLES);
    let seen = ForeignStatistics::list(&prefix).unwrap()[0].read().unwrap().unwrap();
    let [alone, beside] = [true, false].map(|is| seen.executors.iter().find(|of| of.is_alone == is).unwrap());
    assert_eq!((beside.overhead.sum_ns(), beside.callbacks.sum_ns()), (2 * all, 3 * all));
    assert_eq!((alone.overhead.sum_ns(), alone.callbacks.sum_ns(), &*alone.name), (5 * all, 0, "rclcpp"));
    let tick = seen.callbacks.iter().find(|of| of.name == "tick").unwrap();
    assert!(tick.is_by_publications && tick.least_distance_ns <= tick.greatest_distance_ns);
    assert_eq!((tick.releases, tick.completions, tick.response.n()), (all, all, 0));
    let seen = &seen.callbacks[0];
    assert_eq!((seen.name.as_str(), seen.releases, seen.completions, seen.lost), ("detect", all, all, all));
    assert_eq!((seen.overruns, seen.deadline_misses), (all, 0), "each takes longer than a nanosecond");
    assert_eq!((seen.response.n(), seen.execution.n(), seen.max_queue, seen.depth), (all, all, 2, 3));
    assert!(seen.tid != 0 && seen.measures_execution);
}

/// The sampler's account allocates nothing: not when it is early, and not when it is late.
#[test]
fn the_sampler_is_accounted_for_without_allocation() {
    const SLEEPS: u64 = 200;
    let executor = Executor::new(Realtime::Off).account_core_time(Some(Duration::ZERO));
    let sampler = executor.sampler_statistics().unwrap().unwrap();
    let account = sampler.account().unwrap();
    let before = HEAP_CALLS.get();
    for _ in 0..SLEEPS {
        account.sleeps();
        let due_ns = tautline_rt::clock::monotonic_ns();
        std::thread::sleep(Duration::from_micros(200));
        account.woke(Some(due_ns));
        account.sleeps();
        account.woke(None);
    }
    assert_eq!(HEAP_CALLS.get() - before, 0);
    let seen = tautline_executor::CallbackSnapshot::of(sampler.stats()).unwrap();
    let late = seen.moments.iter().filter(|moment| moment.kind == MomentKind::WokenLate).count();
    assert!(seen.older_moments + 128 >= 2 * SLEEPS && late > 0, "{late} of {}", seen.older_moments);
}
