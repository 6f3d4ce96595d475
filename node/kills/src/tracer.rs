// SPDX-License-Identifier: MIT OR Apache-2.0
//! Stops a process before and after each system call of any of its threads, counts the calls, and kills or stalls it at a given point.

use crate::Result;
use libc::{c_int, c_long, c_void, pid_t};
use rand::RngExt;
use rand::rngs::SmallRng;
use std::collections::BTreeSet;
use std::io;
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

/// The time at a system call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum When {
    Before,
    /// After the call, before any other instruction.
    After,
    /// This long after the call, whatever its threads do then.
    Soon(Duration),
    /// The process is not killed, but stalled for longer than any of its waits for another process.
    Stall,
}

/// Longer than a process that joins a domain waits for one that removes it.
const STALL: Duration = Duration::from_millis(2500);

/// The number of a system call among all of a process, of any of its threads, from 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Point {
    pub call: usize,
    pub when: When,
}

impl Point {
    pub fn soon(random: &mut SmallRng) -> When {
        When::Soon(Duration::from_nanos(random.random_range(0..60_000)))
    }
}

/// How the process ended.
#[derive(Clone, Debug)]
pub struct End {
    /// Number of system calls that it made.
    pub calls: usize,
    /// Whether it was killed at the point.
    pub is_killed: bool,
    /// Whether it was stalled at the point.
    pub is_stalled: bool,
    /// Its exit code, if it ended by itself.
    pub code: Option<i32>,
    /// When its end was detected.
    pub at: Instant,
    /// The kernel's number of the system call at which it was killed.
    pub number: Option<u64>,
}

/// Traces a child process, which waits and has one thread, until it ends. Signals `started` when tracing has begun. Kills it at `point`.
pub fn follow(pid: u32, mut point: Option<Point>, started: &Sender<()>) -> Result<End> {
    let pid = pid_t::try_from(pid)?;
    let options = libc::PTRACE_O_TRACESYSGOOD | libc::PTRACE_O_TRACECLONE | libc::PTRACE_O_EXITKILL;
    ptrace(libc::PTRACE_SEIZE, pid, options as usize)?;
    ptrace(libc::PTRACE_INTERRUPT, pid, 0)?;
    started.send(())?;
    let mut within = BTreeSet::new();
    let mut end =
        End { calls: 0, is_killed: false, is_stalled: false, code: None, at: Instant::now(), number: None };
    loop {
        let (thread, status) = wait()?;
        if libc::WIFEXITED(status) || libc::WIFSIGNALED(status) {
            within.remove(&thread);
            if thread == pid {
                end.code = libc::WIFEXITED(status).then(|| libc::WEXITSTATUS(status));
                end.at = Instant::now();
                return Ok(end);
            }
            continue;
        }
        if end.is_killed {
            // The thread ends by itself.
            continue;
        }
        let (signal, event) = (libc::WSTOPSIG(status), status >> 16);
        if signal == libc::SIGTRAP | 0x80 {
            let is_entry = within.insert(thread);
            if is_entry {
                end.calls += 1;
            } else {
                within.remove(&thread);
            }
            // A point after a call is found at the exit of the last call, whichever thread makes the next one.
            let is_there =
                |point: &Point| point.call == end.calls && is_entry == (point.when == When::Before);
            let Some(point) = point.take_if(|point| is_there(point)) else {
                resume(thread, 0)?;
                continue;
            };
            end.number = number(thread);
            if point.when == When::Stall {
                std::thread::sleep(STALL);
                resume(thread, 0)?;
                end.is_stalled = true;
                continue;
            }
            if let When::Soon(time) = point.when {
                resume(thread, 0)?;
                let start = Instant::now();
                while start.elapsed() < time {
                    std::hint::spin_loop();
                }
            }
            end.is_killed = true;
            // SAFETY: a signal to a child that was not waited for.
            unsafe { libc::kill(pid, libc::SIGKILL) };
            continue;
        }
        // Without an event it is a signal for the process itself.
        resume(thread, if event == 0 { signal } else { 0 })?;
    }
}

fn resume(thread: pid_t, signal: c_int) -> Result<()> {
    match ptrace(libc::PTRACE_SYSCALL, thread, signal as usize) {
        // The thread is being killed.
        Err(error) if error.raw_os_error() == Some(libc::ESRCH) => Ok(()),
        other => Ok(other?),
    }
}

/// The next event of any thread that this thread traces.
fn wait() -> io::Result<(pid_t, c_int)> {
    let mut status = 0;
    loop {
        // SAFETY: writes the status, which is there.
        let thread = unsafe { libc::waitpid(-1, &raw mut status, libc::__WALL | libc::__WNOTHREAD) };
        if thread >= 0 {
            return Ok((thread, status));
        }
        let error = io::Error::last_os_error();
        if error.kind() != io::ErrorKind::Interrupted {
            return Err(error);
        }
    }
}

/// The number of the system call that a stopped thread is in.
fn number(thread: pid_t) -> Option<u64> {
    let text = std::fs::read_to_string(format!("/proc/{thread}/syscall")).ok()?;
    text.split(' ').next()?.parse().ok()
}

fn ptrace(request: libc::c_uint, pid: pid_t, data: usize) -> io::Result<()> {
    // SAFETY: these requests read and write no memory of this process.
    let result: c_long =
        unsafe { libc::ptrace(request as _, pid, std::ptr::null_mut::<c_void>(), data as *mut c_void) };
    if result == -1 { Err(io::Error::last_os_error()) } else { Ok(()) }
}
