// SPDX-License-Identifier: MIT OR Apache-2.0
//! Real-time set-up of threads and memory, each setting read back.
//!
//! - [`ThreadBuilder`] starts a thread with a [`Policy`] and a [`CoreSet`], and reports success only after the
//!   kernel has confirmed both. [`Realtime::Off`] is the explicit opt-out for machines without the privilege.
//! - [`set_policy`], [`set_affinity`] do the same for a thread that exists; [`threads`] reads every thread back.
//! - [`BudgetTimer`] demotes or suspends a thread that uses more processor time than it was given; [`prove_enforcement`] tries
//!   whether that works here.
//! - [`CoreTime`] shows how much time a thread used, waited for, and lost to the hypervisor or interrupts.
//! - [`lock_memory`], [`prefault_stack`], [`tune_malloc`] claim memory before it is needed; [`IdleHold`] keeps the
//!   cores out of idle states.
//! - [`Words`] is memory for statistics that other processes may read ([`WordsFile`], [`ForeignWords`]).
//! - [`shm`] has the files in /dev/shm that contain all of this workspace's shared memory; [`domain`] has their
//!   location.
//! - [`Caches`] are the processor's; [`copy_to_shared`] copies into memory that another core has read,
//!   [`fetch_to_write`] and [`fetch_to_read`] fetch it before that.
//! - [`fork`] keeps children of the process from its locks and shared memory.
//! - [`PiMutex`] protects data that threads of different priorities use; [`FutexWord`] is a word to sleep on; [`full_fence`] orders a
//!   store before a load.
//! - [`WakerCell`] has the waker of a task that threads of different priorities wake.
//! - [`Patience`] limits the time of a polling loop.
//! - [`at_exit`] calls a function when the process ends, even if other threads still run.
//! - [`termination_signals`] are those that ask a process to end.
//! - [`latest`] passes the newest of many values to another thread, without waiting on either side.
//! - [`clock`] has the clocks, [`host`] the properties of the machine, [`permission`] the reasons why it
//!   refuses a setting.
//! - [`terminal`] escapes the control characters of untrusted text.
//!
//! Set-up, which allocates, reads files and makes syscalls, is everything except [`clock`], [`copy_to_shared`], [`fetch_to_write`],
//! [`fetch_to_read`], [`full_fence`], [`shm::page_bytes`], [`fork::ProcessMark::is_here`], and the use of [`Words`], [`PiMutex`],
//! [`FutexWord`], [`WakerCell`], [`BudgetTimer`], [`CoreTime`], [`Patience`] and the objects of [`latest`]. No other crate of the
//! workspace calls `sched_*` or `mlock*`.
//!
//! ```
//! use tautline_rt::{Policy, Realtime, ThreadBuilder};
//!
//! let thread = ThreadBuilder::new("worker")
//!     .policy(Policy::Fifo(20))
//!     .realtime(Realtime::Off) // without this line, a missing privilege is an error that names the fix
//!     .spawn(|| {
//!         let table = [1, 2, 3]; // set-up, before the thread is real-time
//!         move || table.iter().sum::<i32>() // the real-time part
//!     })?;
//! assert_eq!(thread.join()?, 6);
//! # Ok::<(), tautline_rt::RtError>(())
//! ```

/// Implements `Debug` for a type of which only the named fields are of use to people: `debug_fields!([T: Codec] Publisher<T>, |this|
/// topic = this.topic())`.
#[macro_export]
macro_rules! debug_fields {
    ($([$($bounds:tt)*])? $type:ident $(<$($arguments:tt),*>)? $(, |$this:ident| $($field:ident = $value:expr),*)?) => {
        impl $(<$($bounds)*>)? ::core::fmt::Debug for $type $(<$($arguments),*>)? {
            fn fmt(&self, f: &mut ::core::fmt::Formatter<'_>) -> ::core::fmt::Result {
                $(let $this = self;)?
                f.debug_struct(stringify!($type))$($(.field(stringify!($field), &$value))*)?.finish_non_exhaustive()
            }
        }
    };
}

/// The names of an enum's variants, in one table: generates an array of all variants and a method that returns the name, or `Display`.
#[doc(hidden)]
#[macro_export]
macro_rules! names {
    ($type:ident: Display { $($variant:ident: $name:literal),+ $(,)? }) => {
        impl ::core::fmt::Display for $type {
            fn fmt(&self, f: &mut ::core::fmt::Formatter<'_>) -> ::core::fmt::Result {
                f.write_str(match self { $(Self::$variant => $name),+ })
            }
        }
    };
    ($type:ident: $all_vis:vis const ALL: [$all:ident; $count:literal]; $($rest:tt)+) => {
        $crate::names!($type: $($rest)+);
        $crate::names!($type: $all_vis, $count, $($rest)+);
    };
    ($type:ident: $vis:vis const fn $method:ident(self) -> &'static str { $($variant:ident: $name:literal),+ $(,)? }) => {
        impl $type {
            /// Its name in texts.
            $vis const fn $method(self) -> &'static str {
                match self { $(Self::$variant => $name),+ }
            }
        }
    };
    ($type:ident: $all_vis:vis, $count:literal, $vis:vis const fn $method:ident(self) -> &'static str { $($variant:ident: $name:literal),+ $(,)? }) => {
        impl $type {
            /// All variants, in the order of their numbers.
            $all_vis const ALL: [$type; $count] = [$($type::$variant),+];
        }
    };
}

mod budget;
mod caches;
mod core_time;
mod cores;
mod enforcement;
mod enforcer;
mod error;
mod exit;
mod fence;
mod futex;
mod idle;
mod latest;
mod lock_file;
mod memory;
mod mutex;
mod noise;
mod own_priority;
mod patience;
mod policy;
mod proof;
mod refusal;
mod schedule;
mod sync;
mod termination;
mod thread;
mod thread_time;
mod tid;
mod waker_cell;
mod words;

pub mod clock;
pub mod domain;
pub mod fork;
pub mod host;
pub mod permission;
pub mod shm;
pub mod terminal;

pub use budget::{BudgetTimer, Refill, RemainingBudget};
pub use caches::{Caches, copy_to_shared, fetch_to_read, fetch_to_write};
pub use core_time::{CoreMark, CoreTime};
pub use cores::{CoreSet, affinity_of, current_affinity, set_affinity, set_affinity_of};
pub use enforcement::Enforcement;
pub use error::RtError;
pub use exit::{AtExit, at_exit, exempt_children};
pub use fence::full_fence;
pub use futex::FutexWord;
pub use idle::IdleHold;
pub use latest::{LatestReader, LatestWriter, latest};
pub use lock_file::{LockFile, LockFileError};
pub use memory::{
    MemoryLock, PageFaults, keep_freed_memory, lock_memory, page_faults, prefault_stack, tune_malloc,
};
pub use mutex::{PiGuard, PiMutex};
pub use noise::Interruptions;
pub use own_priority::OwnPriority;
pub use patience::Patience;
pub use policy::Policy;
pub use proof::{prove_enforcement, prove_enforcement_by};
pub use schedule::{
    current_policy, policy_of, set_own_priority, set_policy, set_policy_of, switch_own_priority,
};
pub use termination::termination_signals;
pub use thread::{JoinHandle, Realtime, ThreadBuilder, ThreadInfo, short_name, threads, threads_of};
pub use thread_time::ThreadTime;
pub use tid::current_tid;
pub use waker_cell::WakerCell;
pub use words::{ForeignMap, ForeignWords, Words, WordsFile, page_words};
