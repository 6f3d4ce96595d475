// SPDX-License-Identifier: MIT OR Apache-2.0

use std::collections::{BTreeMap, BTreeSet};

use tautline_schema::{Kind, TypeName};

/// Where the generated code finds the crates and modules that it needs.
#[derive(Clone, Debug)]
pub struct Options {
    /// The path of `tautline-msgs`.
    pub msgs: String,
    /// Packages that are generated elsewhere, and the path of the module each one is: `std_msgs` at
    /// `::tautline::std_msgs`.
    pub external: BTreeMap<String, String>,
}

impl Default for Options {
    /// For crates that depend on `tautline-msgs`.
    fn default() -> Self {
        Self { msgs: "::tautline_msgs".to_owned(), external: BTreeMap::new() }
    }
}

/// The path of a type below its package: `msg::String`, `action::Fibonacci::SendGoal::Request`.
pub fn path(name: &TypeName) -> String {
    match name.kind() {
        Kind::Msg => format!("msg::{}", item(name.name())),
        kind => {
            let parts: Vec<_> = name.name().split('_').map(item).collect();
            format!("{}::{}", kind.as_str(), parts.join("::"))
        }
    }
}

/// The path to the type `name`, for code in the module `module`, such as `std_srvs::srv::SetBool`.
pub fn relative(name: &TypeName, module: &str, options: &Options) -> String {
    if let Some(external) = options.external.get(name.package()) {
        return format!("{external}::{}", path(name));
    }
    let target = format!("{}::{}", item(name.package()), path(name));
    let (from, to): (Vec<_>, Vec<_>) = (module.split("::").collect(), target.split("::").collect());
    let common = from.iter().zip(&to).take_while(|(from, to)| from == to).count();
    format!("{}{}", "super::".repeat(from.len() - common), to[common..].join("::"))
}

/// A field's name in Rust: as an [`item`]'s.
pub fn field(name: &str) -> String {
    // A method of every view.
    if name == "to_owned" { format!("{name}_") } else { item(name) }
}

/// The name of a package's module, or a message's struct: as in r2r, keywords get a `_`, which no name in ROS ends with.
pub fn item(name: &str) -> String {
    let is_keyword = KEYWORDS.split(' ').any(|keyword| keyword == name);
    if is_keyword { format!("{name}_") } else { name.to_owned() }
}

/// The messages whose names are also those of structs that read or write another message in place, such as `MapRef` beside `Map`.
pub struct Taken(BTreeSet<String>);

impl Taken {
    /// Finds these names among all messages.
    pub fn among<'n>(messages: impl IntoIterator<Item = &'n TypeName>) -> Self {
        let messages: BTreeSet<_> = messages.into_iter().map(TypeName::as_str).collect();
        let is_taken = |name: &&&str| {
            let bases = ["Ref", "Writer", "Sizes"].map(|suffix| name.strip_suffix(suffix));
            bases.into_iter().flatten().any(|base| messages.contains(base))
        };
        Taken(messages.iter().filter(is_taken).map(|name| (*name).to_owned()).collect())
    }

    /// The name of what reads or writes the message in place: that of its struct and a suffix, with a `_` if a message has this name.
    pub fn avoid(&self, message: &TypeName, path: &str, suffix: &str) -> String {
        let end = if self.0.contains(&format!("{message}{suffix}")) { "_" } else { "" };
        format!("{path}{suffix}{end}")
    }
}

/// The keywords of edition 2024, and those that are reserved.
const KEYWORDS: &str = "Self abstract as async await become box break const continue crate do dyn else enum extern false final \
    fn for gen if impl in let loop macro match mod move mut override priv pub ref return self static struct super trait \
    true try type typeof unsafe unsized use virtual where while yield";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_those_of_r2r() {
        let path = |name: &str| path(&name.parse().unwrap());
        assert_eq!(path("std_msgs/msg/String"), "msg::String");
        assert_eq!(path("std_srvs/srv/SetBool_Request"), "srv::SetBool::Request");
        assert_eq!(path("a/action/Fibonacci_SendGoal_Event"), "action::Fibonacci::SendGoal::Event");
        assert_eq!([path("a/msg/Self"), path("a/srv/Self_Request")], ["msg::Self_", "srv::Self_::Request"]);
    }

    #[test]
    fn paths_are_relative() {
        let relative = |name: &str, module| relative(&name.parse().unwrap(), module, &Options::default());
        assert_eq!(relative("a/msg/B", "a::msg"), "B");
        assert_eq!(relative("a/msg/B", "a::srv::C"), "super::super::msg::B");
        assert_eq!(relative("a/srv/C_Request", "a::srv::C"), "Request");
        assert_eq!(relative("b/msg/B", "a::msg"), "super::super::b::msg::B");
    }

    #[test]
    fn a_name_that_a_message_has_is_avoided() {
        let names = ["a/msg/Map", "a/msg/MapRef", "a/msg/MapSizesRef", "b/msg/MapSizes", "a/srv/MapSizes"];
        let names = names.map(|name| name.parse().unwrap());
        let taken = Taken::among(&names);
        let avoid = |suffix| taken.avoid(&names[0], "Map", suffix);
        assert_eq!(["Ref", "Writer", "Sizes"].map(avoid), ["MapRef_", "MapWriter", "MapSizes"]);
        assert_eq!(taken.avoid(&names[1], "super::MapRef", "Ref"), "super::MapRefRef");
    }

    #[test]
    fn keywords_are_escaped() {
        assert_eq!([field("type"), field("self"), field("x")], ["type_", "self_", "x"]);
    }
}
