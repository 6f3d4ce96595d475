//! Budget: a callback that uses more processor time than the system file allows is demoted while it runs, and does less in its next job.
//!
//! `budget 1000` runs for minutes; meanwhile `taut report` shows it beside what `taut check` predicts. It will say that
//! the first job broke its promise.
// SPDX-License-Identifier: MIT OR Apache-2.0

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::time::Duration;
use tautline::rt::clock::burn_cpu;
use tautline::rt::current_policy;
use tautline::{Context, Node, Realtime, Result};
use tautline_examples::{context_of, exit_code};

fn main() -> ExitCode {
    let jobs = std::env::args().nth(1).and_then(|jobs| jobs.parse().ok());
    exit_code(detect(jobs.unwrap_or(3)))
}

fn detect(jobs: u64) -> Result<()> {
    let system = Path::new(env!("CARGO_MANIFEST_DIR")).join("systems/budget.toml");
    // `args` reads ROS 2's arguments, as `Context::create` does by itself.
    let context = context_of(Context::builder().args(std::env::args()).system(system))?;
    let mut node = Node::create(context.clone(), "vision", "")?;
    let mut timer = node.create_wall_timer(Duration::from_millis(200))?;

    let detail = Arc::new(AtomicU32::new(4));
    let too_much = Arc::new(AtomicU64::new(0));
    let (lower, tell) = (detail.clone(), too_much.clone());
    // Its budget is the file's wcet: 50 ms, and `overrun` there has it demoted. The handler runs on the callback's thread, so it only takes notes.
    let options = context.callback("detect")?.on_overrun(move |overrun| {
        lower.store(2, Ordering::Relaxed);
        tell.store(overrun.job, Ordering::Relaxed);
    });
    let (ended, is_realtime) = (context.clone(), context.realtime() == Realtime::Required);
    let callback = node.spawn_callback(options, async move {
        for job in 1..=jobs {
            if timer.tick().await.is_err() {
                return;
            }
            if let before @ 1.. = too_much.swap(0, Ordering::Relaxed) {
                println!("job {before} used more than its budget");
            }
            let detail = detail.load(Ordering::Relaxed);
            if job <= 3 {
                println!("job {job} looks at {detail} images");
            }
            burn_cpu(Duration::from_millis(15) * detail);
            if current_policy().is_ok_and(|policy| is_realtime && policy.realtime_priority().is_none()) {
                println!("job {job} runs below every real-time thread now");
            }
        }
        let _ = timer.tick().await; // ends the last job
        ended.shutdown();
    })?;
    node.spin()?;
    println!("overruns: {}", callback.stats().overruns());
    Ok(())
}
