// SPDX-License-Identifier: MIT OR Apache-2.0

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;

/// A position in a definition.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// The file's path, or the name that the caller gave to the text.
    pub file: Arc<str>,
    /// The line, from 1; 0 where there is no text (a definition read from a type description).
    pub line: u32,
    /// The column in characters, from 1.
    pub column: u32,
}

impl fmt::Display for Place {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.line {
            0 => formatter.write_str(&self.file),
            line => write!(formatter, "{}:{line}:{}", self.file, self.column),
        }
    }
}

/// Why no schema was built.
#[derive(Debug, thiserror::Error)]
pub enum SchemaError {
    /// A definition is not valid.
    #[error("{place}: {fault}")]
    Definition {
        /// Where.
        place: Place,
        /// What is wrong.
        fault: Fault,
    },
    /// A name cannot be that of a type.
    #[error(
        "`{name}` is not a type name: write package/msg/Name (or srv, action) with a lower-case package and a capitalised type"
    )]
    Name {
        /// The name.
        name: String,
    },
    /// No definition of the type was found.
    #[error(
        "`{name}` is defined nowhere in {searched}: source the ROS 2 workspace that has it, or name its folder"
    )]
    Missing {
        /// The type.
        name: String,
        /// Where it was looked for.
        searched: String,
    },
    /// Two definitions of one type differ.
    #[error("`{name}` is defined twice, and differently: keep one of the definitions")]
    Conflict {
        /// The type.
        name: String,
    },
    /// A message of fixed size is too large, or has too many parts, to be handled.
    #[error("`{name}` is too large: at most {} MiB and {} values fit a message's fixed part; use sequences", MAX_SIZE >> 20, MAX_VALUES)]
    TooLarge {
        /// The type.
        name: String,
    },
    /// A type description cannot be read.
    #[error("the type description of `{name}` is not valid: {reason}")]
    Description {
        /// The type, as far as it is known.
        name: String,
        /// What is wrong.
        reason: String,
    },
    /// Text is no type hash.
    #[error("`{text}` is not a type hash: it needs to be RIHS01_ and 64 hexadecimal digits in lower case")]
    Hash {
        /// The text.
        text: String,
    },
    /// A file cannot be read.
    #[error("cannot read {path}: {source}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
}

/// The most bytes of a message's fixed part.
pub(crate) const MAX_SIZE: u64 = 1 << 30;
/// The most values of a message's fixed part, an array of numbers counted once.
pub(crate) const MAX_VALUES: u64 = 1 << 20;
/// How deep messages may be nested.
pub(crate) const MAX_DEPTH: usize = 64;

/// What is wrong with a definition.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Fault {
    /// A line has no name after the type.
    #[error("`{line}` is neither a field (`type name`) nor a constant (`type NAME=value`)")]
    Line {
        /// The line, shortened.
        line: String,
    },
    /// Text that is no type.
    #[error(
        "`{text}` is not a type: write a primitive, string<=N, package/Name or Name, then [], [N] or [<=N] for many"
    )]
    Type {
        /// What stands there.
        text: String,
    },
    /// The length of an array or the bound of a sequence or string.
    #[error("`{text}` is not a length: it needs to be a whole number from 1 to 4294967295")]
    Bound {
        /// What stands there.
        text: String,
    },
    /// A name that a field cannot have.
    #[error(
        "`{name}` cannot name a field: use lower case, digits and single underscores, a letter first and no _ last"
    )]
    FieldName {
        /// The name.
        name: String,
    },
    /// A name that a constant cannot have.
    #[error(
        "`{name}` cannot name a constant: use upper case, digits and single underscores, a letter first and no _ last"
    )]
    ConstantName {
        /// The name.
        name: String,
    },
    /// A keyword of C++.
    #[error("`{name}` is a keyword of C++: rename the field")]
    Keyword {
        /// The name.
        name: String,
    },
    /// Two fields or two constants share a name.
    #[error("`{name}` is defined twice: rename one of them")]
    Duplicate {
        /// The name.
        name: String,
    },
    /// A constant whose type is no primitive.
    #[error("a constant cannot have the type `{text}`: use a number, bool, string or wstring")]
    ConstantType {
        /// The type.
        text: String,
    },
    /// A value that does not fit its type.
    #[error("`{value}` is not a valid {expected}")]
    Value {
        /// The value, shortened.
        value: String,
        /// What would be one.
        expected: String,
    },
    /// A default for a field that cannot have one.
    #[error("a field of type `{text}` cannot have a default: leave it out")]
    NoDefault {
        /// The type.
        text: String,
    },
    /// `---` too rarely or too often.
    #[error("{found} lines `---`: a {what} needs {needed}")]
    Separators {
        /// `service` or `action`.
        what: &'static str,
        /// How many are needed.
        needed: usize,
        /// How many there are.
        found: usize,
    },
    /// A section of concatenated definitions that does not start with `MSG: package/Name`.
    #[error("`{line}` is not a section's start: `MSG: package/Name` needs to follow the line of =")]
    Section {
        /// The line, shortened.
        line: String,
    },
    /// A field of a type that is defined nowhere.
    #[error("`{name}` is defined nowhere in {searched}: add it, or the package that has it")]
    Unknown {
        /// The type.
        name: String,
        /// Where it was looked for.
        searched: String,
    },
    /// A type that contains itself.
    #[error("{chain}: a message cannot contain itself")]
    Recursive {
        /// The types from one to its next occurrence.
        chain: String,
    },
    /// Messages nested too deeply.
    #[error("messages are nested more than {MAX_DEPTH} deep here")]
    TooDeep,
}
