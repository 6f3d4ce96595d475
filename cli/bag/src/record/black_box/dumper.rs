// SPDX-License-Identifier: MIT OR Apache-2.0
//! Takes messages out of the ring of a black box: drops those that are too old, and writes all of them at an alarm.
//!
//! Messages leave the memory when they are written, so an alarm soon after another writes only newer ones. Messages that publishers keep
//! for late joiners are kept as long as the publishers keep them, and stand at the beginning of each bag.

use super::alarms::Alarm;
use super::tracing::Tracing;
use crate::record::args::Kind;
use crate::record::channels::Channels;
use crate::record::observers::Announced;
use crate::ring::{HEAD_BYTES, Head, LATCHED_BYTES, Ring, oldest};
use rtrb::Consumer;
use serde_json::{Value, json};
use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;
use taut_cli::verb::Outcome;
use tautline_bag::{BagError, Options, TopicId, Writer};
use tautline_rt::clock::monotonic_ns;
use tautline_rt::{Policy, ThreadBuilder};

/// The interval at which old messages are dropped.
const PERIOD: Duration = Duration::from_millis(2);
/// One part in this number of the ring stays free for new messages.
const FREE_PART: usize = 8;

/// What the black box keeps, and where it is written.
pub struct Plan {
    pub folder: PathBuf,
    pub options: Options,
    pub session: BTreeMap<String, String>,
    pub span_ns: u64,
    pub after_ns: u64,
    pub most_bags: Option<usize>,
    /// From `CLOCK_MONOTONIC` to times of reception.
    pub offset_ns: i64,
}

pub struct Dumper {
    alarms: Sender<Alarm>,
    thread: tautline_rt::JoinHandle<Dumped>,
}

/// The result of a black box.
#[derive(Default)]
pub struct Dumped {
    pub dumps: Vec<Dump>,
    /// Bags that were removed for newer ones.
    pub removed: usize,
    /// Requests whose bytes are not a request of their service.
    pub unusable: u64,
    /// Messages that publishers of these topics keep for late joiners, and for which there was no room.
    pub unlatched: BTreeMap<String, u64>,
    /// The shortest time for which there was room, if it was less than requested.
    pub shortest_ns: Option<u64>,
    pub failed: Option<BagError>,
}

/// A bag that was written.
pub struct Dump {
    pub folder: PathBuf,
    pub causes: Vec<(Kind, String)>,
    pub messages: u64,
    pub span_ns: u64,
    /// `None`: no trace was recorded, or it could not be written.
    pub trace_events: Option<u64>,
}

impl Dump {
    pub fn json(&self) -> Value {
        let cause = |(kind, words): &(Kind, String)| json!({ "kind": kind.name(), "what": words });
        json!({
            "bag": self.folder.display().to_string(), "causes": self.causes.iter().map(cause).collect::<Vec<_>>(),
            "messages": self.messages, "seconds": self.span_ns as f64 / 1e9, "trace_events": self.trace_events,
        })
    }

    fn why(&self) -> String {
        self.causes.iter().map(|(_, words)| words.as_str()).collect::<Vec<_>>().join("; ")
    }

    pub fn line(&self) -> String {
        let trace = self.trace_events.map_or(String::new(), |events| format!(", {events} trace events"));
        format!(
            "{}: {} messages of {:.1} s{trace}: {}",
            self.folder.display(),
            self.messages,
            self.span_ns as f64 / 1e9,
            self.why()
        )
    }
}

impl Dumper {
    pub fn start(
        plan: Plan,
        consumer: Consumer<u8>,
        announced: Receiver<Announced>,
        tracing: Option<Tracing>,
        is_over: Arc<AtomicBool>,
    ) -> Outcome<Self> {
        let (alarms, new_observers) = channel();
        let work = Work::new(plan, consumer, announced, tracing);
        let thread = ThreadBuilder::new("dumper").policy(Policy::Other { nice: 0 });
        let thread = thread.spawn(move || move || work.run(&new_observers, &is_over))?;
        Ok(Dumper { alarms, thread })
    }

    pub fn alarm(&self, alarm: Alarm) {
        // The thread ends before this only with an error, which it reports itself.
        let _ = self.alarms.send(alarm);
    }

    /// Ends after the reader has ended. A pending alarm is written first.
    pub fn finish(self) -> Outcome<Dumped> {
        drop(self.alarms);
        Ok(self.thread.join()?)
    }
}

/// The messages that a publisher keeps for late joiners.
#[derive(Default)]
struct Latched {
    messages: VecDeque<(Head, Vec<u8>)>,
    bytes: usize,
}

impl Latched {
    fn push(&mut self, head: Head, cdr: Vec<u8>) {
        self.bytes += cdr.len();
        self.messages.push_back((head, cdr));
    }

    /// Removes the oldest message and returns its length.
    fn pop(&mut self) -> usize {
        let bytes = self.messages.pop_front().map_or(0, |(_, cdr)| cdr.len());
        self.bytes -= bytes;
        bytes
    }
}

struct Work {
    plan: Plan,
    consumer: Consumer<u8>,
    channels: Channels,
    /// The kept messages of each channel.
    latched: Vec<Latched>,
    tracing: Option<Tracing>,
    number: u32,
    scratch: Vec<u8>,
    done: Dumped,
}

/// An alarm whose bag is to be written, and when.
struct Pending {
    alarms: Vec<Alarm>,
    due_ns: u64,
}

impl Work {
    fn new(
        plan: Plan,
        consumer: Consumer<u8>,
        announced: Receiver<Announced>,
        tracing: Option<Tracing>,
    ) -> Self {
        let channels = Channels::new(announced);
        let (latched, scratch, done) = (Vec::new(), Vec::new(), Dumped::default());
        Work { plan, consumer, channels, latched, tracing, number: 0, scratch, done }
    }

    fn run(mut self, alarms: &Receiver<Alarm>, is_over: &AtomicBool) -> Dumped {
        let mut pending: Option<Pending> = None;
        loop {
            use std::sync::mpsc::TryRecvError::{Disconnected, Empty};
            let is_last = loop {
                match alarms.try_recv() {
                    Ok(alarm) => {
                        let due_ns = alarm.at_ns.saturating_add(self.plan.after_ns);
                        let pending = pending.get_or_insert(Pending { alarms: Vec::new(), due_ns });
                        pending.alarms.push(alarm);
                    }
                    Err(Empty) => break false,
                    Err(Disconnected) => break true,
                }
            };
            self.drop_old();
            if let Some(due) = pending.take_if(|pending| is_last || monotonic_ns() > pending.due_ns)
                && let Err(error) = self.dump(due)
            {
                self.done.failed = Some(error);
                break;
            }
            if is_last {
                break;
            }
            std::thread::sleep(PERIOD);
        }
        is_over.store(true, Ordering::Release);
        self.done
    }

    /// Converts to a time of reception.
    fn logged(&self, monotonic_ns: u64) -> u64 {
        monotonic_ns.saturating_add_signed(self.plan.offset_ns)
    }

    fn drop_old(&mut self) {
        let oldest_ns = self.logged(monotonic_ns()).saturating_sub(self.plan.span_ns);
        let capacity = self.consumer.buffer().capacity();
        while let Some(head) = self.head() {
            let is_full = capacity - self.consumer.slots() < capacity / FREE_PART;
            if head.log_ns >= oldest_ns && !is_full {
                return;
            }
            if head.log_ns >= oldest_ns {
                let kept_ns = self.plan.span_ns - (head.log_ns - oldest_ns).min(self.plan.span_ns);
                self.done.shortest_ns = Some(self.done.shortest_ns.map_or(kept_ns, |ns| ns.min(kept_ns)));
            }
            self.take();
            self.latch(head);
        }
    }

    /// The head of the oldest message, if the message is complete and its topic is known.
    fn head(&mut self) -> Option<Head> {
        let (head, _) = oldest(&mut self.consumer)?;
        self.channels.of(&head)?;
        Some(head)
    }

    /// Takes the message of [`head`](Self::head) out of the ring, into `scratch`, as it is in a bag.
    fn take(&mut self) {
        let Some((head, chunk)) = oldest(&mut self.consumer) else { return };
        self.scratch.resize(head.cdr_bytes as usize, 0);
        Ring::of(&chunk).copy(HEAD_BYTES, &mut self.scratch);
        chunk.commit_all();
    }

    /// Keeps the message that was taken for late joiners, if its publisher does.
    fn latch(&mut self, head: Head) {
        let Some(channel) = self.channels.of(&head) else { return };
        let kept = self.channels.list()[channel].kept;
        if kept == 0 {
            return;
        }
        self.latched.resize_with(self.latched.len().max(channel + 1), Latched::default);
        let latched = &mut self.latched[channel];
        latched.push(head, self.scratch.clone());
        if latched.messages.len() > kept {
            latched.pop();
        }
        // Publishers that have ended count, too.
        let topic = &self.channels.list()[channel].topic.name;
        let of_topic = |at: &usize| self.channels.list()[*at].topic.name == *topic;
        let members: Vec<_> = (0..self.latched.len()).filter(of_topic).collect();
        let mut bytes: usize = members.iter().map(|at| self.latched[*at].bytes).sum();
        while bytes > LATCHED_BYTES {
            // The new message stays, however long it is. The last message of a publisher is removed only after all that are not.
            let may_go = |at: &&usize| self.latched[**at].messages.len() > usize::from(**at == channel);
            let rank = |at: &&usize| {
                let messages = &self.latched[**at].messages;
                (messages.len() == 1, messages.front().map_or(u64::MAX, |(head, _)| head.log_ns))
            };
            let Some(oldest) = members.iter().filter(may_go).min_by_key(rank) else { return };
            bytes -= self.latched[*oldest].pop();
            *self.done.unlatched.entry(topic.clone()).or_default() += 1;
        }
    }

    fn dump(&mut self, due: Pending) -> Result<(), BagError> {
        self.number += 1;
        let kind = due.alarms.first().map_or(Kind::Request, |alarm| alarm.kind);
        let folder = self.plan.folder.join(format!("{:03}_{}", self.number, kind.name()));
        let mut writer = Writer::create(&folder, self.plan.options, self.plan.session.clone())?;
        self.channels.refresh();
        let (mut messages, mut span) = (0, None);
        let failed = match self.write_until(&mut writer, self.logged(due.due_ns), &mut messages, &mut span) {
            Ok(()) => None,
            // The bag is complete without the rest.
            Err(full @ BagError::Full { .. }) => Some(full),
            Err(error) => return Err(error),
        };
        let beside = |name: &str| folder.join(name);
        let trace_events = self.tracing.as_ref().and_then(|tracing| tracing.write(&beside("taut.trace")));
        if let Some(run) = due.alarms.iter().find_map(|alarm| alarm.statistics.as_ref()) {
            // An error is ignored, because the bag itself is more important.
            let _ = run.save(&beside("statistics.json"));
        }
        let causes: Vec<_> = due.alarms.into_iter().map(|alarm| (alarm.kind, alarm.words)).collect();
        let span_ns = span.map_or(0, |(first, last): (u64, u64)| last.saturating_sub(first));
        let dump = Dump { folder, causes, messages, span_ns, trace_events };
        let said = [("black_box", dump.json().to_string()), ("why", dump.why())];
        writer.finish(said.map(|(key, text)| (key.to_owned(), text)).into())?;
        eprintln!("taut: {}", dump.line());
        self.done.dumps.push(dump);
        while self.plan.most_bags.is_some_and(|most| self.done.dumps.len() > most) {
            let oldest = self.done.dumps.remove(0);
            self.done.removed += usize::from(std::fs::remove_dir_all(&oldest.folder).is_ok());
        }
        failed.map_or(Ok(()), Err)
    }

    /// Writes the messages that late joiners would get, and those in the ring that were received until then. Counts them; the span is from
    /// the first one in the ring to the last.
    fn write_until(
        &mut self,
        writer: &mut Writer,
        until_ns: u64,
        messages: &mut u64,
        span: &mut Option<(u64, u64)>,
    ) -> Result<(), BagError> {
        let ids = &mut Vec::new();
        self.channels.write(writer, ids)?;
        while let Some(head) = self.head().filter(|head| head.log_ns <= until_ns) {
            if span.is_none() {
                self.write_latched(writer, ids, head.log_ns, messages)?;
            }
            *span = Some((span.map_or(head.log_ns, |(first, _)| first), head.log_ns));
            self.take();
            *messages += u64::from(self.write(writer, ids, head)?);
            self.latch(head);
        }
        match span {
            Some(_) => Ok(()),
            None => self.write_latched(writer, ids, until_ns, messages),
        }
    }

    /// Writes the messages that late joiners would get at this time.
    fn write_latched(
        &mut self,
        writer: &mut Writer,
        ids: &mut Vec<TopicId>,
        log_ns: u64,
        messages: &mut u64,
    ) -> Result<(), BagError> {
        for (head, cdr) in
            self.latched.iter().flat_map(|latched| latched.messages.clone()).collect::<Vec<_>>()
        {
            self.scratch = cdr;
            *messages += u64::from(self.write(writer, ids, Head { log_ns, ..head })?);
        }
        Ok(())
    }

    /// Writes the message in `scratch`. `false` if it is not a request of its service.
    fn write(&mut self, writer: &mut Writer, ids: &mut Vec<TopicId>, head: Head) -> Result<bool, BagError> {
        let written = self.channels.write_message(writer, ids, &head, &self.scratch)?;
        self.done.unusable += u64::from(written == Some(false));
        Ok(written == Some(true))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rtrb::RingBuffer;
    use tautline_bag::Topic;
    use tautline_transport::{Gid, Qos};

    #[test]
    fn what_came_last_for_late_joiners_stays_however_long_it_is() {
        let (to_channels, announced) = channel();
        let [one, other] = [1, 2].map(|n| Gid([n; 16]));
        to_channels.send(Announced::Topic(Topic { name: "/map".into(), ..Topic::default() })).unwrap();
        for gid in [one, other] {
            let qos = Qos::keep_last(2).transient_local();
            to_channels.send(Announced::Publisher { number: 0, gid, qos }).unwrap();
        }
        let plan = Plan {
            folder: PathBuf::new(),
            options: Options::default(),
            session: BTreeMap::new(),
            span_ns: 0,
            after_ns: 0,
            most_bags: None,
            offset_ns: 0,
        };
        let mut work = Work::new(plan, RingBuffer::new(1).1, announced, None);
        let mut kept = |publisher, log_ns, bytes| {
            work.scratch = vec![0; bytes];
            let head =
                Head { topic: 0, cdr_bytes: bytes as u32, sequence: 0, log_ns, publish_ns: 0, publisher };
            work.latch(head);
            let kept = work.latched.iter().flat_map(|latched| &latched.messages);
            let kept: Vec<_> = kept.map(|(head, _)| head.log_ns).collect();
            (kept, work.done.unlatched.get("/map").copied().unwrap_or(0))
        };
        assert_eq!(kept(one, 1, 10), (vec![1], 0));
        assert_eq!(kept(one, 2, LATCHED_BYTES), (vec![2], 1));
        assert_eq!(kept(one, 3, LATCHED_BYTES + 1), (vec![3], 2));
        assert_eq!(kept(other, 4, 10), (vec![4], 3));
    }
}
