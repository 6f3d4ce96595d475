// SPDX-License-Identifier: MIT OR Apache-2.0
//! A topic with its publisher and its subscription in this process.

use std::sync::atomic::{AtomicUsize, Ordering};

use tautline::msgs::cdr::{self, Fill, WriteError};
use tautline::msgs::{Body, Message, Plain};
use tautline_transport::{Limits, Participant, Qos, RawPublisher, RawSubscription, TopicType};

use crate::Result;

/// Nobody else measures in this domain.
const DOMAIN: u32 = 231;

pub struct Topic {
    publisher: RawPublisher,
    subscription: RawSubscription,
    _participant: Participant,
}

impl Topic {
    pub fn open<T: Message>() -> Result<Self> {
        static TOPICS: AtomicUsize = AtomicUsize::new(0);
        let name = format!("/bench/messages/{}", TOPICS.fetch_add(1, Ordering::Relaxed));
        let participant = Participant::new(DOMAIN)?;
        let ty = TopicType::new(T::TYPE_NAME);
        let limits = Limits { message_bytes: 9 << 20, ..Limits::default() };
        let qos = Qos { depth: 1, ..Qos::default() };
        let subscription = participant.create_raw_subscription(&name, &ty, qos, limits)?;
        let publisher = participant.create_raw_publisher(&name, &ty, qos, limits)?;
        Ok(Self { publisher, subscription, _participant: participant })
    }

    pub fn write<T: Message + Fill>(
        &self,
        sizes: T::Sizes<'static>,
        write: impl for<'a> FnOnce(&mut T::Writer<'a, 'static>) -> std::result::Result<(), WriteError>,
    ) -> Result<()> {
        let mut loan = self.publisher.loan(cdr::sized_len::<T>(sizes))?;
        cdr::fill::<T>(sizes, &mut loan, write)?;
        Ok(loan.publish().map_err(|error| error.to_string())?)
    }

    pub fn read<T: Message>(&self, read: &mut impl for<'a> FnMut(T::View<'a>) -> u64) -> Result<u64> {
        let sample = self.subscription.try_take()?.ok_or("nothing arrived")?;
        Ok(read(T::view(Body::new(sample.body(), sample.body().len())?)?))
    }

    pub fn write_plain<T: Message + Plain>(&self, message: &T) -> Result<()> {
        let mut loan = self.publisher.loan(T::CDR_SIZE)?;
        message.encode(&mut loan)?;
        Ok(loan.publish().map_err(|error| error.to_string())?)
    }

    pub fn read_plain<T: Message>(&self) -> Result<u64> {
        let sample = self.subscription.try_take()?.ok_or("nothing arrived")?;
        T::view(Body::new(sample.body(), sample.body().len())?)?;
        Ok(sample.body().len() as u64)
    }
}
