// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut-bridge-ros`: what `taut bridge-ros` runs.
#![forbid(unsafe_code)]
#![allow(rustdoc::broken_intra_doc_links, reason = "what args.rs says is text for a terminal")]

mod args;
mod status;

use args::Args;
use clap::Parser;
use std::error::Error;
use std::io::IsTerminal;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tautline_bridge_ros::{Bridge, Instance, Options};
use tautline_relay::{show_until, stop_on_signals};
use tautline_rt::Realtime;

fn main() -> ExitCode {
    let args = Args::parse();
    // That a message needs a larger segment is none of the user's doing here.
    let filter = tracing_subscriber::EnvFilter::try_from_default_env().unwrap_or_else(|_| {
        tracing_subscriber::EnvFilter::new("warn,tautline_transport::topic::publisher=error")
    });
    let colours = std::io::stderr().is_terminal();
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(colours)
        .without_time()
        .init();
    match run(&args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("taut-bridge-ros: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(args: &Args) -> Result<(), Box<dyn Error>> {
    let options = args.options()?;
    let stop = stop_on_signals()?;
    let Some(bridge) = start(args, options.clone(), &stop)? else { return Ok(()) };
    introduce(&bridge, &options);
    let interval = Duration::from_secs_f64(args.interval);
    show_until(&stop, interval, args.json, || bridge.stats(), status::line);
    Ok(())
}

/// `None`: a signal came while another bridge was waited for.
fn start(args: &Args, options: Options, stop: &AtomicBool) -> Result<Option<Bridge>, Box<dyn Error>> {
    if !args.standby {
        return Ok(Some(Bridge::spawn(options)?));
    }
    // What the environment says is in the options.
    let instance = Instance::bridge(options.domain, options.ros_domain.unwrap_or(0));
    let lock = instance.wait(|| stop.load(Ordering::Relaxed))?;
    Ok(lock.map(|lock| Bridge::spawn_in(options, Some(lock))).transpose()?)
}

/// What it does: once, to standard error.
fn introduce(bridge: &Bridge, options: &Options) {
    let stats = bridge.stats();
    eprintln!("bridge of domain {} and ROS domain {} ({})", stats.domain, stats.ros_domain, stats.rmw);
    let rules = &options.rules;
    match (rules.auto, rules.rules.len()) {
        (true, 0) => eprintln!("every topic that one side publishes and the other subscribes to"),
        (true, n) => eprintln!("{n} topics or patterns of the file, and every other topic"),
        (false, n) => eprintln!("{n} topics or patterns of the file, nothing else (--auto bridges the rest)"),
    }
    match options.realtime {
        Realtime::Off => eprintln!("without real-time priorities: callbacks and the bridge compete"),
        Realtime::Required => {
            for thread in bridge.threads() {
                eprintln!("thread {}: {}", thread.name, thread.policy);
            }
            match options.budget {
                Some(budget) => {
                    eprintln!("at most {} % of a core, beyond that as ordinary threads", budget.percent);
                }
                None => eprintln!("without a budget: a flood can starve callbacks"),
            }
        }
    }
}
