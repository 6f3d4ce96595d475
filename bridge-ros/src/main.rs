// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut-bridge-ros`, the program behind `taut bridge-ros`.
#![forbid(unsafe_code)]
#![allow(rustdoc::broken_intra_doc_links, reason = "the doc comments of args.rs are help texts")]

mod args;
mod status;

use args::Args;
use clap::Parser;
use std::error::Error;
use std::io::IsTerminal;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tautline_bridge_ros::{Bridge, Instance, Options, ignore_own_endpoints};
use tautline_relay::{say, show_until, stop_on_signals};
use tautline_rt::Realtime;

fn main() -> ExitCode {
    let args = Args::parse();
    // Users cannot change the size of messages from ROS, so no warning about growing segments.
    let filter = tracing_subscriber::EnvFilter::try_from_default_env().unwrap_or_else(|_| {
        tracing_subscriber::EnvFilter::new(
            "warn,tautline_transport::topic::publisher=error,tautline_transport::topic::writer=error",
        )
    });
    let colours = std::io::stderr().is_terminal();
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(colours)
        .without_time()
        // Otherwise the layer panics when standard error is closed or full, and so ends a thread of the bridge.
        .log_internal_errors(false)
        .init();
    match run(&args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            say(format_args!("taut-bridge-ros: {error}"));
            ExitCode::from(2)
        }
    }
}

fn run(args: &Args) -> Result<(), Box<dyn Error>> {
    let options = args.options()?;
    if let Err(error) = ignore_own_endpoints() {
        tracing::warn!(
            "Fast DDS returns to the bridge what it sends to ROS, which takes processor time: {error}"
        );
    }
    let stop = stop_on_signals()?;
    let Some(bridge) = start(args, options.clone(), &stop)? else { return Ok(()) };
    introduce(&bridge, &options);
    let interval = Duration::from_secs_f64(args.interval);
    show_until(&stop, interval, args.json, || bridge.stats(), status::line);
    Ok(())
}

/// Starts the bridge. `None`: a signal ended the wait for another bridge.
fn start(args: &Args, options: Options, stop: &AtomicBool) -> Result<Option<Bridge>, Box<dyn Error>> {
    if !args.standby {
        return Ok(Some(Bridge::spawn(options)?));
    }
    // `ROS_DOMAIN_ID` is already in the options.
    let instance = Instance::bridge(options.domain, options.ros_domain.unwrap_or(0));
    let lock = instance.wait(|| stop.load(Ordering::Relaxed))?;
    Ok(lock.map(|lock| Bridge::spawn_in(options, Some(lock))).transpose()?)
}

/// Prints the bridge's configuration once, to standard error.
fn introduce(bridge: &Bridge, options: &Options) {
    let stats = bridge.stats();
    say(format_args!(
        "bridge of domain {} and ROS domain {} ({})",
        stats.domain, stats.ros_domain, stats.rmw
    ));
    let rules = &options.rules;
    match (rules.auto, rules.rules.len()) {
        (true, 0) => say(format_args!("all topics that one side publishes and the other subscribes to")),
        (true, n) => say(format_args!("{n} topics or patterns of the file, and all other topics")),
        (false, n) => {
            say(format_args!("{n} topics or patterns of the file, nothing else (--auto bridges the rest)"))
        }
    }
    match options.realtime {
        Realtime::Off => {
            say(format_args!("without real-time priorities: the bridge competes with callbacks"))
        }
        Realtime::Required => {
            for thread in bridge.threads() {
                say(format_args!("thread {}: {}", thread.name, thread.policy));
            }
            match options.budget {
                Some(budget) => say(format_args!(
                    "budget: {} % of a core; above it, threads run as SCHED_OTHER",
                    budget.percent
                )),
                None => say(format_args!("no budget: a flood can starve callbacks")),
            }
        }
    }
}
