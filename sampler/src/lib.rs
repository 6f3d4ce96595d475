// SPDX-License-Identifier: MIT OR Apache-2.0
//! One highest-priority thread that waits for events and wakes callback threads.
//!
//! The [`Sampler`] sleeps on its participant's doorbell with the next timer's release as the time-out. When something is
//! pending it wakes the tasks registered there, and does nothing else: it reads no payload, runs no callback, takes no
//! lock, allocates nothing. Its work per wake is O(ready), so it can be charged per message in a response-time analysis; arming,
//! setting or dropping a timer, a watchdog or an alarm costs it O(timers) once.
//!
//! - [`Timer`]s are absolute: release *k* is at `start + k * period`, whatever happened before. A release that was
//!   not taken is counted as missed, and is not delivered late in a burst.
//! - A [`Watchdog`] wakes a task when an activity did not happen in time; each activity costs its thread one store.
//! - An [`Alarm`] wakes a task once, at the time that was set.
//! - A [`GuardCondition`] wakes a task from any thread.
//! - [`PublisherEvents`] and [`SubscriptionEvents`] are the QoS events of an endpoint: matches, leases, losses.
//! - [`Wait::Adaptive`] spins for some time before it sleeps: wake-ups are cheaper while messages arrive
//!   often.
//!
//! ```
//! use std::time::Duration;
//! use tautline_sampler::{Sampler, Timer};
//! use tautline_transport::Participant;
//!
//! let participant = Participant::new(121)?;
//! let mut sampler = Sampler::new(&participant)?;
//! let mut timer = Timer::new(sampler.events(), Duration::from_millis(1))?;
//!
//! let mut pool = futures::executor::LocalPool::new();
//! futures::task::LocalSpawnExt::spawn_local(&pool.spawner(), async move {
//!     let tick = timer.tick().await;
//!     assert_eq!(tick.index, 1 + tick.missed); // the first one, unless this thread came too late for it
//! }).unwrap();
//! while !pool.try_run_one() {
//!     sampler.spin_once(Some(Duration::from_millis(10)));
//! }
//! # Ok::<(), tautline_transport::TransportError>(())
//! ```
#![forbid(unsafe_code)]

mod alarm;
mod events;
mod hot;
mod qos_events;
mod sampler;
mod timer;
mod timers;
mod watchdog;

pub use alarm::Alarm;
pub use events::{Events, GuardCondition};
pub use qos_events::{
    DeadlineMissed, LivelinessLost, PublisherEvent, PublisherEvents, SubscriptionEvent, SubscriptionEvents,
};
pub use sampler::{Sampler, SamplerThread, Sleep, Wait};
pub use timer::{Tick, Timer};
pub use watchdog::{Expiry, Watchdog};
