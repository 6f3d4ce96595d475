// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut`, the command line of Tautline.
#![forbid(unsafe_code)]

fn main() -> std::process::ExitCode {
    taut_cli::run()
}
