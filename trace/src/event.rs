// SPDX-License-Identifier: MIT OR Apache-2.0
//! The events, and their layout in a ring: five words each.

/// Words of one event in a ring.
pub(crate) const WORDS: usize = 5;
/// An object's id has 56 bits; above it lies the kind.
const OBJECT_BITS: u32 = 56;

/// Identifies an object of events, unique in its process: a node, a publisher, a subscription, a callback, a timer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct ObjectId(pub u64);

impl ObjectId {
    /// No object: no events are recorded for it.
    pub const NONE: ObjectId = ObjectId(0);

    /// Whether it is a callback of no subscription and no timer: these have odd numbers.
    #[cfg(feature = "lttng")]
    pub(crate) const fn is_callback_of_nothing(self) -> bool {
        self.0 & 1 == 1
    }
}

/// The kind of event.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[repr(u8)]
pub enum EventKind {
    /// A publisher sends a message: stamped before any subscription can take it.
    Publish = 1,
    /// A subscription has taken a message.
    Take = 2,
    /// A callback starts.
    CallbackStart = 3,
    /// A callback has ended.
    CallbackEnd = 4,
    /// The sampler starts to wait.
    SpinStart = 5,
    /// The sampler has something to serve.
    SpinWake = 6,
    /// The sampler's wait timed out.
    SpinTimeout = 7,
    /// The sampler has served what it woke for.
    SpinEnd = 8,
    /// A mirror has received a message from a network.
    Receive = 9,
    /// A mirror forwards a message under another id: to a network, or as a publisher of its domain.
    Pass = 10,
}

tautline_rt::names!(EventKind: pub const ALL: [EventKind; 10]; pub const fn name(self) -> &'static str {
    Publish: "publish", Take: "take", CallbackStart: "callback_start", CallbackEnd: "callback_end",
    SpinStart: "spin_start", SpinWake: "spin_wake", SpinTimeout: "spin_timeout", SpinEnd: "spin_end",
    Receive: "receive", Pass: "pass",
});

impl EventKind {
    fn from_number(number: u64) -> Option<EventKind> {
        EventKind::ALL.into_iter().find(|kind| *kind as u64 == number)
    }
}

/// One event of one thread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Event {
    /// `CLOCK_MONOTONIC` in nanoseconds.
    pub time_ns: u64,
    /// The kind of event.
    pub kind: EventKind,
    /// The object of the event.
    pub object: ObjectId,
    /// `publish`, `take` and `receive`: sequence number, source time stamp (nanoseconds since 1970), [`gid_key`] of the publisher.
    /// `pass`: sequence number among the object's messages, original sequence number, [`gid_key`] of the original publisher.
    /// `callback_start`: the release of its message or tick on `CLOCK_MONOTONIC`. `callback_end`: the processor time that it used, in
    /// nanoseconds; 0 if that was not measured. `spin_start`: the longest wait in nanoseconds,
    /// `u64::MAX` for as long as it takes. Otherwise zeros.
    pub arguments: [u64; 3],
}

impl Event {
    /// The words that [`from_words`](Self::from_words) reads: in a ring, or for a file.
    pub fn words(self) -> [u64; WORDS] {
        let [a, b, c] = self.arguments;
        [self.time_ns, (self.kind as u64) << OBJECT_BITS | self.object.0 & ((1 << OBJECT_BITS) - 1), a, b, c]
    }

    /// `None` if the words, which come from another process's memory or from a file, are not an event.
    pub fn from_words([time_ns, what, a, b, c]: [u64; WORDS]) -> Option<Event> {
        let kind = EventKind::from_number(what >> OBJECT_BITS)?;
        let object = ObjectId(what & ((1 << OBJECT_BITS) - 1));
        Some(Event { time_ns, kind, object, arguments: [a, b, c] })
    }
}

/// Folds a publisher's gid, as two words, into the one that events carry.
pub const fn gid_key([low, high]: [u64; 2]) -> u64 {
    low ^ high.rotate_left(32)
}

/// What identifies a message.
#[derive(Clone, Copy, Debug)]
pub struct MessageId {
    /// Counts the publisher's messages.
    pub sequence_number: u64,
    /// When it was published: nanoseconds since 1970.
    pub source_timestamp_ns: i64,
    /// Its publisher.
    pub gid: [u64; 2],
    /// The address of its body in this process.
    pub address: usize,
}

impl MessageId {
    pub(crate) fn arguments(&self) -> [u64; 3] {
        [self.sequence_number, self.source_timestamp_ns.cast_unsigned(), gid_key(self.gid)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_comes_back_and_nothing_else_does() {
        for kind in EventKind::ALL {
            let event =
                Event { time_ns: 7, kind, object: ObjectId(u64::MAX >> 8), arguments: [1, 2, u64::MAX] };
            assert_eq!(Event::from_words(event.words()), Some(event));
        }
        for number in (0..=255u64).filter(|n| !(1..=10).contains(n)) {
            assert_eq!(Event::from_words([0, number << OBJECT_BITS | 1, 0, 0, 0]), None);
        }
    }
}
