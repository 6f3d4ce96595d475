// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a message contains: its number, in each 8 bytes of a touched payload, in the first 8 of an untouched one.

use std::mem::MaybeUninit;

use crate::Result;
use crate::plan::Payload;

/// Ends the exchange.
pub const STOP: u64 = u64::MAX;
/// In an answer: the wake-up for the question was lost.
pub const LATE: u64 = 1 << 63;

/// Writes message `number` to a payload of 8-byte aligned memory.
pub fn write(out: &mut [MaybeUninit<u8>], payload: Payload, number: u64) {
    let end = if payload.touched { out.len() } else { 8 };
    let (words, _) = out[..end].as_chunks_mut::<8>();
    words.fill(number.to_ne_bytes().map(MaybeUninit::new));
}

/// Reads the number, going through all of a touched payload.
pub fn read(bytes: &[u8], payload: Payload) -> Result<u64> {
    let (words, _) = bytes.as_chunks::<8>();
    let number = words.first().copied().map(u64::from_ne_bytes).ok_or("an empty message arrived")?;
    let words = if payload.touched { words } else { &words[..1] };
    let difference = words.iter().fold(0, |sum, word| sum | (u64::from_ne_bytes(*word) ^ number));
    if bytes.len() != payload.bytes || difference != 0 {
        return Err(format!("message {number} of {} bytes arrived damaged", bytes.len()).into());
    }
    Ok(number)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn damage_is_seen_where_the_payload_is_touched() {
        for touched in [false, true] {
            let payload = Payload { bytes: 64, touched };
            let mut memory = [MaybeUninit::new(0); 64];
            write(&mut memory, payload, 7);
            // SAFETY: every byte was initialised above.
            let mut bytes = memory.map(|byte| unsafe { byte.assume_init() });
            assert!(read(&bytes, payload).is_ok_and(|number| number == 7));
            bytes[63] ^= 1;
            assert_eq!(read(&bytes, payload).is_err(), touched);
            assert!(read(&bytes[..56], payload).is_err());
        }
    }
}
