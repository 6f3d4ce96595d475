// SPDX-License-Identifier: MIT OR Apache-2.0
//! Publishing to a sampler that is awake, and taking, make no system call: a child does them in a thread that the kernel
//! kills for any call but write and exit. (A seccomp filter: seccomp's strict mode would also forbid to read the clock's
//! counter.) A server takes and answers in such a thread, too, whoever comes and dies meanwhile; it may wake who sleeps.

mod support;

use futures::FutureExt;
use std::os::fd::AsRawFd;
use std::time::Duration;
use support::{Count, Part, clean, domain, say, wait_for};
use tautline_transport::{
    Limits, Liveliness, Participant, Qos, RawClient, RequestId, ServiceError, ServiceType, TopicType,
};

const MESSAGES: u64 = 10_000;

/// The child's part; without its variable it is no test.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    if part == "traced" {
        tautline_trace::configure(tautline_trace::TraceMode::On.into());
    }
    let participant = Participant::new(domain).unwrap();
    match part.as_str() {
        "server" => in_a_confined_thread(serve(&participant)),
        "client" => {
            let client = client(&participant);
            (0..20).for_each(|_| drop(ask(&client, b"?").unwrap()));
            say("asked");
            // Until it is killed, or has nobody to ask.
            while ask(&client, b"?").is_ok() {}
        }
        _ => in_a_confined_thread(publish_and_take(&participant, part)),
    }
}

/// Work that is done twice: what is set up once is set up the first time, and the second time there is no system call, but to wake
/// who sleeps, if that is allowed. It says whether all was well.
type Work = (Box<dyn FnMut() -> bool + Send>, bool);

fn publish_and_take(participant: &Participant, part: String) -> Work {
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
    // A tool looks on, and takes nothing.
    let observer = participant.create_observer("/quiet", &TopicType::of::<Count>(), 4, limits).unwrap();
    let member = participant.clone();
    let (mut sum, mut is_set_up) = (0, false);
    let work = move || {
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
        if !std::mem::replace(&mut is_set_up, true) {
            cycle(0);
            return true;
        }
        (1..=MESSAGES).for_each(cycle);
        assert!(observer.has_samples());
        sum == MESSAGES * (MESSAGES + 1) / 2
    };
    (Box::new(work), false)
}

/// Answers all, until somebody says stop.
fn serve(participant: &Participant) -> Work {
    let service_type = ServiceType::new("test_srvs/srv/Bytes", None);
    let server = participant.create_raw_server("/quiet", &service_type, 10, Limits::default()).unwrap();
    let mut is_set_up = false;
    let work = move || {
        let is_first = !std::mem::replace(&mut is_set_up, true);
        loop {
            let Some(request) = server.try_take().unwrap() else {
                std::hint::spin_loop();
                continue;
            };
            match server.loan(RequestId::of(request.info()), 1) {
                Ok(mut response) => {
                    response.fill(b'!');
                    let sent = response.send().map_err(|unsent| unsent.error);
                    assert!(matches!(sent, Ok(()) | Err(ServiceError::ClientGone { .. })), "{sent:?}");
                }
                Err(ServiceError::ClientGone { .. }) => {}
                Err(other) => panic!("{other}"),
            }
            if is_first || request.body() == b"stop" {
                return true;
            }
        }
    };
    (Box::new(work), true)
}

fn client(participant: &Participant) -> RawClient {
    let service_type = ServiceType::new("test_srvs/srv/Bytes", None);
    let client = participant.create_raw_client("/quiet", &service_type, Limits::default()).unwrap();
    wait_for("the server", || client.server_count() == 1);
    client
}

/// Asks, and polls until there is an answer: nobody sleeps who would have to be woken.
fn ask(client: &RawClient, body: &[u8]) -> Result<Vec<u8>, ServiceError> {
    let mut loan = client.loan(body.len())?;
    loan.copy_from_slice(body);
    let mut pending = client.send(loan)?;
    loop {
        if let Some(answer) = (&mut pending).now_or_never() {
            return Ok(answer?.body().to_owned());
        }
        std::thread::yield_now();
    }
}

/// Does the work in a thread that is killed for a system call, and ends the process.
fn in_a_confined_thread((mut work, may_wake): Work) {
    let stdout = std::io::stdout().as_raw_fd();
    let work = move || {
        tautline_trace::register_thread();
        assert!(work());
        say("set up");
        forbid_system_calls(may_wake);
        let text: &[u8] = if work() { b"\npart: no system call\n" } else { b"\npart: wrong\n" };
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

/// Kills this thread when it makes a system call other than write and exit, and to wake who sleeps on a futex if it `may_wake`.
fn forbid_system_calls(may_wake: bool) {
    let step = |code: u32, k: u32, jt: u8, jf: u8| libc::sock_filter { code: code as u16, jt, jf, k };
    let is = libc::BPF_JMP | libc::BPF_JEQ | libc::BPF_K;
    let end = libc::BPF_RET | libc::BPF_K;
    let load = libc::BPF_LD | libc::BPF_W | libc::BPF_ABS;
    // A call that there is none of.
    let futex = if may_wake { libc::SYS_futex as u32 } else { u32::MAX };
    // The call's number is the first word of what a filter sees; the second argument begins at byte 24.
    let mut steps = [
        step(load, 0, 0, 0),
        step(is, libc::SYS_write as u32, 6, 0),
        step(is, libc::SYS_exit as u32, 5, 0),
        step(is, futex, 0, 3),
        step(load, 24, 0, 0),
        step(libc::BPF_ALU | libc::BPF_AND | libc::BPF_K, libc::FUTEX_CMD_MASK as u32, 0, 0),
        step(is, libc::FUTEX_WAKE as u32, 1, 0),
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

/// What a child says once it is set up.
fn heard(mut part: Part) -> Option<String> {
    assert_eq!(part.hear(), "set up");
    part.hear_or_end()
}

#[test]
fn publish_and_take_make_no_system_call() {
    assert_eq!(heard(Part::start("publisher", 165)).unwrap(), "no system call");
    clean(165);
}

#[test]
fn a_server_makes_none_while_clients_come_and_are_killed() {
    let domain = domain(183);
    let server = Part::start("server", domain);
    let participant = Participant::new(domain).unwrap();
    let client = client(&participant);
    // Before it is confined.
    assert_eq!(ask(&client, b"?").unwrap(), b"!");
    for _ in 0..10 {
        let mut others = [(); 2].map(|()| Part::start("client", domain));
        others.iter_mut().for_each(|other| assert_eq!(other.hear(), "asked"));
        assert_eq!(ask(&client, b"?").unwrap(), b"!");
        others.into_iter().for_each(Part::kill);
    }
    assert_eq!(ask(&client, b"stop").unwrap(), b"!");
    assert_eq!(heard(server).unwrap(), "no system call");
    drop((client, participant));
    clean(domain);
}

#[test]
fn tracing_adds_none() {
    assert_eq!(heard(Part::start("traced", 189)).unwrap(), "no system call");
    // Two messages a cycle, each published and taken.
    assert_eq!(support::traced(189), 4 * (MESSAGES as usize + 1));
    clean(189);
}

#[test]
fn the_proof_notices_a_system_call() {
    assert_eq!(heard(Part::start("yielder", 166)), None);
    clean(166);
}
