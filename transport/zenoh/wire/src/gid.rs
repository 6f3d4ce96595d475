// SPDX-License-Identifier: MIT OR Apache-2.0
//! An endpoint's GID, which each peer computes from the endpoint's token.

use super::Token;
use tautline_transport::Gid;
use xxhash_rust::xxh3::xxh3_128;

/// XXH3-128 of the token's text, including its suffix but not its note: the low 64 bits little-endian, then the high ones.
pub fn endpoint_gid(token: &Token) -> Gid {
    Gid(xxh3_128(token.without_note().to_string().as_bytes()).to_le_bytes())
}
