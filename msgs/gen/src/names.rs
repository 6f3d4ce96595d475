// SPDX-License-Identifier: MIT OR Apache-2.0

use std::collections::BTreeMap;

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
        Kind::Msg => format!("msg::{}", name.name()),
        kind => format!("{}::{}", kind.as_str(), name.name().replace('_', "::")),
    }
}

/// The path to the type `name`, for code in the module `module`, such as `std_srvs::srv::SetBool`.
pub fn relative(name: &TypeName, module: &str, options: &Options) -> String {
    if let Some(external) = options.external.get(name.package()) {
        return format!("{external}::{}", path(name));
    }
    let target = format!("{}::{}", name.package(), path(name));
    let (from, to): (Vec<_>, Vec<_>) = (module.split("::").collect(), target.split("::").collect());
    let common = from.iter().zip(&to).take_while(|(from, to)| from == to).count();
    format!("{}{}", "super::".repeat(from.len() - common), to[common..].join("::"))
}

/// A field's name in Rust: as in r2r, keywords get a `_`.
pub fn field(name: &str) -> String {
    // A method of every view.
    let is_taken = name == "to_owned" || KEYWORDS.split(' ').any(|keyword| keyword == name);
    if is_taken { format!("{name}_") } else { name.to_owned() }
}

/// Of edition 2024, and those that are reserved.
const KEYWORDS: &str = "abstract as async await become box break const continue crate do dyn else enum extern false final \
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
    fn keywords_are_escaped() {
        assert_eq!([field("type"), field("self"), field("x")], ["type_", "self_", "x"]);
    }
}
