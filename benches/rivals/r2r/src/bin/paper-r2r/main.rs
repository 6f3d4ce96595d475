// SPDX-License-Identifier: MIT OR Apache-2.0
//! The publisher and the subscriber of the paper's evaluation on r2r, over whatever ROS 2 it was built with.
//!
//! Started by Tautline's `bench paper` with `--child` and a job as JSON.

mod publisher;
mod subscriber;

use std::error::Error;
use std::process::ExitCode;

use tautline_paper::{Job, Role};

type Result<T> = std::result::Result<T, Box<dyn Error>>;

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("paper-r2r: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run() -> Result<()> {
    if std::env::args().nth(1).as_deref() == Some("--version") {
        println!("{}", rival_r2r::version()?);
        return Ok(());
    }
    let mut arguments = std::env::args().skip(1);
    let (Some(flag), Some(job)) = (arguments.next(), arguments.next()) else {
        return Err("to be started by `cargo xtask bench paper`".into());
    };
    if flag != "--child" {
        return Err(format!("unknown option {flag}").into());
    }
    let job: Job = serde_json::from_str(&job)?;
    match job.role {
        Role::Publisher => publisher::run(&job),
        Role::Subscriber => subscriber::run(&job),
    }
}
