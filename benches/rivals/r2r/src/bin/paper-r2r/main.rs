// SPDX-License-Identifier: MIT OR Apache-2.0
//! The publisher and the subscriber of the paper's evaluation on r2r, over whatever ROS 2 it was built with.
//!
//! Started by Tautline's `bench paper` with `--child` and a job as JSON.

mod publisher;
mod subscriber;

use std::process::ExitCode;

use rival_r2r::program;
use tautline_paper::{Job, Role};

fn main() -> ExitCode {
    program("paper", |job: &Job| match job.role {
        Role::Publisher => publisher::run(job),
        Role::Subscriber => subscriber::run(job),
    })
}
