//! Timer: releases are absolute; a callback that comes late gets the newest one and the number of those it missed.
//!
//! The third job overstays by two and a half periods. Release 4 is lost to it, release 5 is taken late, and release 6
//! comes when it would have come anyway: nothing drifts.
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use std::process::ExitCode;
use std::time::Duration;
use tautline::rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline::{CallbackOptions, Node, Result};
use tautline_examples::{context, exit_code};

const PERIOD: Duration = Duration::from_millis(100);

fn main() -> ExitCode {
    exit_code(show())
}

fn show() -> Result<()> {
    let context = context()?;
    let mut node = Node::create(context.clone(), "timer", "")?;
    let period_ns = PERIOD.as_nanos() as u64;
    let first_ns = monotonic_ns() + period_ns;
    let mut timer = node.create_wall_timer_at(first_ns, PERIOD)?;

    let callback =
        node.spawn_callback(CallbackOptions::fifo(10).name("timer").period(PERIOD), async move {
            while let Some(tick) = timer.next().await {
                let at_ms = (tick.release_ns - first_ns) / 1_000_000;
                println!("release {} at {at_ms} ms, missed {}", tick.index, tick.missed);
                match tick.index {
                    3 => sleep_until_monotonic(tick.release_ns + period_ns * 5 / 2),
                    7.. => break,
                    _ => {}
                }
            }
            println!("missed {} of 7", timer.missed());
            context.shutdown();
        })?;
    node.spin()?;
    Ok(callback.join()?)
}
