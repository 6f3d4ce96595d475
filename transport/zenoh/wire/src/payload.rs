// SPDX-License-Identifier: MIT OR Apache-2.0
//! The encapsulation before a body, which identifies the CDR encoding. Bodies in shared memory have none.

use super::Malformed;

/// XCDR1, little-endian, no options: sent before every body.
pub const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

/// Checks the first bytes of a payload. The options, its last two bytes, are ignored: DDS puts the length of the padding after
/// the body there.
///
/// # Errors
/// [`Malformed::PayloadTooShort`], or [`Malformed::Encapsulation`] for big-endian, XCDR2 and parameter lists.
pub fn check_encapsulation(payload: &[u8]) -> Result<(), Malformed> {
    match payload {
        [0, 1, _, _, ..] => Ok(()),
        [_, _, _, _, ..] => Err(Malformed::Encapsulation),
        _ => Err(Malformed::PayloadTooShort),
    }
}
