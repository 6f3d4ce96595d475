// SPDX-License-Identifier: MIT OR Apache-2.0
//! Records, whose lengths are untrusted: a parser that trusted them would reserve up to 4 GiB for a name.

use mcap::records::{Record, op};

/// A part of a record that has its length in front of it, in four bytes.
#[derive(Clone, Copy)]
enum Part {
    Bytes,
    /// Keys and values, each with its length. The MCAP library would read beyond them if a value is missing.
    Texts,
    /// Bytes whose length has eight bytes.
    Long,
    /// Two bytes of a channel's id and eight bytes of its number, repeated.
    Numbers,
}
use Part::{Bytes, Long, Numbers, Texts};

/// The parts of a record with a length of their own, each with the number of bytes before it. `None`: the kind is not read here.
fn parts(kind: u8) -> Option<&'static [(usize, Part)]> {
    Some(match kind {
        op::FOOTER | op::MESSAGE | op::DATA_END => &[],
        op::HEADER => &[(0, Bytes), (0, Bytes)],
        op::SCHEMA => &[(2, Bytes), (0, Bytes), (0, Bytes)],
        op::CHANNEL => &[(4, Bytes), (0, Bytes), (0, Texts)],
        op::CHUNK => &[(28, Bytes)],
        op::CHUNK_INDEX => &[(32, Numbers), (8, Bytes)],
        op::STATISTICS => &[(42, Numbers)],
        op::METADATA => &[(0, Bytes), (0, Texts)],
        op::ATTACHMENT => &[(16, Bytes), (0, Bytes), (0, Long)],
        op::ATTACHMENT_INDEX => &[(40, Bytes), (0, Bytes)],
        op::METADATA_INDEX => &[(16, Bytes)],
        _ => return None,
    })
}

/// Checks the lengths in a record and parses it. `None`: the kind is not read here.
pub fn parse(kind: u8, body: &[u8]) -> Result<Option<Record<'_>>, String> {
    let Some(parts) = parts(kind) else { return Ok(None) };
    let mut rest = body;
    for (before, part) in parts {
        let whole = rest.get(*before..).and_then(if let Long = part { split_long } else { split });
        let Some((bytes, behind)) = whole else {
            return Err("a record says that it is longer than it is".to_owned());
        };
        let mut texts = if let Texts = part { bytes } else { &[] };
        while !texts.is_empty() {
            let value = split(texts).and_then(|(_, behind_key)| split(behind_key));
            (_, texts) = value.ok_or("a key or a value is longer than what it is in")?;
        }
        if matches!(part, Numbers) && bytes.len() % 10 != 0 {
            return Err("numbers of channels end in the middle of one".to_owned());
        }
        rest = behind;
    }
    if kind == op::ATTACHMENT && rest.len() < 4 {
        return Err("an attachment ends before its checksum".to_owned());
    }
    mcap::parse_record(kind, body).map(Some).map_err(|error| error.to_string())
}

/// The bytes whose length is in front of them, and the bytes behind them.
fn split(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = bytes.split_first_chunk()?;
    rest.split_at_checked(u32::from_le_bytes(*length) as usize)
}

fn split_long(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = bytes.split_first_chunk()?;
    rest.split_at_checked(u64::from_le_bytes(*length).try_into().ok()?)
}

/// Iterates over the complete records, as kind and body. The remaining bytes are left in the field.
pub struct Records<'b>(pub &'b [u8]);

impl<'b> Iterator for Records<'b> {
    type Item = (u8, &'b [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        let (kind, rest) = self.0.split_first()?;
        let (length, rest) = rest.split_first_chunk()?;
        let (body, behind) = rest.split_at_checked(u64::from_le_bytes(*length).try_into().ok()?)?;
        self.0 = behind;
        Some((*kind, body))
    }
}
