// SPDX-License-Identifier: MIT OR Apache-2.0
//! Programs that a test starts end with it, whatever becomes of it.

use rustix::process::{Signal, set_parent_process_death_signal};
use std::os::unix::process::CommandExt;
use std::process::Command;

/// Whose parent is the thread that starts it: when that ends, also by a panic, this is asked to end.
pub fn ends_with_test(command: &mut Command) {
    // SAFETY: one system call between fork and exec.
    unsafe { command.pre_exec(|| Ok(set_parent_process_death_signal(Some(Signal::TERM))?)) };
}
