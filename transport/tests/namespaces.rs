// SPDX-License-Identifier: MIT OR Apache-2.0
//! A domain shared by processes in mount and PID namespaces of their own, as containers are, with a common /dev/shm: they exchange
//! messages, see each other's nodes, and clean up after each other.

mod support;

use support::{
    Count, Part, clean, participants, publisher, say, shared_memory, subscription, wait_for, wait_for_the_end,
};
use tautline_transport::{Participant, Qos, graph_of};

/// What makes the namespaces. Their processes end with it.
const KINDS: [&[&str]; 3] = [
    &["unshare", "--mount"],
    &["unshare", "--pid", "--fork", "--kill-child", "--mount-proc"],
    &["unshare", "--mount", "--pid", "--ipc", "--uts", "--fork", "--kill-child", "--mount-proc"],
];

/// Whether this user may make them; with CI set that must be.
fn is_permitted() -> bool {
    let tried = std::process::Command::new("unshare").args(["--mount", "--pid", "--fork", "true"]).output();
    let reason = match tried {
        Ok(output) if output.status.success() => return true,
        Ok(output) => String::from_utf8_lossy(&output.stderr).trim().to_owned(),
        Err(error) => format!("unshare: {error}"),
    };
    assert!(std::env::var_os("CI").is_none(), "{reason}");
    println!("skipped: {reason}");
    false
}

/// The child's part; without its variable it is no test.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    let participant = Participant::new(domain).unwrap();
    let node = participant.create_node(&part, "/").unwrap();
    let of_node = participant.for_node(&node);
    let back = publisher(&of_node, "/back", Qos::keep_all(10));
    let there = subscription(&of_node, "/there", Qos::keep_all(10));
    say("ready");
    if part == "resident" {
        return wait_for_the_end();
    }
    let parent = rustix::process::getppid();
    while rustix::process::getppid() == parent {
        while let Some(sample) = there.try_take().unwrap() {
            back.publish(&Count { n: sample.n }).unwrap();
        }
        std::thread::yield_now();
    }
}

fn nodes(domain: u32) -> Vec<String> {
    graph_of(domain).unwrap().nodes.iter().map(|node| node.name.full_name()).collect()
}

#[test]
fn messages_cross_namespaces_and_the_dead_are_noticed() {
    if !is_permitted() {
        return;
    }
    let domain = support::domain(190);
    for kind in KINDS {
        println!("{kind:?}");
        let participant = Participant::new(domain).unwrap();
        let there = publisher(&participant, "/there", Qos::keep_all(10));
        let back = subscription(&participant, "/back", Qos::keep_all(10));
        let mut echo = Part::start_by(kind, "echo", domain);
        assert_eq!(echo.hear(), "ready");
        wait_for("the other end", || there.subscription_count() == 1 && back.publisher_count() == 1);
        assert_eq!(nodes(domain), ["/echo"]);
        for n in 0..200 {
            there.publish(&Count { n }).unwrap();
            wait_for("an answer", || back.try_take().unwrap().is_some_and(|sample| sample.n == n));
        }
        echo.kill();
        wait_for("the dead one's end", || nodes(domain).is_empty() && participants(domain).len() == 1);
        wait_for("its ends", || there.subscription_count() == 0 && back.publisher_count() == 0);
        drop((there, back, participant));
        clean(domain);
    }
}

/// Whoever looks after the dead is itself in a namespace, where the numbers of the others' processes mean nothing.
#[test]
fn those_in_one_namespace_clean_up_after_those_in_another() {
    if !is_permitted() {
        return;
    }
    let domain = support::domain(191);
    for kind in KINDS {
        // The first is who looks after the dead, until it dies itself.
        let mut residents = Vec::new();
        for _ in 0..3 {
            let mut resident = Part::start_by(kind, "resident", domain);
            assert_eq!(resident.hear(), "ready");
            residents.push(resident);
        }
        residents.remove(1).kill();
        wait_for("the second one's end", || participants(domain).len() == 2);
        residents.remove(0).kill();
        wait_for("the first one's end", || participants(domain).len() == 1);
        assert_eq!(nodes(domain), ["/resident"]);
        for resident in residents {
            resident.kill();
        }
        // Nobody is left who would clean up; the next one does, before it does anything else. The kernel ends the processes of a
        // namespace a moment after who made it, and closes their files one by one.
        wait_for("an empty folder", || {
            drop(Participant::new(domain).unwrap());
            shared_memory(domain).is_empty()
        });
    }
}
