// SPDX-License-Identifier: MIT OR Apache-2.0
//! The attachment of a sample: 33 bytes, little-endian.

use super::Malformed;
use tautline_transport::Gid;

/// Sequence number, time stamp and publisher of a sample; for a request, number and client, which the reply repeats.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct Attachment {
    /// Counts the publisher's samples; rmw_zenoh starts with 1, other peers with 0.
    pub sequence_number: i64,
    /// When the sample was published, by the sender's clock: nanoseconds since 1970.
    pub source_timestamp_ns: i64,
    /// The publisher.
    pub gid: Gid,
}

impl Attachment {
    /// Length on the wire.
    pub const BYTES: usize = 33;

    /// The bytes to send.
    pub fn encode(&self) -> [u8; Self::BYTES] {
        let mut bytes = [0; Self::BYTES];
        bytes[..8].copy_from_slice(&self.sequence_number.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.source_timestamp_ns.to_le_bytes());
        bytes[16] = 16;
        bytes[17..].copy_from_slice(&self.gid.0);
        bytes
    }

    /// Parses an attachment from a peer.
    ///
    /// # Errors
    /// [`Malformed::Attachment`].
    pub fn parse(bytes: &[u8]) -> Result<Self, Malformed> {
        let (head, gid) = bytes.split_at_checked(17).ok_or(Malformed::Attachment)?;
        let ([number, stamp], [16]) = head.as_chunks::<8>() else { return Err(Malformed::Attachment) };
        Ok(Attachment {
            sequence_number: i64::from_le_bytes(*number),
            source_timestamp_ns: i64::from_le_bytes(*stamp),
            gid: Gid(gid.try_into().map_err(|_| Malformed::Attachment)?),
        })
    }
}
