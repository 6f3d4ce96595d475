// SPDX-License-Identifier: MIT OR Apache-2.0
//! Programs in the style of r2r 0.9.7, whose names and signatures they use: only the `use` line is Tautline's.

mod clocks;
mod logging;

use tautline as r2r;

/// What `r2r::Context::create` makes, but for the tests' domain, arguments and privileges.
fn context(domain: u32, arguments: &str) -> r2r::Context {
    let arguments = arguments.split_whitespace();
    r2r::Context::builder().domain(domain).realtime(r2r::Realtime::Off).args(arguments).build().unwrap()
}
