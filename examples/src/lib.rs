// SPDX-License-Identifier: MIT OR Apache-2.0
//! Small programs, one idea each, and here what they share.
//!
//! The examples are the files beside `src`; the README there says what each one shows.
#![forbid(unsafe_code)]

use std::process::ExitCode;
use tautline::rt::permission::realtime_permitted;
use tautline::{Context, ContextBuilder, ExecutorError, Realtime};

/// The message of the small examples: one of ROS 2's own, so that other hosts know it, too.
pub use tautline::std_msgs::msg::UInt64;

/// The exit code of an example that cannot run here, for want of a privilege or a core; test runners know it as 'skipped'.
pub const SKIPPED: u8 = 77;

/// A context with real-time priorities where this user may have them, otherwise one without. What is missing is then
/// said on standard error. A robot's program writes `Context::create()` instead and gets an error.
///
/// # Errors
/// As [`ContextBuilder::build`].
pub fn context() -> tautline::Result<Context> {
    context_of(Context::builder())
}

/// As [`context`], with settings.
///
/// # Errors
/// As [`ContextBuilder::build`].
pub fn context_of(settings: ContextBuilder) -> tautline::Result<Context> {
    if std::env::var_os("TAUT_REALTIME").is_none()
        && let Err(missing) = realtime_permitted(ContextBuilder::SAMPLER_PRIORITY)
    {
        eprintln!("running without real-time priorities: {missing}");
        return settings.realtime(Realtime::Off).build();
    }
    settings.build()
}

/// What `main` returns: an error is printed as a sentence, and if a privilege was missing, how to go on without it.
pub fn exit_code(result: tautline::Result<()>) -> ExitCode {
    let Err(error) = result else { return ExitCode::SUCCESS };
    eprintln!("{error}");
    let about_realtime = matches!(
        error,
        tautline::Error::Realtime(_) | tautline::Error::Executor(ExecutorError::Thread { .. })
    );
    if about_realtime && realtime_permitted(ContextBuilder::SAMPLER_PRIORITY).is_err() {
        eprintln!("To run without real-time priorities, set TAUT_REALTIME=off.");
        return ExitCode::from(SKIPPED);
    }
    ExitCode::FAILURE
}
