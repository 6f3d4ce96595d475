// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut-gateway`, the program behind `taut gateway`.
#![forbid(unsafe_code)]
#![allow(rustdoc::broken_intra_doc_links, reason = "the doc comments of args.rs are help texts")]

mod args;
mod status;

use args::Args;
use clap::Parser;
use rustix::fs::Mode;
use std::error::Error;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tautline_gateway::{Gateway, GatewayError, Instance, Options, SessionError};
use tautline_relay::{say, show_until, stderr, stop_on_signals};
use tautline_rt::Realtime;
use tracing_subscriber::Layer;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

/// What is logged. Without two places that log each sample of a host whose clock is half a second ahead (1.10.2), in the thread that
/// receives it.
const LOG: &str = "warn,uhlc=error,zenoh=error,zenoh_ext=error,zenoh::net::routing::dispatcher::pubsub=off";
/// The time after which the wait for a link is logged.
const PATIENCE: Duration = Duration::from_secs(1);

fn main() -> ExitCode {
    let args = Args::parse();
    // A Unix socket to listen on is accessible to its user only, from the moment that it is created.
    rustix::process::umask(Mode::RWXG | Mode::RWXO);
    // Before threads start. Zenoh allocates and frees some MB for each large message, which costs a third of its rate if the heap
    // shrinks and grows each time.
    tautline_rt::keep_freed_memory();
    // Zenoh's warnings are noise here; samples that it drops or loses are counted. RUST_LOG overrides the filter.
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new(LOG));
    // Without colours: control characters are escaped, because text of other hosts is logged.
    let log = tracing_subscriber::fmt::layer().with_writer(stderr).with_ansi(false).without_time();
    tracing_subscriber::registry()
        .with(log.with_filter(filter))
        .with(tautline_gateway::access_layer())
        .init();
    match run(&args) {
        Ok(code) => code,
        Err(error) => {
            say(format_args!("taut-gateway: {error}"));
            ExitCode::from(2)
        }
    }
}

fn run(args: &Args) -> Result<ExitCode, Box<dyn Error>> {
    let options = args.options()?;
    let stop = stop_on_signals()?;
    let gateway = match start(args, options.clone(), &stop) {
        Ok(Some(gateway)) => gateway,
        Ok(None) | Err(GatewayError::Session(SessionError::GivenUp { .. })) => return Ok(ExitCode::SUCCESS),
        Err(error) => return Err(error.into()),
    };
    introduce(&gateway, &options);
    let interval = Duration::from_secs_f64(args.interval);
    show_until(&stop, interval, args.json, || gateway.stats(), status::line);
    Ok(ExitCode::SUCCESS)
}

/// Starts the gateway. `None`: a signal ended the wait for another gateway. [`SessionError::GivenUp`]: a signal ended the wait for a link.
fn start(args: &Args, options: Options, stop: &AtomicBool) -> Result<Option<Gateway>, GatewayError> {
    let is_stopped = || stop.load(Ordering::Relaxed);
    let instance = Instance::gateway(options.domain);
    let lock = if args.standby { instance.wait(is_stopped)? } else { Some(instance.lock()?) };
    let Some(lock) = lock else { return Ok(None) };
    let (start, mut is_said) = (Instant::now(), false);
    let gateway = Gateway::spawn_while(options, lock, |config| {
        if start.elapsed() > PATIENCE && !std::mem::replace(&mut is_said, true) {
            let whom = match config.connect.join(" ") {
                whom if whom.is_empty() => String::from("a host that multicast finds"),
                whom => whom,
            };
            say(format_args!("waiting for {whom} ..."));
        }
        !is_stopped()
    });
    gateway.map(Some)
}

/// Prints the gateway's configuration and addresses once, to standard error.
fn introduce(gateway: &Gateway, options: &Options) {
    let (config, stats) = (gateway.config(), gateway.stats());
    let other = options.network_domain.filter(|domain| *domain != options.domain);
    let domains = other.map_or_else(String::new, |domain| format!(", {domain} on the network"));
    say(format_args!(
        "gateway of domain {}{domains}; session {}; configuration: {}",
        options.domain, stats.zid, config.source
    ));
    let locators = gateway.locators().join(" ");
    if gateway.is_reachable() {
        say(format_args!("listening on {locators}"));
        if config.is_unguarded() {
            say(format_args!(
                "every host that reaches this one can read and write every topic: neither client certificates (a tls/ endpoint with \
                 transport/link/tls/enable_mtls: true) nor access control with default_permission: \"deny\" is configured; \
                 docs/deployment.md has a configuration with both"
            ));
        }
    } else {
        let is_users = |locator: &str| locator.starts_with("unixsock-stream/");
        let whom = match locators.as_str() {
            "" => "nobody",
            _ if locators.split(' ').all(is_users) => "only this user",
            _ => "every user of this host",
        };
        let locators = if locators.is_empty() { "nothing" } else { &locators };
        say(format_args!(
            "listening on {locators}: {whom} can connect, no other host can; --listen tcp/0.0.0.0:7447 opens it"
        ));
    }
    if !config.connect.is_empty() {
        say(format_args!("connecting to {}", config.connect.join(" ")));
    }
    match (options.realtime, gateway.threads()) {
        (Realtime::Off, _) => {
            say(format_args!("without real-time priorities: the network competes with callbacks"))
        }
        (Realtime::Required, Ok(threads)) => {
            let budget = options.budget.map_or_else(
                || "no budget: a flood can starve callbacks".into(),
                |budget| format!("budget {} % of a core; above it, they run as SCHED_OTHER", budget.percent),
            );
            say(format_args!(
                "{} threads of the network at SCHED_FIFO {}, {budget}",
                threads.len(),
                options.priority
            ));
        }
        (Realtime::Required, Err(error)) => say(format_args!("{error}")),
    }
}
