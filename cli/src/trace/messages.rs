// SPDX-License-Identifier: MIT OR Apache-2.0
//! Combines events into runs: which callback ran when, for which message.

use super::recording::Recording;
use std::collections::HashMap;
use tautline_trace::{EventKind, ObjectId};

/// Where a message was published.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Publication {
    pub process: u32,
    pub tid: u32,
    pub time_ns: u64,
}

/// A message, the same in all processes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct MessageKey {
    pub publisher: u64,
    pub sequence_number: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Run {
    pub process: u32,
    pub tid: u32,
    pub callback: ObjectId,
    pub start_ns: u64,
    /// `None` if the recording ended before.
    pub end_ns: Option<u64>,
    /// The release of the message or of the timer's tick.
    pub release_ns: u64,
    /// The processor time that it used, if it has ended and that was measured.
    pub used_ns: Option<u64>,
    /// `None` for a timer, and if the recording does not contain the take.
    pub message: Option<MessageKey>,
}

/// Where each message was published.
pub fn publications(recording: &Recording) -> HashMap<MessageKey, Publication> {
    let published = recording.events.iter().filter(|timed| timed.event.kind == EventKind::Publish);
    let place = |timed: &super::recording::TimedEvent| Publication {
        process: timed.process,
        tid: timed.tid,
        time_ns: timed.event.time_ns,
    };
    published.map(|timed| (key(timed.event.arguments), place(timed))).collect()
}

/// The message of a `publish` or `take` event.
pub fn key([sequence_number, _, publisher]: [u64; 3]) -> MessageKey {
    MessageKey { publisher, sequence_number }
}

/// Every run of every callback, in order of their starts.
///
/// A run ends at its callback's end, or earlier if another callback starts in its thread: a stream learns only when it is
/// polled next that its item has been processed, and that may be after the thread's other streams.
///
/// A callback's message is the one that its subscription took last in the same thread, before the start: a stream takes one
/// message at a time, and a group keeps one per member.
pub fn runs(recording: &Recording) -> Vec<Run> {
    let mut taken: HashMap<(u32, u32, ObjectId), MessageKey> = HashMap::new();
    let mut open: HashMap<(u32, u32), usize> = HashMap::new();
    let mut runs: Vec<Run> = Vec::new();
    for timed in &recording.events {
        let (process, tid, event) = (timed.process, timed.tid, timed.event);
        match event.kind {
            EventKind::Take => {
                taken.insert((process, tid, event.object), key(event.arguments));
            }
            EventKind::CallbackStart => {
                let source = recording.object(process, event.object).map(|callback| callback.parent);
                let message = source.and_then(|source| taken.remove(&(process, tid, source)));
                if let Some(before) =
                    open.insert((process, tid), runs.len()).and_then(|index| runs.get_mut(index))
                {
                    before.end_ns = Some(event.time_ns);
                }
                runs.push(Run {
                    process,
                    tid,
                    callback: event.object,
                    start_ns: event.time_ns,
                    end_ns: None,
                    release_ns: event.arguments[0],
                    used_ns: None,
                    message,
                });
            }
            EventKind::CallbackEnd => {
                // An event of another callback than the running one belongs to a run that the next start has already ended.
                let running = open.get(&(process, tid)).and_then(|index| runs.get_mut(*index));
                if let Some(run) = running.filter(|run| run.callback == event.object) {
                    run.end_ns = Some(event.time_ns);
                    run.used_ns = Some(event.arguments[0]).filter(|ns| *ns > 0);
                    open.remove(&(process, tid));
                }
            }
            _ => {}
        }
    }
    runs
}

/// For each subscription, the number of messages that are missing in the sequence numbers that it took from each publisher. Before its
/// first take these are the messages that were published after it was created and after its process began to record. Processes of which
/// events were lost are left out, because it is not known what their subscriptions took.
pub fn messages_lost(recording: &Recording) -> HashMap<(u32, ObjectId), u64> {
    let mut published: HashMap<u64, Vec<(u64, u64)>> = HashMap::new();
    let mut last: HashMap<(u32, ObjectId, u64), u64> = HashMap::new();
    let mut lost: HashMap<(u32, ObjectId), u64> = HashMap::new();
    // Processes do not begin to record at the same time.
    let mut recorded_ns: HashMap<u32, u64> = HashMap::new();
    for timed in &recording.events {
        let since_ns = *recorded_ns.entry(timed.process).or_insert(timed.event.time_ns);
        let MessageKey { publisher, sequence_number } = key(timed.event.arguments);
        if timed.event.kind == EventKind::Publish {
            published.entry(publisher).or_default().push((sequence_number, timed.event.time_ns));
        }
        if timed.event.kind != EventKind::Take {
            continue;
        }
        let (process, subscription) = (timed.process, timed.event.object);
        let missing = match last.insert((process, subscription, publisher), sequence_number) {
            Some(before) => sequence_number.saturating_sub(before.saturating_add(1)),
            None => {
                let made_ns =
                    recording.object(process, subscription).map_or(u64::MAX, |object| object.created_ns);
                let first_ns = made_ns.max(since_ns);
                let earlier =
                    |(number, time_ns): &&(u64, u64)| *number < sequence_number && *time_ns >= first_ns;
                published.get(&publisher).map_or(0, |of| of.iter().filter(earlier).count() as u64)
            }
        };
        *lost.entry((process, subscription)).or_default() += missing;
    }
    lost.retain(|(process, _), _| recording.processes.get(process).is_none_or(|of| of.events_lost() == 0));
    lost
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::recording::TimedEvent;
    use tautline_trace::{Description, Event, ObjectKind};

    const PUBLISHER: u32 = 0;
    const SUBSCRIBER: u32 = 1;
    const SUBSCRIPTION: ObjectId = ObjectId(7);

    /// A subscription made at 5 whose process is recorded from 30 on, and a publisher recorded from 10 on that publishes a
    /// message every 10: (time, message) of each take.
    fn recording(taken: &[(u64, u64)]) -> Recording {
        let mut recording = Recording::default();
        let object = Description {
            id: SUBSCRIPTION,
            kind: ObjectKind::Subscription,
            parent: ObjectId::NONE,
            detail: 1,
            gid: [0; 2],
            created_ns: 5,
            name: "/n".to_owned(),
        };
        recording.process(SUBSCRIBER).objects.insert(SUBSCRIPTION, object);
        let mut add = |process: u32, kind: EventKind, time_ns: u64, number: u64| {
            let event = Event { time_ns, kind, object: SUBSCRIPTION, arguments: [number, 0, 9] };
            recording.events.push(TimedEvent { process, tid: 1, event });
        };
        (1..=9).for_each(|number| add(PUBLISHER, EventKind::Publish, 10 * number, number));
        add(SUBSCRIBER, EventKind::SpinStart, 30, 0);
        taken.iter().for_each(|(time_ns, number)| add(SUBSCRIBER, EventKind::Take, *time_ns, *number));
        recording.finish();
        recording
    }

    fn lost(recording: &Recording) -> Option<u64> {
        messages_lost(recording).get(&(SUBSCRIBER, SUBSCRIPTION)).copied()
    }

    #[test]
    fn what_was_taken_before_the_recording_is_not_lost() {
        assert_eq!(lost(&recording(&[(41, 4), (51, 5)])), Some(1), "3 was published when both were recorded");
        assert_eq!(lost(&recording(&[(31, 3), (61, 6)])), Some(2));
        assert_eq!(lost(&recording(&[(31, 3), (41, 4)])), Some(0));
    }

    #[test]
    fn what_was_lost_is_unknown_where_events_were() {
        let mut recording = recording(&[(31, 3), (61, 6)]);
        recording.process(SUBSCRIBER).lost.insert(1, 4);
        assert_eq!(lost(&recording), None);
    }
}
