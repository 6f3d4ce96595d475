// SPDX-License-Identifier: MIT OR Apache-2.0
//! The header of every sample.

use std::fmt;

/// Global identifier of a publisher, subscription, client or server, unique in a domain: 16 bytes, as in the rmw_zenoh
/// attachment.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
#[repr(C)]
pub struct Gid(pub [u8; 16]);

impl Gid {
    /// The gid of the port `number` of a participant.
    pub(crate) fn of(participant: u64, number: u64) -> Self {
        Gid::from_words([participant, number])
    }

    /// For a port on this host: its participant's id, and its number there.
    pub(crate) fn words(self) -> [u64; 2] {
        let value = u128::from_le_bytes(self.0);
        [value as u64, (value >> 64) as u64]
    }

    pub(crate) fn from_words([low, high]: [u64; 2]) -> Self {
        Gid((u128::from(low) | u128::from(high) << 64).to_le_bytes())
    }

    /// For a port on this host: its participant's [`id`](crate::Participant::id).
    pub fn participant(self) -> u64 {
        self.words()[0]
    }

    /// For a port on this host: its number among the ports of its participant.
    pub(crate) fn number(self) -> u64 {
        self.words()[1]
    }
}

impl fmt::Debug for Gid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:032x}", u128::from_be_bytes(self.0))
    }
}

/// The origin of a message and the time when it was sent. For a message from another host, number, time and publisher
/// are the original ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct MessageInfo {
    /// The publisher's sequence number, from 1.
    pub sequence_number: u64,
    /// When the message was published, by the system's clock: nanoseconds since 1970.
    pub source_timestamp_ns: i64,
    /// When the message appeared on this host, on `CLOCK_MONOTONIC`: the release of its callback.
    pub released_ns: u64,
    /// Its publisher.
    pub publisher_gid: Gid,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SampleKind {
    Message,
    /// In place of a response: this request gets no response.
    NoAnswer,
}

/// The encapsulation of serialized CDR: little-endian, no options.
pub(crate) const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];
/// Replaces [`ENCAPSULATION`] in a sample that is not a message: no CDR has this encapsulation.
const NO_ANSWER: [u8; 4] = [0xFF; 4];

/// The beginning of a sample. A header that another process can write is untrusted, but every value is harmless: a wrong number
/// only causes a wrong count.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(64))]
pub(crate) struct SampleHeader {
    /// Counts the samples of the port that sent this one, from 1. Losses are computed from it.
    pub(crate) sequence_number: u64,
    pub(crate) released_ns: u64,
    /// When it is no longer delivered, on `CLOCK_MONOTONIC`; [`NEVER`] without a lifespan.
    pub(crate) expires_ns: u64,
    pub(crate) source_timestamp_ns: i64,
    /// This number and `source_gid` are those of the original publisher: the port's own, unless the message came from another host.
    pub(crate) source_sequence_number: u64,
    pub(crate) source_gid: Gid,
    /// Length of the body.
    pub(crate) len_bytes: u32,
    /// Directly before the body, so that both together are the serialized message: [`ENCAPSULATION`]. Another value marks another kind
    /// of sample.
    pub(crate) encapsulation: [u8; 4],
}

pub(crate) const HEADER_BYTES: usize = size_of::<SampleHeader>();

/// The `expires_ns` of a sample without a lifespan.
pub(crate) const NEVER: u64 = u64::MAX;

impl SampleHeader {
    /// Sets the sample's kind and the length of its body as CDR: of a plain type, its memory without trailing padding. The length is at
    /// most [`Limits::MAX_MESSAGE_BYTES`](crate::Limits::MAX_MESSAGE_BYTES).
    pub(crate) fn set_body(&mut self, len_bytes: usize, kind: SampleKind) {
        self.len_bytes = u32::try_from(len_bytes).unwrap_or(u32::MAX);
        self.encapsulation = match kind {
            SampleKind::Message => ENCAPSULATION,
            SampleKind::NoAnswer => NO_ANSWER,
        };
    }

    /// The length of the body, which is untrusted, and the kind of the sample.
    pub(crate) fn body(&self) -> (usize, SampleKind) {
        let is_message = self.encapsulation == ENCAPSULATION;
        (self.len_bytes as usize, if is_message { SampleKind::Message } else { SampleKind::NoAnswer })
    }

    /// The identity of the message in a trace; `port` sent it, and `address` is that of its body.
    pub(crate) fn trace_id(&self, port: Gid, address: usize) -> tautline_trace::MessageId {
        tautline_trace::MessageId {
            sequence_number: self.sequence_number,
            source_timestamp_ns: self.source_timestamp_ns,
            gid: port.words(),
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

const _: () = assert!(HEADER_BYTES == 64);
const _: () =
    assert!(std::mem::offset_of!(SampleHeader, encapsulation) + ENCAPSULATION.len() == HEADER_BYTES);
