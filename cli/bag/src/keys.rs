// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is typed while a verb does something else.

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::getpgrp;
use rustix::termios::tcgetpgrp;
use std::io::{self, IsTerminal};
use std::time::Duration;

/// No word is longer.
const LONGEST: usize = 4096;
/// How often is looked whether there is somebody.
const LOOK: Duration = Duration::from_millis(200);

/// Each line that is typed at the terminal, if there is one, while this process is in its foreground: one in the background that read
/// from it would be stopped.
pub fn lines(mut hear: impl FnMut(&str) + Send + 'static) {
    let stdin = io::stdin();
    if !stdin.is_terminal() {
        return;
    }
    std::thread::spawn(move || {
        let wait = Timespec { tv_sec: 0, tv_nsec: LOOK.subsec_nanos().into() };
        let (mut bytes, mut typed) = ([0; 256], Vec::new());
        loop {
            // What is not its own terminal stops nobody.
            if tcgetpgrp(&stdin).is_ok_and(|foreground| foreground != getpgrp()) {
                std::thread::sleep(LOOK);
                continue;
            }
            let mut ready = [PollFd::new(&stdin, PollFlags::IN)];
            if !poll(&mut ready, Some(&wait)).is_ok_and(|ready| ready > 0) {
                continue;
            }
            match rustix::io::read(&stdin, &mut bytes) {
                Ok(read @ 1..) => typed.extend_from_slice(&bytes[..read]),
                Err(rustix::io::Errno::INTR) => {}
                // The terminal is gone.
                _ => return,
            }
            while let Some(end) = typed.iter().position(|byte| *byte == b'\n') {
                let line: Vec<u8> = typed.drain(..=end).collect();
                hear(String::from_utf8_lossy(&line).trim_end());
            }
            typed.truncate(LONGEST);
        }
    });
}
