// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut msg decode`: bytes to values.

use crate::completions;
use crate::find::{FindError, Finder};
use crate::verb::{Failure, Outcome};
use clap::Args;
use std::fs;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tautline_schema::{DynamicMessage, Endian};

#[derive(Args, Clone, Debug)]
pub struct DecodeArgs {
    /// The message's type, as for show
    #[arg(long = "type", value_name = "TYPE", add = completions::interfaces())]
    name: String,
    /// The bytes as hexadecimal text
    #[arg(long, value_name = "HEX", conflicts_with = "file")]
    hex: Option<String>,
    /// The file with the bytes [default: standard input]
    #[arg(value_name = "FILE")]
    file: Option<PathBuf>,
    /// The bytes are a little-endian body without the 4 bytes of encapsulation, as in shared memory
    #[arg(long)]
    body: bool,
}

/// The values as YAML, or JSON in one line.
pub fn run(finder: &mut Finder, args: &DecodeArgs, json: bool) -> Outcome<String> {
    let schema = Arc::new(finder.schema(&args.name)?);
    let bytes = match (&args.hex, &args.file) {
        (Some(hex), _) => unhex(hex)?,
        (None, Some(path)) if path != Path::new("-") => {
            fs::read(path).map_err(|source| FindError::Read { path: path.clone(), source })?
        }
        _ => {
            let mut bytes = Vec::new();
            let read = io::stdin().read_to_end(&mut bytes);
            read.map_err(|source| FindError::Read { path: "standard input".into(), source })?;
            bytes
        }
    };
    let message = if args.body {
        DynamicMessage::from_body(&schema, &bytes, Endian::Little)?
    } else {
        DynamicMessage::from_cdr(&schema, &bytes)?
    };
    if message.trailing_bytes() > 0 {
        eprintln!("taut: {} bytes follow the last field", message.trailing_bytes());
    }
    Ok(if json { message.to_json() + "\n" } else { message.to_string() })
}

fn unhex(text: &str) -> Outcome<Vec<u8>> {
    let error = || {
        let text: String = text.chars().take(40).collect();
        Failure::unusable(format!(
            "`{text}` is not hexadecimal text: it needs pairs of digits 0-9 a-f, spaces between bytes allowed"
        ))
    };
    let digits: Vec<char> = text.chars().filter(|character| !character.is_whitespace()).collect();
    let pairs = digits.chunks(2).map(|pair| match pair {
        [high, low] => u8::try_from(high.to_digit(16)? << 4 | low.to_digit(16)?).ok(),
        _ => None,
    });
    pairs.collect::<Option<_>>().ok_or_else(error)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_given_as_text() {
        assert_eq!(unhex("00 01ff\n").unwrap(), [0, 1, 255]);
        assert!(unhex("0").is_err() && unhex("0g").is_err() && unhex("+1").is_err());
    }

    #[test]
    fn a_message_is_printed() {
        let args = DecodeArgs {
            name: "builtin_interfaces/Time".to_owned(),
            hex: Some("00010000 01000000 02000000".to_owned()),
            file: None,
            body: false,
        };
        assert_eq!(run(&mut Finder::new(&[]), &args, false).unwrap(), "sec: 1\nnanosec: 2\n");
        assert_eq!(run(&mut Finder::new(&[]), &args, true).unwrap(), "{\"sec\":1,\"nanosec\":2}\n");
    }
}
