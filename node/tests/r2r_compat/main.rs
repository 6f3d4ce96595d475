// SPDX-License-Identifier: MIT OR Apache-2.0
//! Programs written for r2r 0.9.7 with a changed `use` line, where they need arguments or more than r2r has; all others are in
//! `r2r_programs`.

mod clocks;
mod parameters;

use tautline::{Context, Realtime};

/// What `Context::create` makes, but for the tests' domain, arguments and privileges.
fn context(domain: u32, arguments: &str) -> Context {
    let arguments = arguments.split_whitespace();
    Context::builder().domain(domain).realtime(Realtime::Off).args(arguments).build().unwrap()
}
