// SPDX-License-Identifier: MIT OR Apache-2.0
//! What travels with every sample.

use iceoryx2::prelude::ZeroCopySend;
use std::fmt;

/// Global identifier of a publisher, unique among all of a domain: 16 bytes, as in the rmw_zenoh attachment.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, ZeroCopySend)]
#[repr(C)]
pub struct Gid(pub [u8; 16]);

impl Gid {
    pub(crate) fn words(self) -> [u64; 2] {
        let value = u128::from_le_bytes(self.0);
        [value as u64, (value >> 64) as u64]
    }

    pub(crate) fn from_words([low, high]: [u64; 2]) -> Self {
        Gid((u128::from(low) | u128::from(high) << 64).to_le_bytes())
    }
}

impl fmt::Debug for Gid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:032x}", u128::from_be_bytes(self.0))
    }
}

/// Where a message comes from and when it was sent. Of a message from another host, number, time and publisher are what
/// they were there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct MessageInfo {
    /// Counts the publisher's messages, from 1.
    pub sequence_number: u64,
    /// When the message was published, by the system's clock: nanoseconds since 1970.
    pub source_timestamp_ns: i64,
    /// When the message appeared on this host, on `CLOCK_MONOTONIC`: the release of its callback.
    pub released_ns: u64,
    /// Who published it.
    pub publisher_gid: Gid,
}

/// The user header of every iceoryx2 sample. In another process's hands: a claim, but one of which every value is
/// harmless: a wrong number is a wrong count.
#[derive(Clone, Copy, Debug, Default, ZeroCopySend)]
#[type_name("tautline/SampleHeader/3")]
#[repr(C)]
pub(crate) struct SampleHeader {
    /// Counts the samples of the port that sent this one, from 1: what losses are counted from.
    pub(crate) sequence_number: u64,
    /// That port.
    pub(crate) gid: Gid,
    pub(crate) released_ns: u64,
    /// Length of the body as CDR, in bytes: a plain type's memory without its trailing padding. The payload is this,
    /// rounded up to 8.
    pub(crate) body_bytes: u64,
    /// When it is no longer delivered, on `CLOCK_MONOTONIC`; [`NEVER`] without a lifespan, [`END_OF_HISTORY`] of what is none.
    pub(crate) expires_ns: u64,
    pub(crate) source_timestamp_ns: i64,
    /// As published first: those of the port, unless the message came from another host.
    pub(crate) source_sequence_number: u64,
    pub(crate) source_gid: Gid,
}

/// What `expires_ns` says of a sample without a lifespan.
pub(crate) const NEVER: u64 = u64::MAX;

/// What it says of a header without a payload: a publisher's history ends here.
pub(crate) const END_OF_HISTORY: u64 = 0;

impl SampleHeader {
    /// What identifies the message in a trace; `address` is its body's.
    pub(crate) fn trace_id(&self, address: usize) -> tautline_trace::MessageId {
        tautline_trace::MessageId {
            sequence_number: self.sequence_number,
            source_timestamp_ns: self.source_timestamp_ns,
            gid: self.gid.words(),
            address,
        }
    }

    pub(crate) fn info(&self) -> MessageInfo {
        MessageInfo {
            sequence_number: self.source_sequence_number,
            source_timestamp_ns: self.source_timestamp_ns,
            released_ns: self.released_ns,
            publisher_gid: self.source_gid,
        }
    }
}
