// SPDX-License-Identifier: MIT OR Apache-2.0
//! Publishing to a sampler that is awake, and taking, make no system call: a child does them in a thread to which the
//! kernel allows only read, write and exit, and kills otherwise (seccomp's strict mode).

mod support;

use std::os::fd::AsRawFd;
use std::os::unix::process::ExitStatusExt;
use support::{Count, Part};
use tautline_transport::{Limits, Participant, Qos};

const MESSAGES: u64 = 10_000;

/// The child's part; without its variable it is no test.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    let participant = Participant::new(domain).unwrap();
    let limits = Limits::default();
    let publisher = participant.create_publisher::<Count>("/quiet", Qos::default(), limits).unwrap();
    let subscription = participant.create_subscription::<Count>("/quiet", Qos::default(), limits).unwrap();
    let stdout = std::io::stdout().as_raw_fd();
    let work = move || {
        let mut sum = 0;
        let mut cycle = |n| {
            let mut loan = publisher.loan().unwrap();
            loan.n = n;
            loan.publish().unwrap();
            sum += subscription.take().unwrap().unwrap().n;
            if part == "sleeper" {
                // What the proof must notice.
                std::thread::yield_now();
            }
        };
        // Whatever is set up once is set up now.
        cycle(0);
        // SAFETY: from here on the thread calls nothing but what the test allows itself, or is killed.
        assert_eq!(unsafe { libc::prctl(libc::PR_SET_SECCOMP, libc::SECCOMP_MODE_STRICT) }, 0);
        (1..=MESSAGES).for_each(cycle);
        let text: &[u8] = if sum == MESSAGES * (MESSAGES + 1) / 2 { b"\npart: no system call\n" } else { b"\npart: wrong\n" };
        // SAFETY: the bytes live as long as the call; a thread in strict mode may write and leave by SYS_exit.
        unsafe {
            libc::write(stdout, text.as_ptr().cast(), text.len());
            libc::syscall(libc::SYS_exit, 0);
        }
    };
    // Not joined: it ends without a word to the library.
    let thread = std::thread::spawn(work);
    support::wait_for("the thread's end", || std::fs::read_dir("/proc/self/task").unwrap().count() == 3);
    drop(thread);
    // SAFETY: ends the process without running what expects that thread to have ended properly.
    unsafe { libc::_exit(0) };
}

fn run(part: &str, domain: u32) -> (Option<String>, std::process::ExitStatus) {
    let mut part = Part::start(part, domain);
    (part.hear_or_end(), part.wait())
}

#[test]
fn publish_and_take_make_no_system_call() {
    let (said, _) = run("publisher", 165);
    assert_eq!(said.as_deref(), Some("no system call"));
}

#[test]
fn the_proof_notices_a_system_call() {
    let (said, status) = run("sleeper", 166);
    assert_eq!((said, status.signal()), (None, Some(libc::SIGKILL)));
}
