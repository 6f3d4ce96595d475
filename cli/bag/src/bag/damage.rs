// SPDX-License-Identifier: MIT OR Apache-2.0
//! Damaged parts in words.

use std::path::{Path, PathBuf};
use taut_cli::verb::{Failure, Outcome};
use tautline_bag::Damage;

/// A damaged part and its place.
pub fn placed(path: &Path, Damage { offset, what }: &Damage) -> String {
    format!("{}: at byte {offset}: {what}", path.display())
}

/// The number of damaged parts besides the first, in words.
pub fn more(damages: u64) -> String {
    match damages {
        0 | 1 => String::new(),
        _ => format!(", and {} more", damages - 1),
    }
}

/// Fails if there was damage; `damages` is the number of damaged parts.
pub fn whole(damage: &[(PathBuf, Damage)], damages: u64) -> Outcome {
    let Some((path, damage)) = damage.first() else { return Ok(()) };
    Err(Failure::no(format!("{}{}; what is whole was taken", placed(path, damage), more(damages))))
}
