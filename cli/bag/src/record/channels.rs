// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bag's topics as the observers announce them. A publisher that keeps messages for late joiners has a topic of its own, so that
//! `taut play` keeps for late joiners what each publisher kept.

use super::event::Events;
use super::observers::Announced;
use crate::ring::Head;
use std::collections::HashMap;
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};
use tautline_bag::{BagError, PUBLISHER, Stamp, Topic, TopicId, Writer};
use tautline_transport::{Durability, Gid, Qos};

/// How long an announcement is waited for. A publisher that ends before the next refresh of the graph is never announced.
const PATIENCE: Duration = Duration::from_millis(500);
/// Publishers of a topic that have a topic of their own; others share one.
const MOST_PUBLISHERS: usize = 1000;

/// The topics of a bag, in the order in which they become known.
pub struct Channels {
    announced: Receiver<Announced>,
    observers: Vec<Observed>,
    list: Vec<Channel>,
    /// Announcements are not waited for before this time.
    waits_from: Instant,
}

/// A topic of the bag.
pub struct Channel {
    pub topic: Topic,
    /// The number of messages kept for late joiners.
    pub kept: usize,
}

/// What is known of an observer.
#[derive(Default)]
struct Observed {
    topic: Topic,
    events: Option<Events>,
    /// The channel of all publishers that do not keep messages for late joiners.
    shared: Option<usize>,
    /// The channel of publishers that were not announced, if there is no other.
    unannounced: Option<usize>,
    /// The channels of the other publishers. `None` if the messages are events of a service, which have one channel.
    publishers: Option<HashMap<Gid, usize>>,
}

impl Channels {
    pub fn new(announced: Receiver<Announced>) -> Self {
        Channels { announced, observers: Vec::new(), list: Vec::new(), waits_from: Instant::now() }
    }

    /// The channels known so far.
    pub fn list(&self) -> &[Channel] {
        &self.list
    }

    /// Adds the channels that a bag does not have yet. `ids` has an entry for each channel that it has.
    pub fn write(&self, writer: &mut Writer, ids: &mut Vec<TopicId>) -> Result<(), BagError> {
        for channel in &self.list[ids.len()..] {
            ids.push(writer.add_topic(channel.topic.clone())?);
        }
        Ok(())
    }

    /// Writes a message, and before it the channels that the bag does not have yet. `Some(false)` if its bytes are not a request of the
    /// service; `None` if the recorder ended before it announced the channel.
    pub fn write_message(
        &mut self,
        writer: &mut Writer,
        ids: &mut Vec<TopicId>,
        head: &Head,
        cdr: &[u8],
    ) -> Result<Option<bool>, BagError> {
        let Some(channel) = self.of(head) else { return Ok(None) };
        self.write(writer, ids)?;
        let Head { log_ns, publish_ns, .. } = *head;
        let stamp = Stamp { sequence: head.sequence as u32, log_ns, publish_ns };
        match self.observers[head.topic as usize].events.as_ref().map(|events| events.written(cdr)) {
            None => writer.write(ids[channel], stamp, cdr)?,
            Some(Ok(event)) => writer.write(ids[channel], stamp, &event)?,
            Some(Err(_)) => return Ok(Some(false)),
        }
        Ok(Some(true))
    }

    /// Adds what was announced since the last call.
    pub fn refresh(&mut self) {
        while let Ok(announced) = self.announced.try_recv() {
            self.add(announced);
        }
    }

    /// The index in the [list](Self::list) of a message's channel. `None` if the recorder ended before it announced the channel.
    pub fn of(&mut self, head: &Head) -> Option<usize> {
        let number = head.topic as usize;
        while self.observers.len() <= number {
            // An observer is announced before its first message.
            let announced = self.announced.recv().ok()?;
            self.add(announced);
        }
        let mut since = None;
        while let Some(publishers) = &self.observers[number].publishers {
            if let Some(channel) = publishers.get(&head.publisher) {
                return Some(*channel);
            }
            let now = Instant::now();
            let left = PATIENCE.saturating_sub(now.duration_since(*since.get_or_insert(now)));
            let left = if now < self.waits_from { Duration::ZERO } else { left };
            match self.announced.recv_timeout(left) {
                Ok(announced) => self.add(announced),
                Err(_) => {
                    // Many short-lived publishers must not stop the writer again and again.
                    self.waits_from = now + 20 * PATIENCE;
                    return Some(self.unannounced(number));
                }
            }
        }
        Some(self.shared(number))
    }

    fn add(&mut self, announced: Announced) {
        match announced {
            Announced::Topic(topic) => {
                let publishers = Some(HashMap::new());
                self.observers.push(Observed { topic, publishers, ..Observed::default() });
            }
            Announced::Requests(topic, events) => {
                let (events, shared) = (Some(events), Some(self.list.len()));
                self.list.push(Channel { topic: topic.clone(), kept: 0 });
                self.observers.push(Observed { topic, events, shared, ..Observed::default() });
            }
            Announced::Responses(requests) => {
                let Observed { topic, shared, .. } = &self.observers[requests];
                let (topic, shared) = (topic.clone(), *shared);
                self.observers.push(Observed { topic, shared, ..Observed::default() });
            }
            Announced::Publisher { number, gid, qos } => self.publisher(number, gid, &qos),
        }
    }

    fn publisher(&mut self, number: usize, gid: Gid, qos: &Qos) {
        let observed = &self.observers[number];
        let Some(publishers) = observed.publishers.as_ref().filter(|known| !known.contains_key(&gid)) else {
            return;
        };
        let is_kept = qos.durability == Durability::TransientLocal;
        let channel = if is_kept && publishers.len() < MOST_PUBLISHERS {
            let name = gid.0.iter().map(|byte| format!("{byte:02x}")).collect();
            let metadata = [(PUBLISHER.to_owned(), name)].into();
            let topic = Topic { qos: crate::offered_qos::write(qos), metadata, ..observed.topic.clone() };
            self.list.push(Channel { topic, kept: qos.depth });
            self.list.len() - 1
        } else {
            self.shared(number)
        };
        if let Some(publishers) = &mut self.observers[number].publishers {
            publishers.insert(gid, channel);
        }
    }

    fn shared(&mut self, number: usize) -> usize {
        let observed = &mut self.observers[number];
        *observed.shared.get_or_insert_with(|| {
            let topic = observed.topic.clone();
            self.list.push(Channel { topic, kept: 0 });
            self.list.len() - 1
        })
    }

    /// The channel of publishers that were never announced. It has the QoS of those that were.
    fn unannounced(&mut self, number: usize) -> usize {
        let observed = &mut self.observers[number];
        if let Some(shared) = observed.shared {
            return shared;
        }
        *observed.unannounced.get_or_insert_with(|| {
            let mut topic = observed.topic.clone();
            let known = observed.publishers.iter().flat_map(HashMap::values);
            topic.qos = known.map(|channel| &*self.list[*channel].topic.qos).collect();
            let qos = crate::offered_qos::read(&topic.qos).unwrap_or_default();
            let kept = if qos.durability == Durability::TransientLocal { qos.depth } else { 0 };
            self.list.push(Channel { topic, kept });
            self.list.len() - 1
        })
    }
}
