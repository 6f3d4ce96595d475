// SPDX-License-Identifier: MIT OR Apache-2.0
//! The signals that ask a process to end.

use libc::c_int;
use std::mem::MaybeUninit;
use std::ptr;

/// The signals that a program handles to end in order: SIGINT, SIGTERM, and SIGHUP, which a process gets when its terminal closes. SIGHUP
/// is left out if the process was started with SIGHUP ignored, as `nohup` does it: then the program goes on.
///
/// Call this before the program installs handlers: a handler replaces the inherited setting.
pub fn termination_signals() -> impl Iterator<Item = c_int> {
    let hangup = (!is_ignored(libc::SIGHUP)).then_some(libc::SIGHUP);
    [libc::SIGINT, libc::SIGTERM].into_iter().chain(hangup)
}

fn is_ignored(signal: c_int) -> bool {
    let mut action = MaybeUninit::<libc::sigaction>::uninit();
    // SAFETY: no new action is given, and the pointer is valid for a write.
    let result = unsafe { libc::sigaction(signal, ptr::null(), action.as_mut_ptr()) };
    // SAFETY: the call has written the action if it returned 0.
    result == 0 && unsafe { action.assume_init() }.sa_sigaction == libc::SIG_IGN
}
