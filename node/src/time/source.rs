// SPDX-License-Identifier: MIT OR Apache-2.0
//! Simulated time: the time of `/clock`, for the clocks and timers of a node.
//!
//! It needs no thread. A thread that reads the time, or waits for it, reads the new messages of `/clock`; the sampler
//! wakes all waiting tasks when a message has arrived.

use crate::error::{Error, Result};
use futures::task::{ArcWake, AtomicWaker, waker};
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::task::{Context, Poll, Waker};
use std::time::Duration;
use tautline_ros_msgs::rosgraph_msgs::msg::Clock as ClockMessage;
use tautline_rt::PiMutex;
use tautline_transport::{Limits, Participant, Qos, Subscription};

/// Gives a node's ROS clock the time of `/clock` when the parameter `use_sim_time` is set, at the start or later, or after
/// [`enable_sim_time`](Self::enable_sim_time). Until the first message the time is 0. A clone belongs to the same node.
#[derive(Clone)]
pub struct TimeSource {
    shared: Arc<TimeSourceState>,
}

struct TimeSourceState {
    participant: Participant,
    topic: String,
    enabled: AtomicBool,
    now_ns: AtomicI64,
    /// Held while a message is taken, also by real-time threads.
    reading: PiMutex<Reading>,
    /// Held while the clock's time source changes.
    switching: Mutex<()>,
    waiting: Arc<ClockWaiters>,
    callbacks: PiMutex<Callbacks>,
}

struct Reading {
    subscription: Option<Subscription<ClockMessage>>,
    waker: Waker,
}

type JumpFn = Arc<dyn Fn(ClockJump) + Send + Sync>;

#[derive(Default)]
struct Callbacks {
    list: Vec<(u64, JumpThreshold, JumpFn)>,
    next: u64,
}

/// How a clock has jumped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClockJump {
    /// Whether the clock's time source has changed.
    pub change: ClockChange,
    /// The distance in nanoseconds; negative: back.
    pub delta_ns: i64,
}

/// Whether a ROS clock's time source has changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClockChange {
    /// No change: it still shows simulated time.
    NoChange,
    /// It showed the system's time, and now that of `/clock`.
    Activated,
    /// It showed the time of `/clock`, and now the system's.
    Deactivated,
}

/// The jumps for which a callback is called. Each message of `/clock` is a jump forward.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct JumpThreshold {
    /// Jumps forward by at least this time.
    pub min_forward: Option<Duration>,
    /// Jumps back by at least this time.
    pub min_backward: Option<Duration>,
    /// Jumps caused by a [`ClockChange`].
    pub on_clock_change: bool,
}

impl Default for JumpThreshold {
    /// All jumps back, and changes of the clock's time source.
    fn default() -> JumpThreshold {
        JumpThreshold { min_forward: None, min_backward: Some(Duration::ZERO), on_clock_change: true }
    }
}

impl JumpThreshold {
    fn wants(&self, jump: ClockJump) -> bool {
        let far = |min: Option<Duration>| {
            min.is_some_and(|min| u128::from(jump.delta_ns.unsigned_abs()) >= min.as_nanos())
        };
        match jump.change {
            ClockChange::NoChange if jump.delta_ns > 0 => far(self.min_forward),
            ClockChange::NoChange => jump.delta_ns < 0 && far(self.min_backward),
            ClockChange::Activated | ClockChange::Deactivated => self.on_clock_change,
        }
    }
}

/// A callback for jumps; dropping this ends it.
#[must_use = "dropping it ends the callback"]
pub struct JumpCallback {
    shared: Weak<TimeSourceState>,
    number: u64,
}

/// Maximum of tasks that wait for a node's simulated time at once.
const WAITING: usize = 64;

/// The tasks that the sampler wakes when a message of `/clock` has arrived.
struct ClockWaiters {
    claimed: AtomicU64,
    wakers: [AtomicWaker; WAITING],
}

impl ClockWaiters {
    /// # Real-time
    /// One wake for each that waits; no allocation; no lock.
    fn wake_all(&self) {
        let claimed = self.claimed.load(Ordering::Acquire);
        for (index, waker) in self.wakers.iter().enumerate() {
            if claimed & (1 << index) != 0 {
                waker.wake();
            }
        }
    }
}

impl ArcWake for ClockWaiters {
    fn wake_by_ref(arc_self: &Arc<ClockWaiters>) {
        arc_self.wake_all();
    }
}

/// A place in [`ClockWaiters`].
pub(crate) struct ClockWaiter {
    source: TimeSource,
    index: usize,
}

impl TimeSource {
    pub(crate) fn new(participant: Participant, topic: String) -> TimeSource {
        let waiting = Arc::new(ClockWaiters {
            claimed: AtomicU64::new(0),
            wakers: [const { AtomicWaker::new() }; WAITING],
        });
        let reading = Reading { subscription: None, waker: waker(waiting.clone()) };
        let shared = TimeSourceState {
            participant,
            topic,
            enabled: AtomicBool::new(false),
            now_ns: AtomicI64::new(0),
            reading: PiMutex::new(reading),
            switching: Mutex::default(),
            waiting,
            callbacks: PiMutex::new(Callbacks::default()),
        };
        TimeSource { shared: Arc::new(shared) }
    }

    /// Switches to the time of `/clock`.
    ///
    /// # Errors
    /// [`Error::Transport`]: `/clock` cannot be subscribed to.
    pub fn enable_sim_time(&self) -> Result<()> {
        self.set_enabled(true)
    }

    /// Switches to the system's time.
    pub fn disable_sim_time(&self) {
        // Only enabling can fail.
        let _ = self.set_enabled(false);
    }

    /// Whether the time of `/clock` is used.
    pub fn is_enabled(&self) -> bool {
        self.shared.enabled.load(Ordering::Acquire)
    }

    pub(crate) fn set_enabled(&self, enabled: bool) -> Result<()> {
        let TimeSourceState { participant, topic, .. } = &*self.shared;
        let switching = self.shared.switching.lock().unwrap_or_else(PoisonError::into_inner);
        if enabled == self.is_enabled() {
            return Ok(());
        }
        let qos = Qos::keep_last(1).best_effort();
        // Created and dropped without the lock that threads that read the time take.
        let mut subscription = match enabled {
            true => Some(participant.create_subscription(topic, qos, Limits::default())?),
            false => None,
        };
        let (simulated_ns, wall_ns) =
            (self.shared.now_ns.load(Ordering::Relaxed), tautline_rt::clock::wall_ns());
        if !enabled {
            self.shared.enabled.store(false, Ordering::Release);
        }
        std::mem::swap(&mut self.shared.reading.lock().subscription, &mut subscription);
        if enabled {
            self.shared.enabled.store(true, Ordering::Release);
        }
        drop(subscription);
        drop(switching);
        self.call(match enabled {
            true => ClockJump { change: ClockChange::Activated, delta_ns: simulated_ns - wall_ns },
            false => ClockJump { change: ClockChange::Deactivated, delta_ns: wall_ns - simulated_ns },
        });
        self.shared.waiting.wake_all();
        Ok(())
    }

    /// The simulated time, if it is enabled.
    pub(super) fn simulated_ns(&self) -> Option<i64> {
        if !self.is_enabled() {
            return None;
        }
        self.update();
        Some(self.shared.now_ns.load(Ordering::Relaxed))
    }

    /// Reads the new messages of `/clock`.
    ///
    /// # Real-time
    /// At most eight messages, one unless more come just now: after eight it wakes those that wait for the time. No allocation, but for
    /// callbacks that want to know of the jump. Another thread that reads is waited for, and has this one's priority meanwhile.
    pub(crate) fn update(&self) {
        for _ in 0..8 {
            match self.take() {
                Some(jump) => self.call(jump),
                None => return,
            }
        }
        // There may be more, for which nobody rings.
        self.shared.waiting.wake_all();
    }

    fn take(&self) -> Option<ClockJump> {
        let reading = self.shared.reading.lock();
        let subscription = reading.subscription.as_ref()?;
        let mut context = Context::from_waker(&reading.waker);
        let Poll::Ready(Some(sample)) = subscription.poll_take(&mut context) else { return None };
        let time = sample.to_owned().clock;
        let now_ns = i64::from(time.sec) * 1_000_000_000 + i64::from(time.nanosec);
        let before_ns = self.shared.now_ns.swap(now_ns, Ordering::Relaxed);
        Some(ClockJump { change: ClockChange::NoChange, delta_ns: now_ns - before_ns })
    }

    fn call(&self, jump: ClockJump) {
        let callbacks = self.shared.callbacks.lock();
        let wanted = callbacks.list.iter().filter(|(_, threshold, _)| threshold.wants(jump));
        let wanted: Vec<JumpFn> = wanted.map(|(.., callback)| callback.clone()).collect();
        drop(callbacks);
        wanted.iter().for_each(|callback| callback(jump));
    }

    pub(super) fn on_jump(
        &self,
        threshold: JumpThreshold,
        callback: impl Fn(ClockJump) + Send + Sync + 'static,
    ) -> JumpCallback {
        let mut callbacks = self.shared.callbacks.lock();
        let number = callbacks.next;
        callbacks.next += 1;
        callbacks.list.push((number, threshold, Arc::new(callback)));
        JumpCallback { shared: Arc::downgrade(&self.shared), number }
    }

    /// Claims a place for a task to be woken.
    pub(crate) fn waiter(&self) -> Result<ClockWaiter> {
        let claimed = &self.shared.waiting.claimed;
        let claim = |claimed: u64| (claimed != u64::MAX).then(|| claimed | (claimed + 1));
        match claimed.fetch_update(Ordering::AcqRel, Ordering::Acquire, claim) {
            Ok(before) => Ok(ClockWaiter { source: self.clone(), index: before.trailing_ones() as usize }),
            Err(_) => Err(Error::ClockUsers { max: WAITING }),
        }
    }
}

impl ClockWaiter {
    pub(super) fn source(&self) -> &TimeSource {
        &self.source
    }

    /// Reads the new messages of `/clock`, and registers the task as [`register`](Self::register) does.
    #[cfg(feature = "tf2_msgs")]
    pub(crate) fn update(&self, context: &Context<'_>) {
        self.register(context);
        self.source.update();
    }

    /// Registers the task to be woken when the time, or its source, may have changed.
    pub(super) fn register(&self, context: &Context<'_>) {
        self.source.shared.waiting.wakers[self.index].register(context.waker());
    }
}

impl Drop for ClockWaiter {
    fn drop(&mut self) {
        let waiting = &self.source.shared.waiting;
        // Before another waiter can claim the place.
        waiting.wakers[self.index].take();
        waiting.claimed.fetch_and(!(1 << self.index), Ordering::AcqRel);
    }
}

impl Drop for JumpCallback {
    fn drop(&mut self) {
        if let Some(shared) = self.shared.upgrade() {
            let mut callbacks = shared.callbacks.lock();
            let own = callbacks.list.iter().position(|(number, ..)| *number == self.number);
            let own = own.map(|place| callbacks.list.remove(place));
            // Dropped without the lock, because it may own another callback.
            drop(callbacks);
            drop(own);
        }
    }
}

tautline_rt::debug_fields!(TimeSource, |this| enabled = this.is_enabled());

tautline_rt::debug_fields!(JumpCallback);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_callback_gets_the_jumps_that_it_wants() {
        let jump = |change, delta_ns| ClockJump { change, delta_ns };
        let far = JumpThreshold {
            min_forward: Some(Duration::from_nanos(10)),
            min_backward: Some(Duration::from_nanos(5)),
            on_clock_change: false,
        };
        use ClockChange::*;
        for (change, delta_ns, wanted, by_default) in [
            (NoChange, 9, false, false),
            (NoChange, 10, true, false),
            (NoChange, -4, false, true),
            (NoChange, -5, true, true),
            (NoChange, 0, false, false),
            (Activated, 100, false, true),
            (Deactivated, -100, false, true),
        ] {
            assert_eq!(far.wants(jump(change, delta_ns)), wanted, "{change:?} {delta_ns}");
            assert_eq!(
                JumpThreshold::default().wants(jump(change, delta_ns)),
                by_default,
                "{change:?} {delta_ns}"
            );
        }
    }
}
