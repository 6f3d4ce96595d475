// SPDX-License-Identifier: MIT OR Apache-2.0
//! Names of packages, types, fields and constants, and what ROS allows in them.

use std::fmt;
use std::str::FromStr;

use crate::{Fault, SchemaError};

/// Which folder of its package a type is defined in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Kind {
    /// `action/`: an action or one of the types derived from it.
    Action,
    /// `msg/`: a message.
    Msg,
    /// `srv/`: a service or one of the types derived from it.
    Srv,
}

impl Kind {
    /// `msg`, `srv` or `action`: the folder, the middle of the type's name and the file extension.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Action => "action",
            Self::Msg => "msg",
            Self::Srv => "srv",
        }
    }

    /// The inverse of [`as_str`](Self::as_str).
    pub fn from_name(text: &str) -> Option<Self> {
        [Self::Action, Self::Msg, Self::Srv].into_iter().find(|kind| kind.as_str() == text)
    }
}

/// The full name of a type, `package/msg/Name`. Ordered as text, which is the order that the type hash needs.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TypeName {
    text: String,
    package_len: usize,
}

impl TypeName {
    /// The name of a type that is or will be defined.
    ///
    /// # Errors
    /// [`SchemaError::Name`] if ROS does not allow the package's or the type's name.
    pub fn new(package: &str, kind: Kind, name: &str) -> Result<Self, SchemaError> {
        if !is_package_name(package) || !is_type_name(name) {
            return Err(SchemaError::Name { name: format!("{package}/{}/{name}", kind.as_str()) });
        }
        Ok(Self { text: format!("{package}/{}/{name}", kind.as_str()), package_len: package.len() })
    }

    /// The name of a message that is known to be valid.
    pub(crate) fn constant(package: &str, name: &str) -> Self {
        Self { text: format!("{package}/msg/{name}"), package_len: package.len() }
    }

    /// The package: `std_msgs` of `std_msgs/msg/String`.
    pub fn package(&self) -> &str {
        &self.text[..self.package_len]
    }

    /// The folder: `msg` of `std_msgs/msg/String`.
    pub fn kind(&self) -> Kind {
        let rest = &self.text[self.package_len + 1..];
        Kind::from_name(rest.split('/').next().unwrap_or_default()).unwrap_or(Kind::Msg)
    }

    /// The name in its package: `String` of `std_msgs/msg/String`.
    pub fn name(&self) -> &str {
        self.text.rsplit('/').next().unwrap_or_default()
    }

    /// The full name.
    pub fn as_str(&self) -> &str {
        &self.text
    }

    /// A type of the same package and folder, such as `Foo_Request` of service `Foo`.
    pub(crate) fn sibling(&self, name: &str) -> Self {
        let end = self.text.len() - self.name().len();
        Self { text: format!("{}{name}", &self.text[..end]), package_len: self.package_len }
    }
}

impl fmt::Display for TypeName {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.text)
    }
}

/// Accepts `package/msg/Name`, and `package/Name` for a message.
impl FromStr for TypeName {
    type Err = SchemaError;

    fn from_str(text: &str) -> Result<Self, SchemaError> {
        let error = || SchemaError::Name { name: text.to_owned() };
        let parts: Vec<&str> = text.split('/').collect();
        match parts[..] {
            [package, name] => Self::new(package, Kind::Msg, name),
            [package, kind, name] => Self::new(package, Kind::from_name(kind).ok_or_else(error)?, name),
            _ => Err(error()),
        }
    }
}

/// Lower case, digits and single underscores; a letter first, no underscore last.
pub(crate) fn is_package_name(name: &str) -> bool {
    name.starts_with(|first: char| first.is_ascii_lowercase())
        && name.bytes().all(|byte| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'_')
        && !name.contains("__")
        && !name.ends_with('_')
}

/// An upper-case letter, then letters and digits, or the underscores of derived types (`Foo_SendGoal_Request`).
fn is_type_name(name: &str) -> bool {
    name.starts_with(|first: char| first.is_ascii_uppercase())
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
        && !name.contains("__")
        && !name.ends_with('_')
}

/// Whether a field of a `.msg`, `.srv` or `.action` file may have this name.
pub(crate) fn check_field(name: &str) -> Result<(), Fault> {
    if !is_package_name(name) {
        return Err(Fault::FieldName { name: name.to_owned() });
    }
    if KEYWORDS.split(' ').any(|keyword| keyword == name) {
        return Err(Fault::Keyword { name: name.to_owned() });
    }
    Ok(())
}

/// Whether a member of an `.idl` file may have this name. Type descriptions, and texts written from them, have such names.
pub(crate) fn check_member(name: &str) -> Result<(), Fault> {
    let valid = name.starts_with(|first: char| first.is_ascii_alphabetic())
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_');
    if valid { Ok(()) } else { Err(Fault::FieldName { name: name.to_owned() }) }
}

/// Whether a constant may have this name: upper case, digits and single underscores.
pub(crate) fn check_constant(name: &str) -> Result<(), Fault> {
    let valid = name.starts_with(|first: char| first.is_ascii_uppercase())
        && name.bytes().all(|byte| byte.is_ascii_uppercase() || byte.is_ascii_digit() || byte == b'_')
        && !name.contains("__")
        && !name.ends_with('_');
    if valid { Ok(()) } else { Err(Fault::ConstantName { name: name.to_owned() }) }
}

/// Keywords of C++17, whose generator a field of this name would break. Not Python's, for which `rosidl_generator_py` only
/// warns, nor Rust's: `type` is a common field, and a generator can write `type_`.
const KEYWORDS: &str = "\
    alignas alignof and asm auto bool break case catch char class const constexpr continue decltype default \
    delete do double else enum explicit export extern false float for friend goto if inline int long mutable \
    namespace new noexcept not nullptr operator or private protected public register return short signed \
    sizeof static struct switch template this throw true try typedef typeid typename union unsigned using \
    virtual void volatile while xor";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_have_a_short_and_a_long_form() {
        let name: TypeName = "std_msgs/String".parse().unwrap();
        assert_eq!(name.as_str(), "std_msgs/msg/String");
        assert_eq!((name.package(), name.kind(), name.name()), ("std_msgs", Kind::Msg, "String"));
        let request: TypeName = "std_srvs/srv/SetBool_Request".parse().unwrap();
        assert_eq!((request.kind(), request.name()), (Kind::Srv, "SetBool_Request"));
    }

    #[test]
    fn what_ros_refuses_is_refused() {
        for name in [
            "String",
            "a/b/c/D",
            "Std/String",
            "std__msgs/String",
            "std_/String",
            "std/string",
            "a/idl/B",
            "",
        ] {
            assert!(name.parse::<TypeName>().is_err(), "{name}");
        }
        for name in ["Upper", "two__lines", "end_", "_start", "1st", ""] {
            assert!(matches!(check_field(name), Err(Fault::FieldName { .. })), "{name}");
        }
        assert!(matches!(check_field("class"), Err(Fault::Keyword { .. })));
        for name in ["type", "lambda", "from", "requires"] {
            assert!(check_field(name).is_ok(), "{name}");
        }
        for name in ["frameId", "a__b", "end_", "class"] {
            assert!(check_member(name).is_ok(), "{name}");
        }
        for name in ["_start", "1st", "a-b", "é", ""] {
            assert!(check_member(name).is_err(), "{name}");
        }
        for name in ["lower", "A__B", "A_", "1A", ""] {
            assert!(check_constant(name).is_err(), "{name}");
        }
    }
}
