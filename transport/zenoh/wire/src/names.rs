// SPDX-License-Identifier: MIT OR Apache-2.0
//! Names on the wire: ROS names with `/` as `%`, type names as mangled by DDS.

use super::{MAX_NAME_BYTES, Malformed};
use std::fmt;
use tautline_schema::{Kind, TypeHash, TypeName};

/// A type's name and hash. Topics match only if both are equal.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TypeId {
    /// `std_msgs/msg/String`; for a service, the service's name.
    pub name: TypeName,
    /// The type's RIHS01 hash.
    pub hash: TypeHash,
}

impl TypeId {
    pub(super) fn parse(name: &str, hash: &str) -> Result<Self, Malformed> {
        Ok(TypeId { name: type_name(name)?, hash: hash.parse().map_err(|_| Malformed::TypeHash)? })
    }

    /// `std_msgs::msg::dds_::String_`.
    pub(super) fn dds_name(&self) -> impl fmt::Display {
        DdsName(&self.name)
    }
}

struct DdsName<'a>(&'a TypeName);

impl fmt::Display for DdsName<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}::{}::dds_::{}_", self.0.package(), self.0.kind().as_str(), self.0.name())
    }
}

fn type_name(dds: &str) -> Result<TypeName, Malformed> {
    if dds.len() > MAX_NAME_BYTES {
        return Err(Malformed::TypeName);
    }
    let mut parts = dds.split("::");
    let mut next = || parts.next().ok_or(Malformed::TypeName);
    let (package, kind, dds_, name) = (next()?, next()?, next()?, next()?);
    let kind = Kind::from_name(kind).ok_or(Malformed::TypeName)?;
    let name = name.strip_suffix('_').ok_or(Malformed::TypeName)?;
    if dds_ != "dds_" || parts.next().is_some() {
        return Err(Malformed::TypeName);
    }
    TypeName::new(package, kind, name).map_err(|_| Malformed::TypeName)
}

/// Displays a name with `%` in place of `/`.
pub(super) struct Mangled<'a>(pub(super) &'a str);

impl fmt::Display for Mangled<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut parts = self.0.split('/');
        f.write_str(parts.next().unwrap_or_default())?;
        parts.try_for_each(|part| write!(f, "%{part}"))
    }
}

/// Mangles a namespace or enclave: to `%` if it is empty or `/`, as in rmw_zenoh.
pub(super) fn mangled_namespace(namespace: &str) -> Mangled<'_> {
    if namespace.is_empty() { Mangled("/") } else { Mangled(namespace) }
}

/// Parses the output of [`mangled_namespace`]; empty and `/` are both `/`.
pub(super) fn namespace(mangled: &str) -> Result<String, Malformed> {
    if mangled == "%" {
        return Ok("/".into());
    }
    let name = mangled.replace('%', "/");
    if is_absolute(&name) { Ok(name) } else { Err(Malformed::NodeName) }
}

/// Parses a fully qualified topic or service name.
pub(super) fn topic(mangled: &str) -> Result<String, Malformed> {
    let name = mangled.replace('%', "/");
    if is_absolute(&name) { Ok(name) } else { Err(Malformed::TopicName) }
}

/// Whether this is a name like `/a/b`, of ROS tokens: parsers refuse topics and namespaces with other names.
pub fn is_absolute(name: &str) -> bool {
    name.len() <= MAX_NAME_BYTES && name.strip_prefix('/').is_some_and(|rest| rest.split('/').all(is_token))
}

/// Whether this consists of letters, digits and underscores. ROS 2 forbids a leading digit, but some peers do not check it, and nothing
/// here depends on it, so it is accepted.
pub(super) fn is_token(token: &str) -> bool {
    !token.is_empty() && token.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
}
