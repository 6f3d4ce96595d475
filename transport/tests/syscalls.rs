// SPDX-License-Identifier: MIT OR Apache-2.0
//! Publishing to a sampler that is awake, and taking, make no system call: a child does them in a thread that the kernel
//! kills for any call but write and exit. (A seccomp filter: seccomp's strict mode would also forbid to read the clock's
//! counter.)

mod support;

use std::os::fd::AsRawFd;
use std::time::Duration;
use support::{Count, Part, clean, wait_for};
use tautline_transport::{Limits, Liveliness, Participant, Qos, TopicType};

const MESSAGES: u64 = 10_000;

/// The child's part; without its variable it is no test.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    if part == "traced" {
        tautline_trace::configure(tautline_trace::TraceMode::On.into());
    }
    let participant = Participant::new(domain).unwrap();
    let limits = Limits::default();
    // With all that costs something on the way.
    let hour = Some(Duration::from_secs(3600));
    let (deadline, lifespan, liveliness_lease_duration) = (hour, hour, hour);
    let liveliness = Liveliness::ManualByTopic;
    let qos = Qos { deadline, lifespan, liveliness, liveliness_lease_duration, ..Qos::default() };
    let publisher = participant.create_publisher::<Count>("/quiet", qos, limits).unwrap();
    let subscription = participant.create_subscription::<Count>("/quiet", qos, limits).unwrap();
    let (text, larger) = (TopicType::new("test_msgs/msg/Text"), Limits { message_bytes: 5000, ..limits });
    let texts = participant.create_raw_publisher("/text", &text, Qos::default(), larger).unwrap();
    let taken = participant.create_raw_subscription("/text", &text, Qos::default(), larger).unwrap();
    let stdout = std::io::stdout().as_raw_fd();
    let member = participant.clone();
    let work = move || {
        let mut sum = 0;
        let mut cycle = |n| {
            let mut loan = publisher.loan().unwrap();
            loan.n = n;
            loan.publish().unwrap();
            publisher.assert_liveliness();
            // As a request with a time limit does.
            drop(member.claim_slot().unwrap());
            let mut loan = texts.loan(n as usize % 5000).unwrap();
            loan.fill(1);
            loan.publish().unwrap();
            assert_eq!(taken.try_take().unwrap().unwrap().body().len(), n as usize % 5000);
            sum += subscription.try_take().unwrap().unwrap().n;
            if part == "yielder" {
                // What the proof must notice.
                std::thread::yield_now();
            }
        };
        tautline_trace::register_thread();
        // Whatever is set up once is set up now.
        cycle(0);
        forbid_system_calls();
        (1..=MESSAGES).for_each(cycle);
        let text: &[u8] = if sum == MESSAGES * (MESSAGES + 1) / 2 {
            b"\npart: no system call\n"
        } else {
            b"\npart: wrong\n"
        };
        // SAFETY: the bytes live as long as the call; the thread may write, and leave by SYS_exit.
        unsafe {
            libc::write(stdout, text.as_ptr().cast(), text.len());
            libc::syscall(libc::SYS_exit, 0);
        }
    };
    let threads = || std::fs::read_dir("/proc/self/task").unwrap().count();
    let before = threads();
    // Never joined: it ends, or is killed, without a word to the library.
    let _thread = std::thread::spawn(work);
    wait_for("the thread's end", || threads() == before);
    // SAFETY: ends the process without running what expects that thread to have ended properly.
    unsafe { libc::_exit(0) };
}

/// Kills this thread when it makes a system call other than write and exit.
fn forbid_system_calls() {
    let step = |code: u32, k: u32, jt: u8, jf: u8| libc::sock_filter { code: code as u16, jt, jf, k };
    let is = libc::BPF_JMP | libc::BPF_JEQ | libc::BPF_K;
    let end = libc::BPF_RET | libc::BPF_K;
    // The call's number is the first word of what a filter sees.
    let mut steps = [
        step(libc::BPF_LD | libc::BPF_W | libc::BPF_ABS, 0, 0, 0),
        step(is, libc::SYS_write as u32, 2, 0),
        step(is, libc::SYS_exit as u32, 1, 0),
        step(end, libc::SECCOMP_RET_KILL_THREAD, 0, 0),
        step(end, libc::SECCOMP_RET_ALLOW, 0, 0),
    ];
    let filter = libc::sock_fprog { len: steps.len() as u16, filter: steps.as_mut_ptr() };
    // SAFETY: both calls read their arguments and change what this thread may do; the filter lives as long as the call.
    unsafe {
        assert_eq!(libc::prctl(libc::PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0), 0);
        assert_eq!(libc::prctl(libc::PR_SET_SECCOMP, libc::SECCOMP_MODE_FILTER, &raw const filter), 0);
    }
}

#[test]
fn publish_and_take_make_no_system_call() {
    assert_eq!(Part::start("publisher", 165).hear(), "no system call");
    clean(165);
}

#[test]
fn tracing_adds_none() {
    assert_eq!(Part::start("traced", 189).hear(), "no system call");
    // Two messages a cycle, each published and taken.
    assert_eq!(support::traced(189), 4 * (MESSAGES as usize + 1));
    clean(189);
}

#[test]
fn the_proof_notices_a_system_call() {
    assert_eq!(Part::start("yielder", 166).hear_or_end(), None);
    clean(166);
}
