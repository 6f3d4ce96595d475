// SPDX-License-Identifier: MIT OR Apache-2.0
//! Two participants without threads, a step at a time.

use super::*;
use crate::graph::topic_type::TopicType;
use crate::memory::file::OwnMemory;
use crate::qos::{Limits, Qos};
use crate::tests::isolated;
use crate::topic::declaration::Topic;
use crate::topic::reader::core::SubscriptionRole;
use crate::topic::writer::core::PublisherRole;
use tautline_doorbell::Doorbell;

/// A participant without threads: it looks when it is told to.
struct Party {
    matcher: Matcher,
    record: Arc<OwnRecord>,
    memory: Arc<OwnMemory>,
    doorbell: Arc<Doorbell>,
    domain: Arc<Domain>,
    place: usize,
}

impl Party {
    fn join(number: u32) -> Self {
        isolated();
        let domain = Domain::join(number).unwrap();
        let memory = Arc::new(OwnMemory::create(number).unwrap());
        let arena = memory.create_arena();
        let grown = memory.clone();
        let doorbell = Doorbell::new(arena, Box::new(move |window| grown.grow_arena(window)));
        let record = OwnRecord::new(&domain, &memory);
        let place = domain.add(memory.id()).unwrap();
        record.publish(place);
        let matcher = Matcher::new(&domain, memory.id(), &record, &Arc::default());
        Party { matcher, record, memory, doorbell, domain, place }
    }

    fn gid(&self) -> Gid {
        Gid::of(self.memory.id(), self.record.number())
    }

    fn topic(limits: Limits) -> Topic {
        Topic::check("/t", &TopicType::new("a/msg/B"), Qos::default(), limits).unwrap()
    }

    fn publisher(&self) -> (Arc<PublisherCore>, impl Sized) {
        let (limits, role) = (Limits::default(), PublisherRole::default());
        let slot = Arc::new(self.doorbell.claim().unwrap());
        let home = (&self.memory, &self.record);
        let topic = Party::topic(limits);
        let made =
            PublisherCore::create(home, self.gid(), topic, Qos::default(), limits, role, slot).unwrap();
        self.matcher.add_publisher(&made.0, None).unwrap();
        made
    }

    fn unlisted_subscription(&self) -> (Arc<SubscriptionCore>, impl Sized) {
        let (limits, role) = (Limits::default(), SubscriptionRole::default());
        let slot = Arc::new(self.doorbell.claim().unwrap());
        SubscriptionCore::create(self.gid(), Party::topic(limits), Qos::default(), limits, role, slot)
    }

    fn subscription(&self) -> (Arc<SubscriptionCore>, impl Sized) {
        let made = self.unlisted_subscription();
        self.matcher.add_subscription(&made.0, None).unwrap();
        made
    }

    fn calls(&self) -> u32 {
        self.domain.calls(self.place).0.load(Ordering::Acquire)
    }
}

impl Drop for Party {
    fn drop(&mut self) {
        self.domain.remove(self.memory.id());
        self.memory.retire();
    }
}

#[test]
fn a_subscription_that_goes_before_it_has_found_its_publisher_calls_it_and_holds_nothing() {
    let (one, other) = (Party::join(222), Party::join(222));
    let (subscription, _live) = other.subscription();
    let (publisher, _live) = one.publisher();
    assert_eq!(publisher.participants().len(), 1, "connected, and the other has not looked");
    let before = one.calls();
    other.matcher.remove_subscription(&subscription);
    assert_ne!(one.calls(), before, "its publisher is told");
    one.matcher.refresh();
    assert!(publisher.participants().is_empty(), "nothing is kept for it");
    assert_eq!(publisher.matched.here.load(Ordering::Acquire), 0);
}

#[test]
fn a_publisher_is_awaited_until_what_it_sends_from_can_be_reached() {
    let (one, other) = (Party::join(223), Party::join(223));
    let (publisher, _live) = one.publisher();
    let all = |_: Gid| true;
    assert!(!publisher.is_awaited(all), "by nobody");
    let (subscription, _other_live) = other.unlisted_subscription();
    std::thread::scope(|scope| {
        // It waits for the publisher's participant.
        let added = scope.spawn(|| other.matcher.add_subscription(&subscription, None).unwrap());
        while !added.is_finished() {
            one.matcher.refresh();
            std::thread::yield_now();
        }
    });
    assert_eq!(subscription.expected(), 0);
    assert!(!publisher.is_awaited(all), "it has found everything");
    publisher.lengthen(1 << 16, true).unwrap();
    one.matcher.announce_segments(&publisher);
    assert!(publisher.is_awaited(all), "there is a segment that it has not mapped");
    other.matcher.refresh();
    assert!(!publisher.is_awaited(all));
}

#[test]
fn samples_that_the_publishing_thread_may_loan_stay() {
    let one = Party::join(55);
    let (publisher, _live) = one.publisher();
    publisher.lengthen(1 << 16, false).unwrap();
    publisher.settle();
    let segments = || publisher.segment_views().0.iter().flatten().count();
    assert_eq!(segments(), 2, "it has not read that there are longer ones");
    publisher.lengthen(1 << 17, true).unwrap();
    assert_eq!(segments(), 1);
}

#[test]
fn a_participant_that_has_connected_is_not_called_for_it() {
    crate::tests::isolated();
    let (one, other) = (Party::join(7), Party::join(7));
    let (subscription, _live) = other.subscription();
    let (_publisher, _other_live) = one.publisher();
    let before = one.calls();
    other.matcher.refresh();
    assert_eq!((subscription.expected(), one.calls()), (0, before));
}
