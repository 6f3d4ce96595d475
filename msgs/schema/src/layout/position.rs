// SPDX-License-Identifier: MIT OR Apache-2.0
//! A number of bytes, as far as it is known.

use serde::Serialize;
use std::fmt;

/// A number of bytes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(untagged)]
pub enum Size {
    /// The same in every message.
    Fixed(usize),
    /// Depends on the message. `|x|` is the length of string `x` in bytes (of a `wstring` in UTF-16 units) or the
    /// number of elements of sequence `x`, `bytes(x)` the bytes of all its elements, `end(x)` where field `x` ends.
    /// `upN(..)` rounds up to a multiple of N, `padN` are the bytes from where one is to a multiple of N; neither is
    /// there before the elements of an empty sequence.
    Formula(String),
}

impl fmt::Display for Size {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Fixed(size) => write!(formatter, "{size}"),
            Self::Formula(formula) => formatter.write_str(formula),
        }
    }
}

/// A place in a body: `formula + plus` bytes from the start, and modulo `multiple` it is `residue`.
pub struct Position {
    formula: String,
    plus: usize,
    pub multiple: usize,
    pub residue: usize,
    /// Bytes are not counted from the start of the body, so that nothing can be rounded up.
    relative: bool,
}

/// Formulas are for people. Longer ones are cut off.
const MAX_FORMULA: usize = 400;

impl Position {
    pub fn start() -> Self {
        Self { formula: String::new(), plus: 0, multiple: 8, residue: 0, relative: false }
    }

    /// The same place, from which bytes are now counted.
    pub fn relative(&self) -> Self {
        Self { relative: true, multiple: self.multiple, residue: self.residue, ..Self::start() }
    }

    pub fn size(&self) -> Size {
        if self.formula.is_empty() { Size::Fixed(self.plus) } else { Size::Formula(self.text()) }
    }

    fn text(&self) -> String {
        match self.plus {
            0 => self.formula.clone(),
            plus => format!("{} + {plus}", self.formula),
        }
    }

    /// Adds a known number of bytes.
    pub fn add(&mut self, bytes: usize) {
        self.plus += bytes;
        self.residue = (self.residue + bytes) % self.multiple;
    }

    /// Adds a number of bytes that is not known but a multiple of `multiple`.
    pub fn variable(&mut self, term: &str, multiple: usize) {
        self.term(term);
        self.multiple = self.multiple.min(multiple);
        self.residue %= self.multiple;
    }

    fn term(&mut self, term: &str) {
        if self.formula.is_empty() {
            self.formula = term.to_owned();
        } else if self.formula.len() < MAX_FORMULA {
            self.formula = format!("{} + {term}", self.formula);
        } else {
            self.cut_off();
        }
    }

    fn cut_off(&mut self) {
        if !self.formula.ends_with("...") {
            self.formula.push_str(" + ...");
        }
    }

    pub fn align(&mut self, align: usize) {
        if self.multiple >= align {
            return self.add(self.residue.next_multiple_of(align) - self.residue);
        }
        if self.relative {
            self.term(&format!("pad{align}"));
        } else if self.formula.len() >= MAX_FORMULA {
            self.cut_off();
            self.plus = 0;
        } else {
            (self.formula, self.plus) = (format!("up{align}({})", self.text()), 0);
        }
        (self.multiple, self.residue) = (align, 0);
    }

    /// Fields that follow one of variable size are counted from its end.
    pub fn name_end(&mut self, field: &str) {
        (self.formula, self.plus) = (format!("end({field})"), 0);
    }
}
