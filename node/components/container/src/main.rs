// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut-container`: a process into which components are loaded. It is a separate program, because it and its components use
//! Tautline as one shared library.
#![forbid(unsafe_code)]

use clap::Parser;
use std::error::Error;
use std::io::{self, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tautline::{Admission, CallbackOptions, Context, Node, Realtime};
use tautline_components::{Container, Load};
use tautline_dylib as _;

/// Runs components from shared libraries in one process, on one sampler.
///
/// A component shares the process's context; what components publish to each other is read where it was written. A library that
/// was built by another compiler or with another version of Tautline is refused before any of it runs. Behind --ros-args stand ROS 2's
/// arguments, for the container's own node and the components that are loaded here, up to `--`; more libraries may follow. A
/// first SIGINT, SIGTERM or SIGHUP ends the container once the callbacks that run have returned, a second one at once.
#[derive(Parser, Debug)]
#[command(
    version,
    after_help = "Load, unload and list while it runs with `taut component`.\n\nExamples:\n  taut-container libdemo.so:demo::Counter libdemo.so:demo::Doubler\n  \
                  taut-container --no-rt --namespace /robot libdrive.so\n  taut-container --system system.toml libdrive.so\n  \
                  taut-container libdemo.so:demo::Counter --ros-args -p step:=2 -r count:=/count"
)]
struct Args {
    /// What to load: a library, or LIBRARY:COMPONENT if it has several.
    #[arg(value_name = "LIBRARY[:COMPONENT]")]
    load: Vec<String>,
    /// The namespace of the components' nodes.
    #[arg(long, default_value = "")]
    namespace: String,
    /// The name of the container's own node, by whose services components are loaded and unloaded.
    #[arg(long, default_value = "ComponentManager")]
    name: String,
    /// The domain [default: TAUT_DOMAIN, else ROS_DOMAIN_ID, else 0]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=232))]
    domain: Option<u32>,
    /// The system file by whose names components spawn their callbacks; what does not fit beside what runs is refused.
    #[arg(long, value_name = "FILE")]
    system: Option<PathBuf>,
    /// Admit what does not fit all the same; `taut report` says so.
    #[arg(long)]
    force: bool,
    /// Without real-time priorities.
    #[arg(long)]
    no_rt: bool,
}

fn main() -> ExitCode {
    // What follows is ROS 2's.
    let mut own: Vec<_> = std::env::args_os().collect();
    let ros = own.iter().position(|arg| arg == "--ros-args").map_or(Vec::new(), |at| own.split_off(at));
    match run(&Args::parse_from(own), ros.iter().map(|arg| arg.to_string_lossy().into_owned())) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let _ = writeln!(io::stderr(), "taut-container: {error}");
            ExitCode::from(2)
        }
    }
}

fn run(args: &Args, ros_args: impl Iterator<Item = String>) -> Result<(), Box<dyn Error>> {
    let mut settings = Context::builder().args(ros_args);
    if let Some(domain) = args.domain {
        settings = settings.domain(domain);
    }
    if let Some(system) = &args.system {
        settings = settings.system(system);
    }
    if args.force {
        settings = settings.admission(Admission::Force);
    }
    if args.no_rt {
        settings = settings.realtime(Realtime::Off);
    }
    let context = settings.build()?;
    let mut node = Node::create(context.clone(), &args.name, "")?;
    let mut container = Container::new(context.clone());
    // Those behind `--` stand behind ROS 2's arguments.
    let behind = context.non_ros_args();
    if let Some(option) = behind.iter().find(|arg| arg.starts_with('-')) {
        return Err(format!(
            "{option} stands behind --ros-args, where only libraries can: put options before"
        )
        .into());
    }
    for load in args.load.iter().chain(behind) {
        // The component's name has colons, too.
        let (library, component) = load.split_once(':').unwrap_or((load, ""));
        let (library, component) = (PathBuf::from(library), component.to_owned());
        let namespace = args.namespace.clone();
        let load = Load { library, component, namespace, use_global_arguments: true, ..Load::default() };
        let id = container.load(&load)?;
        // Who does not read it may leave: the components run on.
        let _ = writeln!(io::stdout(), "{id} {}", container.full_name(id).unwrap_or_default());
    }
    let container = Arc::new(Mutex::new(container));
    let serve = tautline_components::serve(&container, &mut node)?;
    // Below every callback: making a component is no real-time work. It may take as much stack as a program's start.
    let options = CallbackOptions::other().name("container").stack_bytes(8 << 20);
    let services = node.spawn_callback(options, serve)?;
    // The first signal asks for the end, which waits for callbacks that run; one that comes later does not wait. Who stops a
    // program may signal it twice, as a process and in its group: both are one stop.
    const ONE_STOP: Duration = Duration::from_millis(200);
    let mut signals = signal_hook::iterator::Signals::new(tautline_rt::termination_signals())?;
    let events = context.events().clone();
    std::thread::Builder::new().name("signals".into()).spawn(move || {
        let mut first = None;
        for signal in signals.forever() {
            events.stop();
            if first.get_or_insert_with(Instant::now).elapsed() > ONE_STOP {
                signal_hook::low_level::exit(128 + signal);
            }
        }
    })?;
    context.spin()?;
    services.stop();
    services.join()?;
    Ok(())
}
