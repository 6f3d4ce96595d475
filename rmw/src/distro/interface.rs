// SPDX-License-Identifier: MIT OR Apache-2.0
//! Recognises a librmw's distribution, at build time and when it is loaded: it has no version that a program could read.

/// Functions that came with a distribution, the newest first. Iron has Jazzy's interface, and Rolling the newest.
const CAME_WITH: [(&str, &str); 3] = [
    ("lyrical", "rmw_get_zero_initialized_service_endpoint_info_array"),
    ("kilted", "rmw_enclave_options_copy"),
    ("jazzy", "rmw_get_zero_initialized_discovery_options"),
];

/// The distribution of a librmw that has these functions.
pub fn of(has: impl Fn(&str) -> bool) -> &'static str {
    CAME_WITH.iter().find(|(_, function)| has(function)).map_or("humble", |(distribution, _)| distribution)
}
