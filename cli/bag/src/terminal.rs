// SPDX-License-Identifier: MIT OR Apache-2.0
//! Lines that the user types while a verb runs.

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::getpgrp;
use rustix::termios::tcgetpgrp;
use std::io::{self, IsTerminal};
use std::time::Duration;

/// The maximum length of a line.
const LONGEST: usize = 4096;
const POLL_INTERVAL: Duration = Duration::from_millis(200);

/// Calls `handle` for each line that is typed at the terminal, if standard input is one. Reads only while this process is in the
/// foreground, because the kernel stops a background process that reads from its terminal.
pub fn on_line(mut handle: impl FnMut(&str) + Send + 'static) {
    let stdin = io::stdin();
    if !stdin.is_terminal() {
        return;
    }
    std::thread::spawn(move || {
        let wait = Timespec { tv_sec: 0, tv_nsec: POLL_INTERVAL.subsec_nanos().into() };
        let (mut bytes, mut typed) = ([0; 256], Vec::new());
        loop {
            // If this is not the process's own terminal, the call fails, and reading does not stop the process.
            if tcgetpgrp(&stdin).is_ok_and(|foreground| foreground != getpgrp()) {
                std::thread::sleep(POLL_INTERVAL);
                continue;
            }
            let mut ready = [PollFd::new(&stdin, PollFlags::IN)];
            if !poll(&mut ready, Some(&wait)).is_ok_and(|ready| ready > 0) {
                continue;
            }
            match rustix::io::read(&stdin, &mut bytes) {
                Ok(read @ 1..) => typed.extend_from_slice(&bytes[..read]),
                Err(rustix::io::Errno::INTR) => {}
                // The terminal was closed.
                _ => return,
            }
            while let Some(end) = typed.iter().position(|byte| *byte == b'\n') {
                let line: Vec<u8> = typed.drain(..=end).collect();
                handle(String::from_utf8_lossy(&line).trim_end());
            }
            typed.truncate(LONGEST);
        }
    });
}
