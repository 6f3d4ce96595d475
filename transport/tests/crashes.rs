// SPDX-License-Identifier: MIT OR Apache-2.0
//! Processes killed at any instant: others go on and lose nothing of theirs, and what the dead left is removed.

mod support;

use support::{
    Count, Part, claimed, clean, domain, participants, say, shared_memory, take_all, wait_for,
    wait_for_the_end,
};
use tautline_transport::{Limits, Participant, PublishError, Publisher, Qos, SendError, Subscription};

const CYCLES: usize = 20;
const OURS: u64 = 1_000_000;

/// The child's part; without its variable it is no test.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    let participant = Participant::new(domain).unwrap();
    match part.as_str() {
        "publisher" => {
            let publisher = new_publisher(&participant, Qos::keep_last(100));
            // The loans are out when it is killed.
            let _loans = [publisher.loan().unwrap(), publisher.loan().unwrap()];
            say("ready");
            let parent = rustix::process::getppid();
            while rustix::process::getppid() == parent {
                publisher.publish(&Count { n: 1 }).unwrap();
                std::thread::yield_now();
            }
        }
        "subscription" => {
            let subscription = new_subscription(&participant, Qos::keep_last(100));
            let mut held = Vec::new();
            wait_for("samples to hold", || {
                held.extend(subscription.try_take().unwrap());
                held.len() == 4
            });
            say("holding");
            wait_for_the_end();
        }
        "keep-all subscription" => {
            let _subscription = new_subscription(&participant, Qos::keep_all(4));
            say("ready");
            wait_for_the_end();
        }
        "left subscription" => {
            let subscription = new_subscription(&participant, Qos::keep_all(4));
            say("ready");
            let mut held = None;
            wait_for("a sample to hold", || {
                held = subscription.try_take().unwrap();
                held.is_some()
            });
            drop(subscription);
            say("left");
            wait_for_the_end();
        }
        "exit" => exit_while_threads_run(participant.clone(), Participant::new(domain).unwrap()),
        "exit of the other first" => exit_while_threads_run(Participant::new(domain).unwrap(), participant),
        "exit with a full queue" => {
            let subscription = new_subscription(&participant, Qos::keep_all(4));
            wait_for("the publisher", || subscription.publisher_count() == 1);
            std::mem::forget(subscription);
            say("exits");
            wait_for_the_end();
            std::process::exit(0);
        }
        "last words" => {
            let publisher = new_publisher(&participant, Qos::keep_all(50));
            wait_for("the subscription", || publisher.subscription_count() == 1);
            (0..50).for_each(|n| publisher.publish(&Count { n }).unwrap());
            std::process::exit(0);
        }
        "fork" => {
            // SAFETY: the child only ends.
            let child = unsafe { libc::fork() };
            if child == 0 {
                std::process::exit(0);
            }
            // SAFETY: as above.
            let other = unsafe { libc::fork() };
            if other == 0 {
                let _own = tautline_rt::at_exit(|| {});
                std::process::exit(0);
            }
            for child in [child, other] {
                // SAFETY: it is this process's child.
                assert_eq!(unsafe { libc::waitpid(child, std::ptr::null_mut(), 0) }, child);
            }
            say("forked");
            wait_for_the_end();
        }
        other => panic!("no part {other}"),
    }
}

/// Nobody of the domain is there to clean up.
#[test]
fn what_a_domain_leaves_that_was_killed_as_a_whole_is_removed_by_any_process() {
    let (dead, living) = (domain(120), domain(121));
    let mut parts: Vec<_> = (0..4).map(|_| Part::start("keep-all subscription", dead)).collect();
    parts.iter_mut().for_each(|part| assert_eq!(part.hear(), "ready"));
    // None of them sees the others die.
    parts.iter().for_each(Part::stop);
    let before = shared_memory(dead);
    assert!(before.len() > 4, "{before:?}");
    parts.into_iter().for_each(Part::kill);
    let mut next = Part::start("keep-all subscription", living);
    assert_eq!(next.hear(), "ready");
    // The kernel may hold a dead process's lock a moment longer than the process: then the process after the next one finds it free.
    wait_for("an empty folder", || {
        let is_empty = shared_memory(dead).is_empty();
        if !is_empty {
            let mut again = Part::start("keep-all subscription", living);
            again.hear();
        }
        is_empty
    });
    assert!(!support::folder(dead).exists());
    drop(next);
    clean(living);
}

/// Ends by `exit`; threads hold all there is.
fn exit_while_threads_run(participant: Participant, beside: Participant) {
    let (publisher, subscription) =
        (new_publisher(&participant, Qos::keep_all(100)), new_subscription(&beside, Qos::keep_all(100)));
    // Both ends in one participant, as every ROS node has them.
    let _own = new_subscription(&participant, Qos::keep_last(1));
    let sent = std::sync::Arc::new(std::sync::atomic::AtomicU64::new(0));
    let counted = sent.clone();
    std::thread::spawn(move || {
        loop {
            match publisher.publish(&Count { n: 1 }) {
                Ok(()) => _ = counted.fetch_add(1, std::sync::atomic::Ordering::Relaxed),
                Err(_) => std::thread::yield_now(),
            }
        }
    });
    std::thread::spawn(move || {
        while subscription.try_take().is_ok() {
            std::thread::yield_now();
        }
    });
    wait_for("messages", || sent.load(std::sync::atomic::Ordering::Relaxed) > 200);
    say("exits");
    std::process::exit(0);
}

fn new_publisher(participant: &Participant, qos: Qos) -> Publisher<Count> {
    participant.create_publisher("/crash", qos, Limits::default()).unwrap()
}

fn new_subscription(participant: &Participant, qos: Qos) -> Subscription<Count> {
    participant.create_subscription("/crash", qos, Limits::default()).unwrap()
}

/// Publishes 50 messages and takes all that is there, counting those of others.
fn exchange(publisher: &Publisher<Count>, subscription: &Subscription<Count>, next: &mut u64) -> usize {
    let mut others = 0;
    for _ in 0..50 {
        publisher.publish(&Count { n: OURS + *next }).unwrap();
        let mut came = false;
        while let Some(sample) = subscription.try_take().unwrap() {
            if sample.info().publisher_gid == publisher.gid() {
                assert_eq!(sample.n, OURS + *next, "every message of ours, in order");
                came = true;
            } else {
                others += 1;
            }
        }
        assert!(came);
        *next += 1;
    }
    others
}

/// The files of a domain.
fn remains(domain: u32) -> Vec<String> {
    shared_memory(domain).into_keys().collect()
}

/// Looks after each cycle whether all that a dead process left has gone, and whether the living grow.
struct Remains {
    domain: u32,
    files: Vec<String>,
    bytes: Option<u64>,
}

impl Remains {
    fn new(domain: u32) -> Self {
        Remains { domain, files: remains(domain), bytes: None }
    }

    fn check(&mut self, mut meanwhile: impl FnMut()) {
        let mut files = Vec::new();
        let gone = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            wait_for("the warden", || {
                meanwhile();
                files = remains(self.domain);
                files == self.files
            })
        }));
        assert!(gone.is_ok(), "{files:#?} instead of {:#?}", self.files);
        // With the first other process a publisher uses as many samples as it ever will. A record may be some pages longer or shorter.
        let bytes = claimed(self.domain);
        let most = *self.bytes.get_or_insert(bytes) + 4 * tautline_rt::shm::page_bytes() as u64;
        assert!(bytes <= most, "{bytes}, {:?} before", self.bytes);
    }
}

#[test]
fn killed_publishers() {
    let participant = Participant::new(domain(160)).unwrap();
    let publisher = new_publisher(&participant, Qos::default());
    let subscription = new_subscription(&participant, Qos::keep_last(100));
    let mut next = 0;
    exchange(&publisher, &subscription, &mut next);
    let mut remains = Remains::new(160);
    for _ in 0..CYCLES {
        let mut part = Part::start("publisher", 160);
        assert_eq!(part.hear(), "ready");
        let mut others = 0;
        wait_for("messages of the child", || {
            others += exchange(&publisher, &subscription, &mut next);
            others > 10
        });
        part.kill();
        exchange(&publisher, &subscription, &mut next);
        remains.check(|| _ = exchange(&publisher, &subscription, &mut next));
        wait_for("the subscription to know", || subscription.publisher_count() == 1);
    }
}

#[test]
fn killed_subscriptions() {
    let participant = Participant::new(domain(161)).unwrap();
    let publisher = new_publisher(&participant, Qos::default());
    let subscription = new_subscription(&participant, Qos::keep_last(100));
    let mut next = 0;
    exchange(&publisher, &subscription, &mut next);
    let mut remains = Remains::new(161);
    for _ in 0..CYCLES {
        let mut part = Part::start("subscription", 161);
        wait_for("the child", || publisher.subscription_count() == 2);
        exchange(&publisher, &subscription, &mut next);
        assert_eq!(part.hear(), "holding");
        exchange(&publisher, &subscription, &mut next);
        part.kill();
        remains.check(|| _ = exchange(&publisher, &subscription, &mut next));
        wait_for("the publisher to know", || publisher.subscription_count() == 1);
    }
    assert_eq!(subscription.counters().lost(), 0);
}

#[test]
fn a_killed_keep_all_subscription_frees_the_publisher() {
    let participant = Participant::new(domain(162)).unwrap();
    let publisher = new_publisher(&participant, Qos::keep_all(4));
    let mut part = Part::start("keep-all subscription", 162);
    assert_eq!(part.hear(), "ready");
    let mut sent = 0;
    let mut loan = loop {
        let mut loan = publisher.loan().unwrap();
        loan.n = 7;
        match loan.publish() {
            Ok(()) => sent += 1,
            Err(SendError { error: PublishError::Full, loan }) => break loan,
            Err(other) => panic!("{other:?}"),
        }
    };
    assert_eq!((sent, loan.n), (4, 7));
    part.kill();
    wait_for("the janitors to free the publisher", || {
        let Some(back) = refused(std::mem::replace(&mut loan, publisher.loan().unwrap())) else {
            return true;
        };
        loan = back;
        false
    });
    drop(loan);
    drop((publisher, participant));
    clean(162);
}

fn refused(loan: tautline_transport::Loan<'_, Count>) -> Option<tautline_transport::Loan<'_, Count>> {
    match loan.publish() {
        Ok(()) => None,
        Err(SendError { error: PublishError::Full, loan }) => Some(loan),
        Err(other) => panic!("{other:?}"),
    }
}

/// It is not waited for any more, whether its process lives or is killed, and gives all back in the end.
#[test]
fn a_subscription_that_left_with_a_sample_of_a_process_that_is_killed() {
    let participant = Participant::new(domain(167)).unwrap();
    let publisher = new_publisher(&participant, Qos::keep_all(4));
    for _ in 0..5 {
        let mut part = Part::start("left subscription", 167);
        assert_eq!(part.hear(), "ready");
        wait_for("the child", || publisher.subscription_count() == 1);
        publisher.publish(&Count { n: 1 }).unwrap();
        assert_eq!(part.hear(), "left");
        wait_for("the publisher to know", || publisher.subscription_count() == 0);
        for n in 0..20 {
            publisher.publish(&Count { n }).unwrap();
        }
        part.kill();
        let mapped = || {
            let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
            maps.lines().filter(|line| line.contains("taut_167_") && line.ends_with("(deleted)")).count()
        };
        // What was handed over to the publishing thread before stays until something changes again.
        wait_for("nothing of those before to be left", || {
            publisher.publish(&Count { n: 1 }).unwrap();
            participants(167).len() == 1 && mapped() <= 2
        });
    }
    drop((publisher, participant));
    clean(167);
}

#[test]
fn a_process_that_exits_leaves_nothing_though_its_threads_run_on() {
    const DOMAIN: u32 = 185;
    for part in ["exit", "exit of the other first"].into_iter().cycle().take(2 * CYCLES) {
        let mut part = Part::start(part, domain(DOMAIN));
        assert_eq!(part.hear(), "exits");
        assert!(part.end().success());
        assert_eq!(remains(DOMAIN), Vec::<String>::new());
        let folder = std::path::Path::new("/dev/shm").join(tautline_rt::domain::shared_folder(DOMAIN));
        assert!(!folder.exists());
    }
}

/// As of one that is killed: a full queue of it holds nobody up.
#[test]
fn others_notice_an_exit() {
    const DOMAIN: u32 = 188;
    let participant = Participant::new(domain(DOMAIN)).unwrap();
    let publisher = new_publisher(&participant, Qos::keep_all(4));
    for _ in 0..CYCLES {
        let mut part = Part::start("exit with a full queue", DOMAIN);
        wait_for("the subscription", || publisher.subscription_count() == 1);
        while publisher.publish(&Count { n: 1 }).is_ok() {}
        assert_eq!(part.hear(), "exits");
        assert!(part.end().success());
        wait_for("the end of the subscription", || publisher.subscription_count() == 0);
        wait_for("room", || publisher.publish(&Count { n: 2 }).is_ok());
    }
}

#[test]
fn what_was_sent_before_an_exit_arrives() {
    const DOMAIN: u32 = 187;
    let participant = Participant::new(domain(DOMAIN)).unwrap();
    for _ in 0..CYCLES {
        let subscription = new_subscription(&participant, Qos::keep_all(50));
        assert!(Part::start("last words", DOMAIN).end().success());
        let mut taken = Vec::new();
        wait_for("all of it", || {
            taken.extend(take_all(&subscription));
            taken.len() == 50
        });
        assert_eq!(taken, (0..50).collect::<Vec<_>>());
        assert_eq!(subscription.counters().lost(), 0);
    }
    wait_for("the warden", || participants(DOMAIN).len() == 1);
}

#[test]
fn what_a_process_forks_ends_nothing_of_its_own() {
    const DOMAIN: u32 = 186;
    // Alone in its domain: who ends last there removes its files.
    let mut part = Part::start("fork", domain(DOMAIN));
    assert_eq!(part.hear(), "forked");
    assert_eq!(participants(DOMAIN).len(), 1);
    assert!(part.end().success());
    assert!(remains(DOMAIN).is_empty());
}
