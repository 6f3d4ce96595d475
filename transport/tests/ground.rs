// SPDX-License-Identifier: MIT OR Apache-2.0
//! What all of a domain stand on: looking at it costs nobody anything, and it holds at the limit of open files, with a full /dev/shm
//! and when somebody removes its files.

mod log;
mod support;

use std::collections::{BTreeMap, VecDeque};
use std::fs::File;
use std::io::Write;
use std::os::fd::AsRawFd;
use support::{
    Count, IMAGE_BYTES, Image, Part, clean, domain, folder, participants, publisher, say, shared_memory,
    subscription, take_all, wait_for, wait_for_some, wait_for_the_end,
};
use tautline_rt::clock::monotonic_ns;
use tautline_transport::{
    Claim, DoorbellError, GraphSnapshot, Limits, LoanError, Participant, Publisher, Qos, RawPublisher,
    RawSubscription, Subscription, TopicType, TransportError, graph_of,
};

const TEXT: &str = "test_msgs/msg/Text";

/// The child's part of the tests here; without its variable it is no test.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    match part.as_str() {
        "at its limit" => at_the_limit_of_open_files(domain),
        "removed" => removed(domain),
        "full" => match in_a_small_shm(4 << 20) {
            Ok(()) => full(domain),
            Err(reason) => say(&format!("skipped: {reason}")),
        },
        "no faults" => no_faults(domain),
        "looker" => {
            (0..100).for_each(|_| assert_eq!(topics(&graph_of(domain).unwrap()), ["/seen"]));
            say("looked");
        }
        other => panic!("no part {other}"),
    }
}

/// The topics that have publishers or subscriptions, each once.
fn topics(graph: &GraphSnapshot) -> Vec<String> {
    let mut topics: Vec<String> = graph.endpoints.iter().map(|end| end.topic.clone()).collect();
    topics.dedup();
    topics
}

// ---- Looking ----

/// What the files of a domain contain, without the pipe.
fn contents(domain: u32) -> BTreeMap<String, Vec<u8>> {
    let names = shared_memory(domain).into_keys().filter(|name| name != "warden");
    names.map(|name| (name.clone(), std::fs::read(folder(domain).join(name)).unwrap())).collect()
}

#[test]
fn two_hundred_lookers_take_no_seat_and_write_nothing() {
    let domain = domain(210);
    clean(domain);
    let participant = Participant::new(domain).unwrap();
    let first = publisher(&participant, "/seen", Qos::default());
    let before = contents(domain);
    std::thread::scope(|scope| {
        for _ in 0..20 {
            scope.spawn(|| (0..10).for_each(|_| assert_eq!(topics(&graph_of(domain).unwrap()), ["/seen"])));
        }
    });
    let mut looker = Part::start("looker", domain);
    assert_eq!(looker.hear(), "looked");
    assert!(looker.end().success());
    let changed: Vec<String> = contents(domain)
        .into_iter()
        .filter(|(name, bytes)| before.get(name) != Some(bytes))
        .map(|(name, _)| name)
        .collect();
    assert_eq!(changed, [""; 0]);
    // Whoever comes next has all that there was.
    let subscriptions = [(); 20].map(|()| subscription(&participant, "/seen", Qos::default()));
    let next = publisher(&participant, "/seen", Qos::default());
    for (n, publisher) in [&first, &next].into_iter().enumerate() {
        assert_eq!(publisher.subscription_count(), subscriptions.len());
        publisher.publish(&Count { n: n as u64 }).unwrap();
    }
    for subscription in &subscriptions {
        let mut taken = take_all(subscription);
        taken.sort();
        assert_eq!(taken, [0, 1]);
    }
}

#[test]
fn a_domain_that_nobody_is_in_stays_empty_however_often_it_is_looked_at() {
    let domain = domain(211);
    clean(domain);
    (0..200).for_each(|_| assert!(graph_of(domain).unwrap().endpoints.is_empty()));
    // That of this process's trace may be there.
    assert!(shared_memory(domain).into_keys().all(|name| name.starts_with("trace_")));
}

// ---- The limit of open files ----

#[test]
fn who_is_at_its_limit_of_open_files_gets_an_error_and_catches_up() {
    let domain = domain(212);
    clean(domain);
    let known = Participant::new(domain).unwrap();
    let go = publisher(&known, "/go", Qos::default());
    let mut part = Part::start("at its limit", domain);
    assert_eq!(part.hear(), "at its limit");
    // In a record that it has mapped, and in one that it cannot open.
    let _more = publisher(&known, "/more", Qos::default());
    let unknown = Participant::new(domain).unwrap();
    let kept = publisher(&unknown, "/kept", Qos::default().transient_local());
    let _plain = publisher(&unknown, "/plain", Qos::default());
    kept.publish(&Count { n: 7 }).unwrap();
    go.publish(&Count { n: 1 }).unwrap();
    assert_eq!(part.hear(), "refused, then [\"/go\", \"/kept\", \"/later\", \"/more\", \"/plain\"]");
    wait_for("its subscription", || kept.subscription_count() == 2);
    assert_eq!(part.hear(), "caught up");
    assert!(part.end().success());
}

fn limit_open_files(limit: u64) {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    setrlimit(Resource::Nofile, Rlimit { current: Some(limit), ..getrlimit(Resource::Nofile) }).unwrap();
}

fn at_the_limit_of_open_files(domain: u32) {
    let participant = Participant::new(domain).unwrap();
    let go = subscription(&participant, "/go", Qos::default());
    let kept = subscription(&participant, "/kept", Qos::default().transient_local());
    assert_eq!(topics(&participant.graph().unwrap()), ["/go", "/kept"]);
    // So that no file can be opened.
    let next_free = File::open("/dev/null").unwrap().as_raw_fd();
    limit_open_files(next_free as u64);
    assert!(File::open("/dev/null").is_err());
    say("at its limit");
    wait_for("word of what there is", || go.try_take().unwrap().is_some());
    for error in [participant.graph().unwrap_err(), graph_of(domain).map(drop).unwrap_err()] {
        assert!(error.to_string().contains("ulimit -n"), "{error}");
    }
    assert!(participant.topics().is_err() && participant.topic_type("/plain").is_err());
    // What is made now is connected later, too.
    let late = subscription(&participant, "/kept", Qos::default().transient_local());
    let later = publisher(&participant, "/later", Qos::default());
    limit_open_files(next_free as u64 + 100);
    say(&format!("refused, then {:?}", topics(&participant.graph().unwrap())));
    for subscription in [&kept, &late] {
        wait_for("what was kept", || take_all(subscription) == [7]);
    }
    drop(later);
    say("caught up");
    wait_for_the_end();
}

// ---- Silence ----

#[test]
fn whoever_no_longer_polls_by_itself_is_woken_for_what_comes_then() {
    let participant = Participant::new(domain(213)).unwrap();
    let subscription = subscription(&participant, "/quiet", Qos::default());
    let seat = participant.doorbell().claim_sampler().unwrap();
    let publisher = publisher(&participant, "/quiet", Qos::default());
    let (sender, receiver) = std::sync::mpsc::sync_channel(0);
    std::thread::scope(|scope| {
        scope.spawn(move || {
            for n in receiver {
                publisher.publish(&Count { n }).unwrap();
            }
        });
        for n in 0..2000 {
            subscription.as_ref().set_quiet(true);
            seat.drain(|_| {});
            sender.send(n).unwrap();
            subscription.as_ref().set_quiet(false);
            // Looks only when it was rung. The end is for a test that fails.
            let end_ns = monotonic_ns() + 30_000_000_000;
            let mut taken = None;
            while taken.is_none() {
                while seat.drain(|_| {}) == 0 {
                    seat.sleep(Some(end_ns));
                    assert!(monotonic_ns() < end_ns, "message {n}: nobody was woken");
                }
                taken = subscription.try_take().unwrap().map(|sample| sample.n);
            }
            assert_eq!(taken, Some(n));
        }
        drop(sender);
    });
}

// ---- Files that somebody removes ----

#[test]
fn a_file_that_somebody_removes_is_noticed_and_said() {
    // Whoever comes first looks after the others.
    for (number, is_first, is_killed) in
        [(214, true, false), (215, false, false), (214, true, true), (215, false, true)]
    {
        let domain = domain(number);
        clean(domain);
        let early = (!is_first).then(|| Participant::new(domain).unwrap());
        let mut part = Part::start("removed", domain);
        let file = part.hear();
        let participant = early.unwrap_or_else(|| Participant::new(domain).unwrap());
        let ends = meet(&participant);
        std::fs::remove_file(folder(domain).join(file)).unwrap();
        assert_eq!(part.hear(), "noticed and said");
        // What is connected stays so, until it ends, or dies, like any other.
        exchange(&ends);
        match is_killed {
            true => part.kill(),
            false => assert!(part.end().success()),
        }
        let (out, back) = &ends;
        wait_for("its end", || (out.subscription_count(), back.publisher_count()) == (0, 0));
        drop((ends, participant));
        clean(domain);
    }
}

/// As systemd-logind does when a user logs out.
#[test]
fn a_domain_that_somebody_removes_goes_on_for_those_in_it_and_begins_anew() {
    let domain = domain(216);
    clean(domain);
    let participant = Participant::new(domain).unwrap();
    let mut part = Part::start("removed", domain);
    part.hear();
    let ends = meet(&participant);
    // A participant whose file was removed and whose domain is still there makes another one.
    wait_for("an empty folder", || std::fs::remove_dir_all(folder(domain)).is_ok());
    assert_eq!(part.hear(), "noticed and said");
    exchange(&ends);
    let anew = Participant::new(domain).unwrap();
    assert!(topics(&anew.graph().unwrap()).is_empty());
    // The warden of those that were there ends. Who is left cannot take its place, and rests.
    drop((ends, participant));
    wait_for("its warden to rest", || (0..100).all(|_| is_at_rest(&part, "warden")));
    assert!(part.end().success());
    assert_eq!(participants(domain).len(), 1, "of who began anew");
    drop(anew);
    clean(domain);
}

/// Whether a thread of the child sleeps.
fn is_at_rest(part: &Part, thread: &str) -> bool {
    std::thread::yield_now();
    let threads = std::fs::read_dir(format!("/proc/{}/task", part.pid())).unwrap();
    let stats = threads.map(|thread| std::fs::read_to_string(thread.unwrap().path().join("stat")).unwrap());
    let own = stats.into_iter().find(|stat| stat.contains(thread)).unwrap();
    own.rsplit_once(") ").unwrap().1.starts_with('S')
}

/// The parent's ends of topics, connected to the child's.
fn meet(participant: &Participant) -> (Publisher<Count>, Subscription<Count>) {
    let out = publisher(participant, "/out", Qos::default());
    let back = subscription(participant, "/back", Qos::default());
    wait_for("the child", || (out.subscription_count(), back.publisher_count()) == (1, 1));
    (out, back)
}

fn exchange((out, back): &(Publisher<Count>, Subscription<Count>)) {
    out.publish(&Count { n: 5 }).unwrap();
    wait_for("what the child sends back", || take_all(back) == [5]);
}

fn removed(domain: u32) {
    let log = log::of_process();
    let before = participants(domain);
    let participant = Participant::new(domain).unwrap();
    let own = participants(domain).into_iter().find(|name| !before.contains(name)).unwrap();
    let out = subscription(&participant, "/out", Qos::default());
    let back = publisher(&participant, "/back", Qos::default());
    say(&own);
    let said =
        || log.lines().iter().filter(|line| line.contains(&own) && line.contains("RemoveIPC=no")).count();
    wait_for("a word on it", || said() != 0);
    say("noticed and said");
    let taken = wait_for_some("a message", || out.try_take().unwrap());
    back.publish(&taken).unwrap();
    drop(taken);
    wait_for_the_end();
    assert_eq!(said(), 1, "once");
}

// ---- Memory ----

#[test]
fn a_full_dev_shm_is_an_error_and_kills_nobody() {
    let mut part = Part::start("full", 217);
    let said = part.hear();
    if said.starts_with("skipped") {
        assert!(std::env::var_os("CI").is_none(), "{said}");
        println!("{said}");
        return;
    }
    assert_eq!(said, "survived");
    assert!(part.end().success());
}

/// Gives this process a /dev/shm of its own, of so many bytes.
fn in_a_small_shm(bytes: u64) -> Result<(), String> {
    let done = |result: i32, what: &str| match result {
        0 => Ok(()),
        _ => Err(format!("{what}: {}", std::io::Error::last_os_error())),
    };
    let (none, tmpfs) = (std::ptr::null(), c"tmpfs".as_ptr());
    let size = std::ffi::CString::new(format!("size={bytes},mode=1777")).unwrap();
    // SAFETY: the strings live as long as the calls, which change what this process sees of file systems.
    unsafe {
        done(libc::unshare(libc::CLONE_NEWNS), "unshare")?;
        let private = libc::MS_REC | libc::MS_PRIVATE;
        done(libc::mount(none, c"/".as_ptr(), none, private, none.cast()), "mount of /")?;
        done(libc::mount(tmpfs, c"/dev/shm".as_ptr(), tmpfs, 0, size.as_ptr().cast()), "mount of /dev/shm")
    }
}

fn full(domain: u32) {
    let [here, there] = [(); 2].map(|()| Participant::new(domain).unwrap());
    let image = || here.create_publisher::<Image>("/image", Qos::default(), Limits::default()).map(drop);
    let error = image().unwrap_err();
    assert!(matches!(error, TransportError::Memory { .. }), "{error}");
    assert!(
        [&IMAGE_BYTES.to_string()[..2], "/image", "/dev/shm"]
            .iter()
            .all(|part| error.to_string().contains(part))
    );

    let small = Limits { message_bytes: 64, ..Limits::default() };
    let texts =
        |topic: &str, limits| here.create_raw_publisher(topic, &TopicType::new(TEXT), Qos::default(), limits);
    let takes = |participant: &Participant, topic: &str, depth| {
        let qos = Qos::keep_last(depth);
        participant.create_raw_subscription(topic, &TopicType::new(TEXT), qos, small)
    };
    let publisher = texts("/text", small).unwrap();
    let subscriptions = [&here, &there].map(|participant| takes(participant, "/text", 10).unwrap());
    let exchange = || {
        publisher.publish(b"it works").unwrap();
        assert!(subscriptions.iter().all(|subscription| is_next(subscription, b"it works")));
    };
    exchange();
    let on_use = texts("/on_use", Limits { claim: Claim::OnUse, ..small }).unwrap();
    let of_on_use = takes(&here, "/on_use", 10).unwrap();
    assert_eq!(publisher.loan(3 << 20).err(), Some(LoanError::OutOfMemory));
    exchange();
    // As many publishers as there is memory for.
    let large = Limits { message_bytes: 100_000, ..small };
    let (mut more, mut error) = (Vec::new(), None);
    while error.is_none() {
        texts("/more", large).map_or_else(|refused| error = Some(refused), |publisher| more.push(publisher));
    }
    assert!(!more.is_empty() && matches!(error, Some(TransportError::Memory { .. })), "{error:?}");
    exchange();

    // Until not a byte is left.
    let filler = std::path::Path::new("/dev/shm/filler");
    let mut file = File::create(filler).unwrap();
    while file.write(&[1; 4096]).is_ok() {}
    assert!(on_use.publish(b"first").is_err() && texts("/text", small).is_err());
    assert!(Participant::new(domain).is_err() && image().is_err());
    let mut slots = Vec::new();
    let error = loop {
        match here.claim_slot() {
            Ok(slot) => slots.push(slot),
            Err(error) => break error,
        }
    };
    assert!(matches!(error, TransportError::Doorbell(DoorbellError::Memory { .. })), "{error}");
    // The publisher's process has no memory for it.
    let late = takes(&there, "/text", 5000).unwrap();
    (0..1000).for_each(|_| exchange());
    assert_eq!(publisher.subscription_count(), 2);

    std::fs::remove_file(filler).unwrap();
    drop((file, more));
    wait_for("the late one", || publisher.subscription_count() == 3);
    exchange();
    assert!(is_next(&late, b"it works"));
    on_use.publish(b"first").unwrap();
    assert!(is_next(&of_on_use, b"first"));
    assert!(here.claim_slot().is_ok() && Participant::new(domain).is_ok() && texts("/more", large).is_ok());
    say("survived");
}

/// Whether these bytes come next, perhaps in a moment.
fn is_next(subscription: &RawSubscription, bytes: &[u8]) -> bool {
    wait_for_some("a sample", || subscription.try_take().unwrap()).body() == bytes
}

#[test]
fn what_was_claimed_ahead_faults_no_page() {
    let mut part = Part::start("no faults", 218);
    assert_eq!(part.hear(), "[0, 0]", "in one participant, and from one to another");
    assert!(part.end().success());
    clean(218);
}

/// Page faults of this thread so far.
fn faults() -> i64 {
    // SAFETY: all zeros are a rusage, which the call fills in.
    unsafe {
        let mut usage = std::mem::zeroed::<libc::rusage>();
        assert_eq!(libc::getrusage(libc::RUSAGE_THREAD, &raw mut usage), 0);
        usage.ru_minflt + usage.ru_majflt
    }
}

const MESSAGE_BYTES: usize = 50_000;
const DEPTH: usize = 7;
const HELD: usize = 5;
const LIMITS: Limits = Limits { held: HELD, loans: 2, message_bytes: MESSAGE_BYTES, ..support::LIMITS };

fn no_faults(domain: u32) {
    let text = TopicType::new(TEXT);
    let mut counted = Vec::new();
    for is_elsewhere in [false, true] {
        // With others before: code and stack, and what holds samples, are touched by then.
        let mut held = VecDeque::with_capacity(HELD);
        let mut count = || {
            let [here, there] = [(); 2].map(|()| Participant::new(domain).unwrap());
            let publisher = here.create_raw_publisher("/faults", &text, Qos::default(), LIMITS).unwrap();
            let (qos, subscriber) = (Qos::keep_last(DEPTH), if is_elsewhere { &there } else { &here });
            let subscription = subscriber.create_raw_subscription("/faults", &text, qos, LIMITS).unwrap();
            wait_for("both", || (publisher.subscription_count(), subscription.publisher_count()) == (1, 1));
            let before = faults();
            use_all((&publisher, &subscription), &mut held);
            faults() - before
        };
        count();
        counted.push(count());
    }
    say(&format!("{counted:?}"));
}

/// Goes through all samples and all places of the queues, filling and reading each to its last byte.
fn use_all(
    (publisher, subscription): (&RawPublisher, &RawSubscription),
    held: &mut VecDeque<tautline_transport::RawSample>,
) {
    for n in 0..20 * DEPTH {
        for _ in 0..=DEPTH {
            let mut loans = [(); 2].map(|()| publisher.loan(MESSAGE_BYTES).unwrap());
            loans.each_mut().into_iter().for_each(|loan| loan.fill(n as u8));
            let [loan, unused] = loans;
            drop(unused);
            loan.publish().unwrap();
        }
        while let Some(sample) = {
            if held.len() == HELD {
                held.pop_front();
            }
            subscription.try_take().unwrap()
        } {
            assert!(sample.body().iter().all(|byte| *byte == n as u8));
            held.push_back(sample);
        }
    }
    held.clear();
}
