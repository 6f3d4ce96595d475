// SPDX-License-Identifier: MIT OR Apache-2.0
//! The content of a message: its number and send time, and the number again in each further 8 bytes of a payload that is written
//! completely.

use std::mem::MaybeUninit;

use crate::Result;

/// The first words of every message, also to C++.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stamp {
    /// From 1; 0 while a flow waits for its receivers.
    pub number: u64,
    /// `CLOCK_MONOTONIC`, before memory for the message is requested.
    pub sent_ns: u64,
}

impl Stamp {
    /// Its length.
    pub const BYTES: usize = 16;

    /// Writes it, and the rest if the payload is written completely.
    ///
    /// # Panics
    /// If there are fewer than [`BYTES`](Self::BYTES).
    pub fn write(self, out: &mut [u8], whole: bool) {
        let (words, _) = out.as_chunks_mut::<8>();
        self.write_words(words, whole, |word| word);
    }

    /// Like [`write`](Self::write), to uninitialised memory.
    ///
    /// # Panics
    /// If there are fewer than [`BYTES`](Self::BYTES).
    pub fn write_uninit(self, out: &mut [MaybeUninit<u8>], whole: bool) {
        let (words, _) = out.as_chunks_mut::<8>();
        self.write_words(words, whole, |word| word.map(MaybeUninit::new));
    }

    /// Writes all of a message with non-temporal stores, which take no line from another core's caches; where the processor has none that
    /// are always there, as [`write_uninit`](Self::write_uninit).
    ///
    /// # Panics
    /// If there are fewer than [`BYTES`](Self::BYTES).
    pub fn write_streaming(self, out: &mut [MaybeUninit<u8>]) {
        #[cfg(target_arch = "x86_64")]
        {
            use std::arch::x86_64::{_mm_set1_epi64x, _mm_sfence, _mm_stream_si128};
            let (blocks, rest) = out.as_chunks_mut::<16>();
            assert!(blocks.as_ptr().addr().is_multiple_of(16), "a message begins at a multiple of 16");
            // SAFETY: every x86-64 has SSE2; each block is this call's to write, and lies at a multiple of 16.
            unsafe {
                let word = _mm_set1_epi64x(self.number.cast_signed());
                blocks[1..].iter_mut().for_each(|block| _mm_stream_si128(block.as_mut_ptr().cast(), word));
                _mm_sfence();
            }
            self.write_uninit(&mut blocks.as_flattened_mut()[..16], false);
            rest.fill(MaybeUninit::new(0));
        }
        #[cfg(not(target_arch = "x86_64"))]
        self.write_uninit(out, true);
    }

    /// A completely written message, each byte once.
    ///
    /// # Panics
    /// If `bytes` is less than [`BYTES`](Self::BYTES) or not a multiple of 8.
    pub fn written(self, bytes: usize) -> Vec<u8> {
        assert!(bytes >= Self::BYTES && bytes.is_multiple_of(8), "a message of {bytes} bytes");
        let mut message = Vec::with_capacity(bytes);
        self.write_uninit(&mut message.spare_capacity_mut()[..bytes], true);
        // SAFETY: whole words, all written.
        unsafe { message.set_len(bytes) };
        message
    }

    fn write_words<T: Clone>(self, words: &mut [T], whole: bool, word: impl Fn([u8; 8]) -> T) {
        if whole {
            words[2..].fill(word(self.number.to_ne_bytes()));
        }
        words[0] = word(self.number.to_ne_bytes());
        words[1] = word(self.sent_ns.to_ne_bytes());
    }

    /// Reads it, and all of a payload that is read completely.
    ///
    /// # Errors
    /// A message that is too short or damaged.
    pub fn read(bytes: &[u8], whole: bool) -> Result<Stamp> {
        let (words, _) = bytes.as_chunks::<8>();
        let [number, sent_ns, rest @ ..] = words else {
            return Err(format!("a message of {} bytes arrived", bytes.len()).into());
        };
        let stamp = Stamp { number: u64::from_ne_bytes(*number), sent_ns: u64::from_ne_bytes(*sent_ns) };
        let rest = if whole { rest } else { &[] };
        let difference = rest.iter().fold(0, |sum, word| sum | (u64::from_ne_bytes(*word) ^ stamp.number));
        if difference != 0 {
            return Err(format!("message {} of {} bytes arrived damaged", stamp.number, bytes.len()).into());
        }
        Ok(stamp)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_whole_is_read_whole() {
        let stamp = Stamp { number: 7, sent_ns: 8 };
        for bytes in [16, 64, 4096] {
            let message = stamp.written(bytes);
            assert_eq!((message.len(), Stamp::read(&message, true).unwrap()), (bytes, stamp));
            let mut streamed = vec![[MaybeUninit::new(0_u128)]; bytes / 16];
            // SAFETY: the same memory as bytes, which are written next.
            let streamed: &mut [MaybeUninit<u8>] =
                unsafe { std::slice::from_raw_parts_mut(streamed.as_mut_ptr().cast(), bytes) };
            stamp.write_streaming(streamed);
            // SAFETY: every byte has a value.
            let streamed = unsafe { streamed.assume_init_ref() };
            assert_eq!(streamed, message);
        }
    }

    #[test]
    fn damage_is_seen_where_the_payload_is_read_whole() {
        for whole in [false, true] {
            let stamp = Stamp { number: 7, sent_ns: 8 };
            // Not aligned to words.
            let mut memory = [0; 65];
            stamp.write(&mut memory[1..], whole);
            assert_eq!(Stamp::read(&memory[1..], whole).unwrap(), stamp);
            memory[64] ^= 1;
            assert_eq!(Stamp::read(&memory[1..], whole).is_err(), whole);
            assert!(Stamp::read(&memory[..15], whole).is_err());
        }
    }
}
