// SPDX-License-Identifier: MIT OR Apache-2.0
//! Starts threads, and reads back running threads.

use std::any::Any;
use std::sync::mpsc;
use std::{fs, io, thread};

use crate::fork::ProcessMark;
use crate::{
    CoreSet, Policy, RtError, affinity_of, current_affinity, current_policy, current_tid, policy_of,
    prefault_stack, set_affinity, set_policy,
};

/// Whether real-time policies are applied.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Realtime {
    /// They are applied, and a refusal is an error.
    #[default]
    Required,
    /// They are not applied: a thread keeps the policy of the thread that starts it. Affinity is still
    /// applied.
    Off,
}

/// A thread as the kernel reports it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ThreadInfo {
    /// The kernel's id of the thread.
    pub tid: u32,
    /// The name that `top -H` shows.
    pub name: String,
    /// Its policy.
    pub policy: Policy,
    /// The cores it may run on.
    pub cores: CoreSet,
}

impl ThreadInfo {
    /// The current thread, as the kernel reports it, with a name that may be longer than the kernel's.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`RtError::Kernel`] if the kernel does not provide the data.
    pub fn of_current(name: &str) -> Result<ThreadInfo, RtError> {
        let (policy, cores) = (current_policy()?, current_affinity()?);
        Ok(ThreadInfo { tid: current_tid(), name: short_name(name), policy, cores })
    }
}

/// Starts a thread with a name, a policy and cores.
#[derive(Debug, Clone)]
#[must_use = "call spawn()"]
pub struct ThreadBuilder {
    /// Shown by `top -H`, shortened by [`short_name`] when longer than 15 bytes.
    pub name: String,
    /// Defaults to `SCHED_OTHER`.
    pub policy: Policy,
    /// `None`: the cores of the thread that starts it; all, for [`Policy::Deadline`].
    pub cores: Option<CoreSet>,
    /// All of it is touched before the thread is real-time. At least 64 KiB, at most 1 GiB.
    pub stack_bytes: usize,
    /// Defaults to [`Realtime::Required`].
    pub realtime: Realtime,
}

impl ThreadBuilder {
    /// The stack size of a thread by default: 512 KiB.
    pub const STACK_BYTES: usize = 512 * 1024;

    /// A builder for a `SCHED_OTHER` thread.
    pub fn new(name: impl Into<String>) -> ThreadBuilder {
        ThreadBuilder {
            name: name.into(),
            policy: Policy::Other { nice: 0 },
            cores: None,
            stack_bytes: Self::STACK_BYTES,
            realtime: Realtime::Required,
        }
    }

    /// Sets the policy.
    pub fn policy(mut self, policy: Policy) -> ThreadBuilder {
        self.policy = policy;
        self
    }

    /// Sets the cores.
    pub fn cores(mut self, cores: CoreSet) -> ThreadBuilder {
        self.cores = Some(cores);
        self
    }

    /// Sets the size of the stack.
    pub fn stack_bytes(mut self, bytes: usize) -> ThreadBuilder {
        self.stack_bytes = bytes;
        self
    }

    /// Sets whether the policy is applied.
    pub fn realtime(mut self, realtime: Realtime) -> ThreadBuilder {
        self.realtime = realtime;
        self
    }

    /// Starts the thread. In it, in this order: the stack is touched, `setup` runs and returns the body, the policy
    /// is set, the cores are set, both are read back. Only then does `spawn` return and the body run.
    ///
    /// The cores are set last, because on a core that a real-time thread keeps busy, a new thread would not run far
    /// enough to set its own priority. So `setup` runs on the cores of the spawning thread.
    ///
    /// Objects that `setup` creates stay in the thread and need not be `Send`. `setup` may allocate; the body
    /// should not.
    ///
    /// # Errors
    /// The errors of [`set_affinity`] and [`set_policy`], [`RtError::Panicked`] if `setup` panics,
    /// [`RtError::Spawn`] and [`RtError::StackTooLarge`]. The thread has then ended and been joined.
    pub fn spawn<S, B, T>(self, setup: S) -> Result<JoinHandle<T>, RtError>
    where
        S: FnOnce() -> B + Send + 'static,
        B: FnOnce() -> T,
        T: Send + 'static,
    {
        const MAX_STACK_BYTES: usize = 1 << 30;
        self.policy.check()?;
        if let Some(cores) = self.cores {
            cores.check()?;
        }
        if self.stack_bytes > MAX_STACK_BYTES {
            let (name, bytes) = (self.name, self.stack_bytes);
            return Err(RtError::StackTooLarge { name, bytes, max: MAX_STACK_BYTES });
        }
        let name = self.name.clone();
        let (report, reported) = mpsc::sync_channel(1);
        let started = thread::Builder::new()
            .name(short_name(&self.name))
            .stack_size(self.stack_bytes.max(64 * 1024))
            .spawn(move || match self.prepare(setup) {
                Ok((body, info)) => {
                    let _ = report.send(Ok(info));
                    drop(report);
                    Some(body())
                }
                Err(error) => {
                    let _ = report.send(Err(error));
                    None
                }
            });
        let thread = match started {
            Ok(thread) => thread,
            Err(source) => return Err(RtError::Spawn { name, source }),
        };
        match reported.recv() {
            Ok(Ok(info)) => Ok(JoinHandle { name, info, thread, process: ProcessMark::new() }),
            Ok(Err(error)) => {
                let _ = thread.join();
                Err(error)
            }
            // Hung up without a report: the set-up panicked.
            Err(mpsc::RecvError) => Err(panicked(name, thread.join().err())),
        }
    }

    fn prepare<S: FnOnce() -> B, B>(&self, setup: S) -> Result<(B, ThreadInfo), RtError> {
        prefault_stack(self.stack_bytes);
        let body = setup();
        if self.realtime == Realtime::Required {
            if matches!(self.policy, Policy::Deadline { .. }) {
                // The kernel refuses this policy to a bound thread, and a new thread is bound as the thread that started it.
                set_affinity(CoreSet::allowed()?)?;
            }
            set_policy(self.policy)?;
        }
        if let Some(cores) = self.cores {
            set_affinity(cores)?;
        }
        Ok((body, ThreadInfo::of_current(&self.name)?))
    }
}

/// A thread started by [`ThreadBuilder`]; dropping it leaves the thread running.
#[derive(Debug)]
pub struct JoinHandle<T> {
    name: String,
    info: ThreadInfo,
    thread: thread::JoinHandle<Option<T>>,
    process: ProcessMark,
}

impl<T> JoinHandle<T> {
    /// The thread as read back at its start.
    pub fn info(&self) -> &ThreadInfo {
        &self.info
    }

    /// Whether the thread's body has returned or panicked, or this is a forked child, which has no such thread.
    pub fn is_finished(&self) -> bool {
        !self.process.is_here() || self.thread.is_finished()
    }

    /// Waits for the thread to end and returns what its body returned.
    ///
    /// # Errors
    /// [`RtError::Panicked`] with the thread's full name and the message; [`RtError::Forked`] in a forked child, at once.
    pub fn join(self) -> Result<T, RtError> {
        if !self.process.is_here() {
            return Err(RtError::Forked { name: self.name });
        }
        match self.thread.join() {
            Ok(Some(value)) => Ok(value),
            Ok(None) => Err(panicked(self.name, None)),
            Err(payload) => Err(panicked(self.name, Some(payload))),
        }
    }
}

/// Every thread of this process, in the kernel's order: also those that libraries have started.
///
/// # Errors
/// [`RtError::Kernel`] if `/proc` cannot be read. Threads that end meanwhile are left out.
pub fn threads() -> Result<Vec<ThreadInfo>, RtError> {
    threads_of(std::process::id())
}

/// Like [`threads`], for another process: none if it has ended.
///
/// # Errors
/// [`RtError::Kernel`] if `/proc` cannot be read.
pub fn threads_of(pid: u32) -> Result<Vec<ThreadInfo>, RtError> {
    let unreadable = |source: io::Error| RtError::Kernel { what: "reading /proc/PID/task", source };
    let mut list = Vec::new();
    let has_ended = |error: &io::Error| {
        error.kind() == io::ErrorKind::NotFound || error.raw_os_error() == Some(libc::ESRCH)
    };
    let entries = match fs::read_dir(format!("/proc/{pid}/task")) {
        Err(error) if has_ended(&error) => return Ok(list),
        entries => entries.map_err(unreadable)?,
    };
    for entry in entries {
        let entry = match entry {
            Err(error) if has_ended(&error) => break,
            entry => entry.map_err(unreadable)?,
        };
        let Some(tid) = entry.file_name().to_str().and_then(|name| name.parse().ok()) else { continue };
        let Ok(name) = fs::read_to_string(entry.path().join("comm")) else { continue };
        match (policy_of(tid), affinity_of(tid)) {
            (Ok(policy), Ok(cores)) => {
                list.push(ThreadInfo { tid, name: name.trim_end_matches('\n').to_owned(), policy, cores });
            }
            (Err(RtError::NoSuchThread { .. }), _) | (_, Err(RtError::NoSuchThread { .. })) => {}
            (Err(error), _) | (_, Err(error)) => return Err(error),
        }
    }
    Ok(list)
}

/// The form of a thread name that the kernel keeps: at most 15 bytes. A longer name keeps its first 6 and last 8
/// bytes with a `~` between, because topics differ at their ends: `cb:/lidar/front/points` is `cb:/li~t/points`.
pub fn short_name(name: &str) -> String {
    let name = name.replace('\0', "?");
    if name.len() <= 15 {
        return name;
    }
    let head = (0..=6).rev().find(|at| name.is_char_boundary(*at)).unwrap_or(0);
    let tail = (name.len() - 8..=name.len()).find(|at| name.is_char_boundary(*at)).unwrap_or(name.len());
    format!("{}~{}", &name[..head], &name[tail..])
}

fn panicked(name: String, payload: Option<Box<dyn Any + Send>>) -> RtError {
    let text = payload.as_deref().and_then(|payload| {
        payload
            .downcast_ref::<String>()
            .cloned()
            .or_else(|| payload.downcast_ref::<&str>().map(|s| (*s).to_owned()))
    });
    RtError::Panicked { name, message: text.unwrap_or_else(|| "(no message)".to_owned()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_names_are_shortened_visibly() {
        assert_eq!(short_name("cb:/imu"), "cb:/imu");
        assert_eq!(short_name("exactly15bytes_"), "exactly15bytes_");
        assert_eq!(short_name("cb:/lidar/front/points"), "cb:/li~t/points");
        assert_eq!(short_name("nul\0inside"), "nul?inside");
        for odd in ["ééééééééé", "cb:/ä€ö€ü€ß€x"] {
            assert!(short_name(odd).len() <= 15 && short_name(odd).contains('~'), "{}", short_name(odd));
        }
    }
}
