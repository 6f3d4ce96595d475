// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut-gateway`: what `taut gateway` runs.
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
use tautline_gateway::{Gateway, Instance, Options};
use tautline_relay::{show_until, stop_on_signals};
use tautline_rt::Realtime;
use tracing_subscriber::Layer;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

fn main() -> ExitCode {
    let args = Args::parse();
    // Before there are threads. Zenoh frees and allocates some MB for every large message: a third of its rate, if the heap
    // shrinks and grows again each time.
    tautline_rt::keep_freed_memory();
    // Zenoh says much that is no concern of ours; what it drops or loses is counted. RUST_LOG changes what is shown.
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("warn,zenoh=error,zenoh_ext=error"));
    let colours = std::io::stderr().is_terminal();
    let log = tracing_subscriber::fmt::layer().with_writer(std::io::stderr).with_ansi(colours).without_time();
    tracing_subscriber::registry()
        .with(log.with_filter(filter))
        .with(tautline_gateway::access_layer())
        .init();
    match run(&args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("taut-gateway: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(args: &Args) -> Result<(), Box<dyn Error>> {
    let options = args.options()?;
    let stop = stop_on_signals()?;
    let Some(gateway) = start(args, options.clone(), &stop)? else { return Ok(()) };
    introduce(&gateway, &options);
    let interval = Duration::from_secs_f64(args.interval);
    show_until(&stop, interval, args.json, || gateway.stats(), status::line);
    Ok(())
}

/// `None`: a signal came while another gateway was waited for.
fn start(args: &Args, options: Options, stop: &AtomicBool) -> Result<Option<Gateway>, Box<dyn Error>> {
    if !args.standby {
        return Ok(Some(Gateway::spawn(options)?));
    }
    let lock = Instance::gateway(options.domain).wait(|| stop.load(Ordering::Relaxed))?;
    Ok(lock.map(|lock| Gateway::spawn_in(options, lock)).transpose()?)
}

/// What it does and where it listens: once, to standard error.
fn introduce(gateway: &Gateway, options: &Options) {
    let (config, stats) = (gateway.config(), gateway.stats());
    let other = options.network_domain.filter(|domain| *domain != options.domain);
    let domains = other.map_or_else(String::new, |domain| format!(", {domain} on the network"));
    eprintln!(
        "gateway of domain {}{domains}; session {}; configuration: {}",
        options.domain, stats.zid, config.source
    );
    let locators = gateway.locators().join(" ");
    if config.is_reachable() {
        eprintln!("listening on {locators}");
    } else {
        let locators = if locators.is_empty() { "nothing".into() } else { locators };
        eprintln!(
            "listening on {locators}: loopback only, no other host can connect; --listen tcp/0.0.0.0:7447 opens it"
        );
    }
    if !config.connect.is_empty() {
        eprintln!("connecting to {}", config.connect.join(" "));
    }
    match (options.realtime, gateway.threads()) {
        (Realtime::Off, _) => eprintln!("without real-time priorities: callbacks and the network compete"),
        (Realtime::Required, Ok(threads)) => {
            let budget = options.budget.map_or_else(
                || "without a budget: a flood can starve callbacks".into(),
                |budget| format!("at most {} % of a core, beyond that as ordinary threads", budget.percent),
            );
            eprintln!(
                "{} threads of the network at SCHED_FIFO {}, {budget}",
                threads.len(),
                options.priority
            );
        }
        (Realtime::Required, Err(error)) => eprintln!("{error}"),
    }
}
