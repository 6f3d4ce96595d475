//! Parameters: declared with a range, checked when they are set, read in a callback without waiting.
//!
//! Give one its value: `cargo run -p tautline-examples --example parameters -- --ros-args -p gain:=2.5`
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use std::process::ExitCode;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tautline::{CallbackOptions, Context, Node, ParameterDescriptor, Result, RosParams};
use tautline_examples::{context_of, exit_code};

/// Each field is a parameter: limits.speed, limits.retries.
#[derive(RosParams, Default)]
struct Robot {
    limits: Limits,
}

#[derive(RosParams, Default)]
struct Limits {
    /// In m/s.
    #[param(range = 0.0..=2.0)]
    speed: f64,
    retries: u8,
}

fn main() -> ExitCode {
    exit_code(show())
}

fn show() -> Result<()> {
    let context = context_of(Context::builder().args(std::env::args()))?;
    let mut node = Node::create(context.clone(), "controller", "")?;
    let range = ParameterDescriptor::new().description("Of the controller").range(0.0..=10.0).step(0.5);
    let mut gain = node.declare_parameter_with("gain", 1.5, range)?;
    let robot = Arc::new(Mutex::new(Robot { limits: Limits { speed: 1.0, retries: 3 } }));
    node.parameters().declare_struct(robot.clone())?;

    let parameters = node.parameters().clone();
    let inside = parameters.clone();
    let _check = parameters.on_set(move |values| {
        let speed = values.iter().any(|(name, _)| name == "limits.speed");
        let high = inside.get::<f64>("gain").is_ok_and(|gain| gain > 5.0);
        if speed && high { Err("first lower the gain".into()) } else { Ok(()) }
    });
    for (name, value) in [("gain", 8.0), ("gain", 11.0), ("limits.speed", 1.5), ("speed", 1.0)] {
        match parameters.set(name, value) {
            Ok(()) => println!("{name} is {value}"),
            Err(error) => println!("{error}"),
        }
    }
    println!("{}", parameters.set("limits.retries", 300).unwrap_err());
    parameters.set_atomically([("gain".into(), 2.0.into()), ("limits.retries".into(), 5.into())])?;
    println!("retries are {}", robot.lock().unwrap().limits.retries);

    let timer = node.create_wall_timer(Duration::from_millis(10))?;
    let done = context.events().clone();
    node.spawn_callback(
        CallbackOptions::fifo(20).name("control"),
        timer.take(1).for_each(move |_| {
            println!("the callback reads {}", gain.get()); // wait-free, whoever sets it meanwhile
            done.stop();
            async {}
        }),
    )?;
    context.spin()
}
