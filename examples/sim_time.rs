//! Simulated time: a timer follows /clock, which runs, stands still and jumps.
//!
//! One task simulates and another is the robot, in one thread as in r2r's programs.
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::executor::LocalPool;
use futures::task::LocalSpawnExt;
use std::process::ExitCode;
use std::time::Duration;
use tautline::rosgraph_msgs::msg::Clock as ClockMessage;
use tautline::{Clock, Context, JumpThreshold, Node, Qos, Result};
use tautline_examples::{context_of, exit_code};

fn main() -> ExitCode {
    exit_code(show())
}

fn show() -> Result<()> {
    // As `--ros-args -p use_sim_time:=true` on the command line.
    let context = context_of(Context::builder().args(["--ros-args", "-p", "use_sim_time:=true"]))?;
    let mut simulator = Node::create(context.clone(), "simulator", "")?;
    let to_clock = simulator.create_publisher::<ClockMessage>("/clock", Qos::keep_last(1))?;

    let mut robot = Node::create(context, "robot", "")?;
    let mut timer = robot.create_timer(Duration::from_secs(1))?;
    let _jumps = robot.clock().on_jump(JumpThreshold::default(), |jump| {
        println!("the clock went back by {} s", -jump.delta_ns / 1_000_000_000);
    })?;
    let mut pool = LocalPool::new();
    let task = async move {
        while let Ok(tick) = timer.tick().await {
            println!(
                "tick {} of second {}, {} missed",
                tick.index,
                tick.release_ns / 1_000_000_000,
                tick.missed
            );
        }
    };
    pool.spawner().spawn_local(task).expect("the pool takes tasks");

    // Two seconds in steps of a quarter, however long they take; a pause; a jump of a minute; back to the start.
    let run = (0..=8).map(|quarter| 10_000 + quarter * 250);
    let times = run.chain([12_000, 12_000, 72_500, 10_000, 11_000]);
    for ms in times {
        to_clock.publish(&ClockMessage { clock: Clock::to_builtin_time(&Duration::from_millis(ms)) })?;
        robot.spin_once(Duration::from_millis(10));
        pool.run_until_stalled();
    }
    println!("the robot's clock shows {:?}", robot.clock().now());
    Ok(())
}
