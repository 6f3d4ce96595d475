// SPDX-License-Identifier: MIT OR Apache-2.0
//! The registered threads with their cores and priorities, so that no busy-polling callback starves another
//! thread.

use std::sync::{Arc, Mutex, PoisonError};

use tautline_rt::CoreSet;

use crate::ExecutorError;

/// The threads that are registered with an executor.
#[derive(Debug, Clone, Default)]
pub(crate) struct Registry {
    threads: Arc<Mutex<Vec<Arc<RegisteredThread>>>>,
}

/// The properties of a thread that decide whether it starves, or starves others.
#[derive(Debug)]
pub(crate) struct RegisteredThread {
    pub name: String,
    /// `None` for time-sharing threads, which are below every real-time priority.
    pub priority: Option<u8>,
    pub cores: CoreSet,
    pub busy: bool,
}

/// The registration of a thread with the executor, until dropped.
#[derive(Debug)]
#[must_use = "the thread is forgotten as soon as this is dropped"]
pub struct ThreadRegistration {
    registry: Registry,
    thread: Arc<RegisteredThread>,
}

impl Registry {
    /// Registers a thread of a process that may use this number of cores, unless it or another thread would then starve.
    pub fn claim(
        &self,
        thread: RegisteredThread,
        usable: usize,
    ) -> Result<ThreadRegistration, ExecutorError> {
        if thread.busy {
            if thread.cores.len() != 1 {
                return Err(ExecutorError::BusyPollCores {
                    name: thread.name,
                    cores: thread.cores.to_string(),
                });
            }
            if let (Some(priority), 0..=1) = (thread.priority, usable) {
                return Err(ExecutorError::BusyPollOnlyCore { name: thread.name, priority });
            }
        }
        let thread = Arc::new(thread);
        let mut threads = self.threads.lock().unwrap_or_else(PoisonError::into_inner);
        threads.push(Arc::clone(&thread));
        if let Some(starvation) = starvation(&threads) {
            threads.pop();
            return Err(starvation);
        }
        Ok(ThreadRegistration { registry: self.clone(), thread })
    }
}

impl Drop for ThreadRegistration {
    fn drop(&mut self) {
        let mut threads = self.registry.threads.lock().unwrap_or_else(PoisonError::into_inner);
        threads.retain(|thread| !Arc::ptr_eq(thread, &self.thread));
    }
}

/// The first thread of which every core is held by a real-time busy poller of its priority or above.
fn starvation(threads: &[Arc<RegisteredThread>]) -> Option<ExecutorError> {
    threads.iter().find_map(|starved| {
        let holder = |core| {
            let mut others = threads.iter().filter(|other| !Arc::ptr_eq(other, starved));
            others.find(|other| {
                other.busy
                    && other.priority.is_some()
                    && other.priority >= starved.priority
                    && other.cores.contains(core)
            })
        };
        let holders: Option<Vec<_>> = starved.cores.iter().map(holder).collect();
        let busy = holders?.into_iter().next()?;
        Some(ExecutorError::Starved {
            busy: busy.name.clone(),
            busy_priority: busy.priority?,
            starved: starved.name.clone(),
            cores: starved.cores.to_string(),
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn thread(name: &str, priority: Option<u8>, cores: &[usize]) -> RegisteredThread {
        RegisteredThread {
            name: name.to_owned(),
            priority,
            cores: cores.iter().copied().collect(),
            busy: false,
        }
    }

    fn busy(name: &str, priority: Option<u8>, cores: &[usize]) -> RegisteredThread {
        RegisteredThread { busy: true, ..thread(name, priority, cores) }
    }

    /// `Err` names the busy poller and the starved thread.
    fn claim(registry: &Registry, thread: RegisteredThread) -> Result<ThreadRegistration, (String, String)> {
        registry.claim(thread, 4).map_err(|error| match error {
            ExecutorError::Starved { busy, starved, .. } => (busy, starved),
            other => panic!("{other}"),
        })
    }

    fn refused(busy: &str, starved: &str) -> (String, String) {
        (busy.to_owned(), starved.to_owned())
    }

    #[test]
    fn a_busy_poller_may_not_starve_those_that_are_there() {
        let registry = Registry::default();
        let _low = claim(&registry, thread("low", Some(10), &[1])).unwrap();
        let _free = claim(&registry, thread("free", Some(5), &[1, 2])).unwrap();
        let _sampler = claim(&registry, thread("sampler", Some(90), &[0])).unwrap();
        assert_eq!(claim(&registry, busy("b", Some(10), &[1])).unwrap_err(), refused("b", "low"));
        let _below = claim(&registry, busy("below", Some(9), &[1])).unwrap();
        let _under_the_sampler = claim(&registry, busy("c", Some(20), &[0])).unwrap();
        // Both cores of `free` would be held.
        assert_eq!(claim(&registry, busy("d", Some(5), &[2])).unwrap_err(), refused("below", "free"));
        // Time sharing starves nobody.
        let _shared = claim(&registry, busy("e", None, &[1])).unwrap_err();
        let _shared = claim(&registry, busy("f", None, &[2])).unwrap();
    }

    #[test]
    fn nobody_may_come_to_starve_below_a_busy_poller() {
        let registry = Registry::default();
        let poller = claim(&registry, busy("b", Some(20), &[1])).unwrap();
        for priority in [None, Some(1), Some(20)] {
            assert_eq!(claim(&registry, thread("late", priority, &[1])).unwrap_err(), refused("b", "late"));
        }
        let _above = claim(&registry, thread("above", Some(21), &[1])).unwrap();
        let _elsewhere = claim(&registry, thread("elsewhere", Some(1), &[1, 3])).unwrap();
        assert_eq!(claim(&registry, busy("b2", Some(30), &[1])).unwrap_err(), refused("b2", "b"));
        drop(poller);
        let _late = claim(&registry, thread("late", Some(20), &[1])).unwrap();
    }

    #[test]
    fn a_busy_poller_needs_a_core_of_its_own() {
        let registry = Registry::default();
        for cores in [&[][..], &[0, 1]] {
            let error = registry.claim(busy("b", None, cores), 4).unwrap_err();
            assert!(matches!(error, ExecutorError::BusyPollCores { .. }), "{error}");
        }
        let error = registry.claim(busy("b", Some(1), &[0]), 1).unwrap_err();
        assert!(matches!(error, ExecutorError::BusyPollOnlyCore { priority: 1, .. }), "{error}");
        let _shared = registry.claim(busy("b", None, &[0]), 1).unwrap();
    }
}
