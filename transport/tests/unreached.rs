// SPDX-License-Identifier: MIT OR Apache-2.0
//! A process whose file cannot be opened for a while, as at the limit of open files: whoever waits for it is connected later, without
//! anybody's next message, and gets what is kept.

mod support;

use std::path::{Path, PathBuf};
use support::{Count, clean, domain, folder, participants, take_all, wait_for};
use tautline_transport::{Limits, Participant, Qos};

fn participant(number: u32) -> (Participant, PathBuf) {
    let before = participants(number);
    let participant = Participant::new(number).unwrap();
    let mut files = participants(number).into_iter().filter(|name| !before.contains(name));
    (participant, folder(number).join(files.next().unwrap()))
}

/// In the place of a file that cannot be opened: a link, which is not followed. The file comes back when this is dropped.
struct Hidden {
    file: PathBuf,
    aside: PathBuf,
}

impl Hidden {
    fn new(file: &Path) -> Self {
        // Elsewhere: the warden of a domain looks after everything in its folder.
        let aside = file.parent().unwrap().with_extension("aside");
        std::fs::rename(file, &aside).unwrap();
        std::os::unix::fs::symlink(&aside, file).unwrap();
        Hidden { file: file.to_owned(), aside }
    }
}

impl Drop for Hidden {
    fn drop(&mut self) {
        // Takes the link's place.
        std::fs::rename(&self.aside, &self.file).unwrap();
    }
}

#[test]
fn a_publisher_is_connected_to_a_subscription_later() {
    let domain = domain(203);
    clean(domain);
    let (here, _) = participant(domain);
    let (there, file) = participant(domain);
    let limits = Limits::default();
    let (plain, kept) = (Qos::default(), Qos::default().transient_local());
    let subscription = there.create_subscription::<Count>("/plain", plain, limits).unwrap();
    let late = there.create_subscription::<Count>("/kept", kept, limits).unwrap();
    let seat = there.doorbell().claim_sampler().unwrap();
    seat.drain(|_| {});
    let hidden = Hidden::new(&file);
    let publisher = here.create_publisher::<Count>("/plain", plain, limits).unwrap();
    let keeper = here.create_publisher::<Count>("/kept", kept, limits).unwrap();
    for publisher in [&publisher, &keeper] {
        assert_eq!(publisher.subscription_count(), 0, "it is not known");
        publisher.publish(&Count { n: 1 }).unwrap();
    }
    assert!(!there.doorbell().is_pending());
    drop(hidden);
    wait_for("both subscriptions", || {
        (publisher.subscription_count(), keeper.subscription_count()) == (1, 1)
    });
    wait_for("what is kept", || {
        seat.drain(|_| {});
        take_all(&late) == [1]
    });
    wait_for("the other publisher", || subscription.publisher_count() == 1);
    assert!(take_all(&subscription).is_empty(), "it came before there was a subscription to it");
    seat.drain(|_| {});
    publisher.publish(&Count { n: 2 }).unwrap();
    assert!(there.doorbell().is_pending(), "by the publisher itself");
    assert_eq!(take_all(&subscription), [2]);
}

#[test]
fn a_subscription_is_connected_to_a_publisher_later() {
    let domain = domain(204);
    clean(domain);
    let (here, file) = participant(domain);
    let (there, _) = participant(domain);
    let (qos, limits) = (Qos::keep_all(2).transient_local(), Limits::default());
    let publisher = here.create_publisher::<Count>("/unreached", qos, limits).unwrap();
    let hidden = Hidden::new(&file);
    let subscription = there.create_subscription::<Count>("/unreached", qos, limits).unwrap();
    assert_eq!(subscription.publisher_count(), 0, "it is not known");
    // The publisher's process knows, and sends: nothing is lost, for it waits in a queue that is looked into later.
    wait_for("the subscription", || publisher.subscription_count() == 1);
    for n in 1..=2 {
        publisher.publish(&Count { n }).unwrap();
    }
    assert!(publisher.publish(&Count { n: 3 }).is_err(), "both wait there");
    assert!(take_all(&subscription).is_empty());
    let mut taken = Vec::new();
    drop(hidden);
    wait_for("both messages", || {
        taken.extend(take_all(&subscription));
        taken == [1, 2]
    });
    publisher.publish(&Count { n: 3 }).unwrap();
    assert_eq!(take_all(&subscription), [3]);
    assert_eq!(subscription.counters().lost(), 0);
}
