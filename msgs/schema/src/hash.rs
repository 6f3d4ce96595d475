// SPDX-License-Identifier: MIT OR Apache-2.0

use std::fmt;
use std::str::FromStr;

use sha2::{Digest, Sha256};

use crate::SchemaError;

/// The hash of a type and of all types it consists of: REP 2011's RIHS01. Defaults, constants and comments are no
/// part of it.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TypeHash([u8; 32]);

impl TypeHash {
    /// The hash of a type description's text.
    pub(crate) fn of(text: &str) -> Self {
        Self(Sha256::digest(text).into())
    }

    /// The SHA-256.
    pub fn as_bytes(&self) -> &[u8; 32] {
        &self.0
    }
}

/// `RIHS01_` and 64 hexadecimal digits.
impl fmt::Display for TypeHash {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(PREFIX)?;
        self.0.iter().try_for_each(|byte| write!(formatter, "{byte:02x}"))
    }
}

impl fmt::Debug for TypeHash {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, formatter)
    }
}

impl FromStr for TypeHash {
    type Err = SchemaError;

    fn from_str(text: &str) -> Result<Self, SchemaError> {
        let parse = || {
            let digits = text.strip_prefix(PREFIX)?.as_bytes();
            let mut hash = [0; 32];
            if digits.len() != 64 {
                return None;
            }
            for (byte, pair) in hash.iter_mut().zip(digits.chunks_exact(2)) {
                *byte = digit(pair[0])? << 4 | digit(pair[1])?;
            }
            Some(Self(hash))
        };
        parse().ok_or_else(|| SchemaError::Hash { text: text.to_owned() })
    }
}

const PREFIX: &str = "RIHS01_";

fn digit(character: u8) -> Option<u8> {
    match character {
        b'0'..=b'9' => Some(character - b'0'),
        b'a'..=b'f' => Some(character - b'a' + 10),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_text_form_goes_both_ways() {
        let hash = TypeHash::of("abc");
        let text = hash.to_string();
        assert_eq!(text, "RIHS01_ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
        assert_eq!(text.parse::<TypeHash>().unwrap(), hash);
        for text in ["", "RIHS01_", "RIHS02_ba", &text.to_uppercase(), &format!("{text}0"), "RIHS01_é"] {
            assert!(text.parse::<TypeHash>().is_err(), "{text}");
        }
    }
}
