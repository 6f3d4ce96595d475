// SPDX-License-Identifier: MIT OR Apache-2.0
//! The system file at run time: sets the priorities, cores and capacities that `taut check` computed.

use crate::error::{Result, SystemError};
use std::path::{Path, PathBuf};
use std::time::Duration;
use tautline_analysis::Reservation;
use tautline_analysis::file::{self, CheckedCallback, CheckedSystem, SystemFile, WakeUp};
use tautline_executor::{CallbackOptions, OverrunPolicy, Policy, ProcessInfo};

/// A system file, checked, as one host sees it.
#[derive(Debug)]
pub struct LoadedSystem {
    path: PathBuf,
    /// This host's name in the file.
    pub host: String,
    /// The file.
    pub file: SystemFile,
    /// Its analysis.
    pub checked: CheckedSystem,
    /// The priority of the host's samplers.
    pub sampler_priority: u8,
    /// Whether nodes and callbacks of ROS 2 that the file does not list are refused, instead of being warned of.
    pub refuses_unlisted: bool,
}

impl LoadedSystem {
    /// Reads and analyses the file. A system that is not schedulable, and every warning, is logged.
    ///
    /// # Errors
    /// [`SystemError::File`] with everything that is wrong with the file; [`SystemError::Host`] if `host` is not in it, or if it has
    /// several hosts and none is named.
    pub fn read(path: &Path, host: Option<&str>) -> Result<Self> {
        let file = SystemFile::read(path)?;
        let host = file.host(host).map(str::to_owned).map_err(|hosts| {
            let wanted = host.map(str::to_owned);
            SystemError::Host { path: path.into(), wanted, known: hosts.join(", ") }
        })?;
        let core = file.cores().iter().find(|core| core.host == host);
        let sampler_priority = core.map_or(90, |core| core.sampler_priority);
        let refuses_unlisted = core.is_some_and(|core| core.refuses_unlisted);
        let checked = file.check();
        for warning in &checked.warnings {
            tracing::warn!("{}: {warning}", path.display());
        }
        if !checked.schedulable {
            tracing::warn!("{}: not schedulable; see `taut check {0}`", path.display());
        }
        let path = path.into();
        Ok(LoadedSystem { path, host, file, checked, sampler_priority, refuses_unlisted })
    }

    /// The callbacks of this host.
    pub fn callbacks(&self) -> impl Iterator<Item = &CheckedCallback> {
        self.checked.callbacks.iter().filter(|callback| callback.host == self.host)
    }

    /// The entry of the callback `name`.
    ///
    /// # Errors
    /// [`SystemError::UnknownCallback`].
    pub fn find(&self, name: &str) -> Result<&CheckedCallback> {
        self.callbacks().find(|callback| callback.entry.name == name).ok_or_else(|| {
            let known: Vec<_> = self.callbacks().map(|callback| callback.entry.name.as_str()).collect();
            let (path, host) = (self.path.clone(), self.host.clone());
            SystemError::UnknownCallback { name: name.into(), path, host, known: known.join(", ") }
        })
    }

    /// The thread of the callback `name`.
    pub fn options(&self, name: &str) -> Result<CallbackOptions> {
        let callback = self.find(name)?;
        let thread = thread_of(callback);
        let overrun_policy = match callback.entry.overrun {
            file::OverrunPolicy::Tell => OverrunPolicy::Tell,
            file::OverrunPolicy::Demote => OverrunPolicy::Demote,
            file::OverrunPolicy::Suspend => OverrunPolicy::Suspend,
            file::OverrunPolicy::End => OverrunPolicy::End,
        };
        let bound = callback.response_overhead_ns.map(Duration::from_nanos);
        Ok(CallbackOptions { bound, overrun_policy, ..thread }
            .name(name)
            .period(Duration::from_nanos(callback.period_ns))
            .deadline(Duration::from_nanos(callback.entry.deadline_ns))
            .budget(Duration::from_nanos(callback.charged_ns)))
    }

    /// The thread of the group `name`.
    pub fn group(&self, name: &str) -> Result<CallbackOptions> {
        let group = |callback: &&CheckedCallback| callback.entry.group.as_deref() == Some(name);
        match self.callbacks().find(group) {
            Some(member) => Ok(thread_of(member).name(name)),
            None => {
                let mut known: Vec<&str> =
                    self.callbacks().filter_map(|callback| callback.entry.group.as_deref()).collect();
                known.sort_unstable();
                known.dedup();
                let (path, host, known) = (self.path.clone(), self.host.clone(), known.join(", "));
                Err(SystemError::UnknownGroup { name: name.into(), path, host, known })
            }
        }
    }

    /// Fills in the host, path and hash of the system file, which other processes read.
    pub fn describe(&self, about: &mut ProcessInfo) {
        about.host.clone_from(&self.host);
        about.system_path = std::path::absolute(&self.path).unwrap_or_else(|_| self.path.clone());
        about.system_hash = self.file.fingerprint();
    }

    /// Whether a process runs with this file, as this host.
    pub fn is_of(&self, process: &ProcessInfo) -> bool {
        process.system_hash == self.file.fingerprint() && process.host == self.host
    }

    /// Reads the present text of the file.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn again(&self) -> Result<LoadedSystem> {
        LoadedSystem::read(&self.path, Some(&self.host))
    }

    /// The callbacks of this host, with the threads that they get.
    pub fn threads(&self) -> impl Iterator<Item = Result<CallbackOptions>> {
        self.callbacks().map(|callback| self.options(&callback.entry.name))
    }

    /// The first change in another text of the file that a process cannot adopt: all but priorities, reservations, wcets, deadlines.
    pub fn obstacle(&self, other: &LoadedSystem) -> Option<String> {
        if self.sampler_priority != other.sampler_priority {
            return Some(format!(
                "its sampler has priority {}, not {}",
                self.sampler_priority, other.sampler_priority
            ));
        }
        let of = |system: &LoadedSystem| system.callbacks().cloned().collect::<Vec<_>>();
        let (old, new) = (of(self), of(other));
        let lacks = |one: &[CheckedCallback], other: &[CheckedCallback]| {
            let missing = one.iter().find(|of| other.iter().all(|it| it.entry.name != of.entry.name));
            missing.map(|callback| callback.entry.name.clone())
        };
        if let Some(name) = lacks(&old, &new).or_else(|| lacks(&new, &old)) {
            return Some(format!("callback `{name}` is in only one of both texts"));
        }
        old.iter().find_map(|old| {
            let new = new.iter().find(|new| new.entry.name == old.entry.name)?;
            let (was, is) = (&old.entry, &new.entry);
            let queue_size = |of: &CheckedCallback| of.join.as_ref().map(|join| join.queue_size);
            // The running queues have the depths that were computed for the old text. A timer has none.
            let grows = !is.topics.is_empty() && is.depth.is_none() && old.capacity < new.capacity;
            let what = match () {
                () if (&was.node, was.client) != (&is.node, is.client) => "node",
                () if (old.core, was.floats) != (new.core, is.floats) => "core",
                () if (&was.group, &was.thread) != (&is.group, &is.thread) => "thread",
                () if was.reservation.is_some() != is.reservation.is_some() => "kind of scheduling",
                () if was.overrun != is.overrun => "`overrun`",
                () if (&was.topics, was.joins, was.window_ns) != (&is.topics, is.joins, is.window_ns) => {
                    "topics"
                }
                () if was.policy != is.policy => "`policy`",
                () if old.period_ns != new.period_ns => "period",
                () if (was.wake_up == WakeUp::Publisher) != (is.wake_up == WakeUp::Publisher) => "wake-up",
                () if was.depth != is.depth => "`depth`",
                () if grows || queue_size(old) < queue_size(new) => "queue, which has to be deeper",
                () => return None,
            };
            Some(format!("callback `{}` has another {what}", was.name))
        })
    }

    /// The file's path, as it was given.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The file's name in messages: its absolute path.
    pub fn label(&self) -> String {
        std::path::absolute(&self.path).unwrap_or_else(|_| self.path.clone()).display().to_string()
    }

    /// Whether a thread has the priority and the core that the file gives the callback `name`.
    pub fn describes(&self, thread: &CallbackOptions, name: &str) -> bool {
        self.find(name).is_ok_and(|callback| {
            let of_file = thread_of(callback);
            (of_file.policy, of_file.cores) == (thread.policy, thread.cores)
        })
    }

    /// The queue depth of the callback `name`: as the file says, else as the analysis computed.
    ///
    /// # Errors
    /// [`SystemError::UnknownCallback`]; [`SystemError::NoCapacity`] if neither is there.
    pub fn depth(&self, name: &str) -> Result<usize> {
        let callback = self.find(name)?;
        let stated = callback.entry.depth.and_then(|depth| usize::try_from(depth).ok());
        let depth = stated.or(callback.capacity).map(|depth| depth.max(1));
        depth.ok_or_else(|| SystemError::NoCapacity { name: name.into(), path: self.path.clone() })
    }
}

/// The thread of a callback, with the name that the file gives it.
fn thread_of(callback: &CheckedCallback) -> CallbackOptions {
    // The executor puts its own `cb:` before the name.
    let thread = callback.entry.thread.strip_prefix("cb:").unwrap_or(&callback.entry.thread);
    let options = match callback.entry.reservation {
        Some(Reservation { runtime_ns, period_ns }) => {
            CallbackOptions::new(Policy::Deadline { runtime_ns, period_ns })
        }
        None => CallbackOptions::fifo(callback.entry.priority),
    };
    let mut options = options.thread_name(thread);
    options.direct_wake = callback.entry.wake_up == WakeUp::Publisher;
    options.is_direct_wake_optional = true;
    if callback.entry.floats { options } else { options.core(callback.core) }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEAD: &str = "[hosts.robot]\ncores = 1\n[nodes.n]\n";

    fn loaded(text: &str) -> LoadedSystem {
        let file = SystemFile::parse(text).unwrap_or_else(|problems| panic!("{problems}"));
        let (path, host, checked) = (PathBuf::new(), "robot".to_owned(), file.check());
        LoadedSystem { path, host, file, checked, sampler_priority: 90, refuses_unlisted: false }
    }

    #[test]
    fn a_timer_has_no_queue_that_could_be_too_short() {
        let text = |wcet: &str| {
            format!(
                "{HEAD}[callbacks.high]\nperiod = \"30ms\"\nwcet = \"{wcet}\"\npriority = 20\n\
                 [callbacks.low]\nperiod = \"10ms\"\nwcet = \"2ms\"\ndeadline = \"30ms\"\npriority = 10\n"
            )
        };
        let (old, new) = (loaded(&text("4ms")), loaded(&text("12ms")));
        assert!(
            new.checked.schedulable && old.checked.callbacks[1].capacity < new.checked.callbacks[1].capacity
        );
        assert_eq!(old.obstacle(&new), None);
    }

    #[test]
    fn each_queue_of_a_join_is_compared_for_itself() {
        let join = |depth: &str| {
            let text = format!(
                "{HEAD}[topics]\na = {{ period = \"10ms\"{depth} }}\nb = {{ period = \"10ms\"{depth} }}\n\
                 [callbacks.fuse]\nall = [\"a\", \"b\"]\nwindow = \"20ms\"\nwcet = \"1ms\"\n"
            );
            let of = |capacity: usize, queue_size: usize| {
                let mut loaded = loaded(&text);
                let fuse = &mut loaded.checked.callbacks[0];
                fuse.capacity = Some(capacity);
                fuse.join.as_mut().unwrap().queue_size = queue_size;
                loaded
            };
            let deeper = "callback `fuse` has another queue, which has to be deeper".to_owned();
            assert_eq!(of(3, 5).obstacle(&of(2, 4)), None);
            assert_eq!(of(3, 4).obstacle(&of(2, 5)), Some(deeper.clone()), "the synchronizer's");
            let computed = depth.is_empty();
            assert_eq!(of(2, 4).obstacle(&of(3, 4)), computed.then_some(deeper), "the topics'");
            loaded(&text)
        };
        let (computed, stated) = (join(""), join(", depth = 9"));
        assert_eq!(computed.obstacle(&stated), Some("callback `fuse` has another `depth`".to_owned()));
    }
}
