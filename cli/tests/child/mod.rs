// SPDX-License-Identifier: MIT OR Apache-2.0
//! Programs that a test starts end with it, whatever becomes of it; how they are signalled and waited for.

use rustix::process::{Signal, set_parent_process_death_signal};
use std::os::unix::process::CommandExt;
use std::process::{Child, Command};
use tautline_rt::clock::monotonic_ns;

/// Whose parent is the thread that starts it: when that ends, also by a panic, this is asked to end.
pub fn ends_with_test(command: &mut Command) {
    // SAFETY: one system call between fork and exec.
    unsafe { command.pre_exec(|| Ok(set_parent_process_death_signal(Some(Signal::TERM))?)) };
}

/// Sends a signal by its name, such as `-INT`.
pub fn signal(child: &Child, name: &str) {
    assert!(Command::new("kill").args([name, &child.id().to_string()]).status().unwrap().success());
}

/// Waits for what a program does; a test that would hang fails after a minute instead.
pub fn wait_for(what: &str, mut is_so: impl FnMut() -> bool) {
    let start_ns = monotonic_ns();
    while !is_so() {
        assert!(monotonic_ns() - start_ns < 60_000_000_000, "waited for {what} for a minute");
        std::thread::yield_now();
    }
}
