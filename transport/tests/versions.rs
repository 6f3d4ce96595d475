// SPDX-License-Identifier: MIT OR Apache-2.0
//! Processes of two versions in one domain: neither reads what the other wrote, and the refusal names the file and the fix.

mod support;

use std::fs::OpenOptions;
use std::os::unix::fs::FileExt;
use support::{Count, clean, domain, folder, publisher, subscription, take_all, wait_for};
use tautline_transport::{Participant, Qos, TransportError, Visitor};

const FIX: &str = " is of another version of Tautline: use the same one in all processes of a domain; when none of them runs, the \
                   folder it is in may be removed";

/// A domain of which the first program has written its own number for this layout.
#[test]
fn a_domain_of_another_version_is_not_joined() {
    let number = domain(221);
    let first = Participant::new(number).unwrap();
    let file = folder(number).join("domain");
    let other = OpenOptions::new().read(true).write(true).open(&file).unwrap();
    let mut magic = [0; 8];
    other.read_exact_at(&mut magic, 0).unwrap();
    assert!(magic.starts_with(b"tautdom"));
    other.write_at(b"tautdom1", 0).unwrap();
    let said = [Participant::new(number).map(drop), Visitor::new(number).unwrap().graph().map(drop)];
    other.write_at(&magic, 0).unwrap();
    for refusal in said {
        assert_eq!(refusal.unwrap_err().to_string(), format!("{}{FIX}", file.display()));
    }
    drop(first);
    clean(number);
}

/// As if its build had another layout: everything else in its file is right.
#[test]
fn a_participant_of_another_version_is_left_out_and_the_others_go_on() {
    let number = domain(222);
    let other = Participant::new(number).unwrap();
    let file = folder(number).join(format!("p{:016x}", other.id()));
    OpenOptions::new().write(true).open(&file).unwrap().write_at(&1_u32.to_ne_bytes(), 8).unwrap();
    let [looker, same] = [(); 2].map(|()| Participant::new(number).unwrap());
    let qos = Qos::keep_last(4).transient_local();
    let unread = publisher(&other, "/count", qos);
    unread.publish(&Count { n: 1 }).unwrap();
    let subscription = subscription(&looker, "/count", qos);
    let publisher = publisher(&same, "/count", qos);
    publisher.publish(&Count { n: 2 }).unwrap();
    let mut taken = Vec::new();
    wait_for("the message of the same version", || {
        taken.extend(take_all(&subscription));
        !taken.is_empty()
    });
    assert_eq!((taken, subscription.publisher_count()), (vec![2], 1));

    let mut visitor = Visitor::new(number).unwrap();
    let of = |graph: &tautline_transport::GraphSnapshot| {
        graph.endpoints.iter().map(|end| end.gid).collect::<Vec<_>>()
    };
    let seen = of(&visitor.graph().unwrap());
    assert_eq!(seen, of(&looker.graph().unwrap()));
    assert!(seen.contains(&publisher.gid()) && !seen.contains(&unread.gid()));
    let left_out = visitor.left_out();
    assert!(matches!(&left_out[..], [TransportError::Version { path }] if *path == file), "{left_out:?}");
    assert_eq!(left_out[0].to_string(), format!("{}{FIX}", file.display()));
}
