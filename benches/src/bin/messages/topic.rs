// SPDX-License-Identifier: MIT OR Apache-2.0
//! A topic with its publisher and its subscription in this process.

use std::sync::atomic::{AtomicUsize, Ordering};

use tautline::msgs::cdr::{Fill, WriteError};
use tautline::{Limits, Message, Plain, Publisher, SendError};
use tautline_transport::{Participant, Qos, Sample, Subscription};

use crate::Result;

/// Nobody else measures in this domain.
const DOMAIN: u32 = 231;

pub struct Topic<T: Message> {
    publisher: Publisher<T>,
    subscription: Subscription<T>,
    _participant: Participant,
}

impl<T: Message> Topic<T> {
    pub fn open() -> Result<Self> {
        static TOPICS: AtomicUsize = AtomicUsize::new(0);
        let name = format!("/bench/messages/{}", TOPICS.fetch_add(1, Ordering::Relaxed));
        let participant = Participant::new(DOMAIN)?;
        let limits = Limits { message_bytes: 9 << 20, ..Limits::default() };
        let qos = Qos { depth: 1, ..Qos::default() };
        let subscription = participant.create_subscription(&name, qos, limits)?;
        let publisher = participant.create_publisher(&name, qos, limits)?;
        Ok(Self { publisher, subscription, _participant: participant })
    }

    pub fn write<'s>(
        &self,
        sizes: T::Sizes<'s>,
        write: impl for<'a> FnOnce(&mut T::Writer<'a, 's>) -> std::result::Result<(), WriteError>,
    ) -> Result<()>
    where
        T: Fill,
    {
        sent(self.publisher.loan_with(sizes)?.write(write)?.publish())
    }

    pub fn write_plain(&self, message: &T) -> Result<()>
    where
        T: Plain,
    {
        let mut loan = self.publisher.loan()?;
        *loan = *message;
        sent(loan.publish())
    }

    /// Reads the message that arrived, and then looks for another one, as a callback's stream does before it sleeps: this is
    /// when the memory goes back to the publisher.
    pub fn read(&self, read: impl FnOnce(&Sample<T>) -> u64) -> Result<u64> {
        let sample = self.subscription.try_take()?.ok_or("nothing arrived")?;
        let value = read(&sample);
        drop(sample);
        match self.subscription.try_take()? {
            None => Ok(value),
            Some(_) => Err("a message arrived twice".into()),
        }
    }
}

fn sent<L>(published: std::result::Result<(), SendError<L>>) -> Result<()> {
    published.map_err(|error| error.to_string().into())
}
