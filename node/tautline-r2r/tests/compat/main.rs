// SPDX-License-Identifier: MIT OR Apache-2.0
//! Programs in r2r's style that need arguments, a context of their own or more than r2r has; all others are in `programs`.

extern crate tautline_r2r as r2r;

mod idioms;
mod parameters;

use r2r::{Context, Realtime};

/// What `Context::create` makes, but for the tests' domain, arguments and privileges.
fn context(domain: u32, arguments: &str) -> Context {
    tautline_rt::domain::test_scope("test");
    let arguments = arguments.split_whitespace();
    Context::builder().domain(domain).realtime(Realtime::Off).args(arguments).build().unwrap()
}
