// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a `build.rs` looks like. The tests run it as cargo would.

fn main() -> Result<(), tautline_build::Error> {
    tautline_build::packages("msgs/")
}
