//! Logging: from a real-time callback without waiting, to the console (standard error) and /rosout, which is shown here.
//!
//! Change what is wanted: `-- --ros-args --log-level error --log-level robot.arm:=debug`
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use std::process::ExitCode;
use std::time::Duration;
use tautline::logging::TracingLayer;
use tautline::rcl_interfaces::msg::Log;
use tautline::{
    CallbackOptions, Context, LogSeverity, Node, Qos, Result, log_debug, log_error, log_info, log_warn,
};
use tautline_examples::{context_of, exit_code};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

fn main() -> ExitCode {
    exit_code(show())
}

fn show() -> Result<()> {
    let context = context_of(Context::builder().args(std::env::args()))?;
    let mut node = Node::create(context.clone(), "arm", "/robot")?;
    let qos = Qos::keep_last(100).transient_local();
    let lines = node.subscribe::<Log>("/rosout", qos)?.owned();

    let logger = node.logger().clone();
    log_debug!(logger, "is not wanted at the level info");
    let driver = logger.child("driver");
    driver.set_level(LogSeverity::Error);
    log_warn!(driver, "is not wanted either");
    log_error!(driver, "no answer from joint {}", 3);
    // What `tracing` macros say goes the same way; the target is the logger.
    tracing_subscriber::registry().with(TracingLayer::new()).init();
    tracing::warn!(target: "robot::arm", celsius = 70, "joint 3 is warm");

    let timer = node.create_wall_timer(Duration::from_millis(1))?;
    node.spawn_callback(
        CallbackOptions::fifo(20).name("control"),
        timer.take(500).for_each(move |tick| {
            log_info!(logger.once(), "the first of many ticks is number {}", tick.index.min(1));
            log_warn!(logger.throttle(Duration::from_secs(3600)), "said once an hour");
            async {}
        }),
    )?;
    let done = context.events().clone();
    node.spawn_callback(
        CallbackOptions::fifo(10).name("listen"),
        lines.take(4).for_each(move |line| {
            println!("{:>2} {}: {}", line.level, line.name, line.msg);
            if line.msg.contains("hour") {
                done.stop();
            }
            async {}
        }),
    )?;
    context.spin()
}
