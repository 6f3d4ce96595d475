// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut`, the command line of Tautline.

fn main() -> std::process::ExitCode {
    taut_cli::run()
}
