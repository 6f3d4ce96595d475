// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut`, the command line of Tautline, and the code that it shares with the programs of some verbs.
//!
//! `taut` links the libraries that most verbs need. A verb that needs a large library (compression for bags, a terminal for `top`, jq for
//! `--filter`) is a separate program, so that only its users build it: see [`sibling`].
#![forbid(unsafe_code)]
#![allow(missing_docs, reason = "a library for the programs in this folder, not for users")]

#[macro_use]
pub mod print;

mod action;
mod apply;
pub mod arguments;
mod bridge_ros;
pub mod call;
mod check;
mod compatibility;
pub mod completions;
mod component;
pub mod date;
pub mod demo;
mod doctor;
mod find;
mod graph;
mod init;
mod interface;
mod lifecycle;
mod log;
mod man;
mod moment;
mod msg;
mod node;
mod param;
pub mod rates;
pub mod replace;
pub mod report;
mod service;
pub mod sibling;
pub mod table;
pub mod times;
pub mod topic;
pub mod trace;
pub mod verb;

use clap::{CommandFactory, Parser, Subcommand};
use std::process::ExitCode;
use verb::{Failure, Verbs};

/// Zero-copy, real-time middleware for robots.
#[derive(Parser)]
#[command(
    version,
    propagate_version = true,
    arg_required_else_help = true,
    after_help = "Examples:
  taut demo                         five topics beside their computed bounds, in ten seconds
  taut doctor                       what delays real-time threads on this host, and the fixes
  taut top                          callbacks, topics and cores now
  taut topic echo /scan --once
  taut graph -o robot.svg
  source <(taut completions bash)   names of topics, nodes and types at the tab key

`taut VERB --help` has examples of each verb; see also docs/tools.md and docs/system-toml.md."
)]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Subcommand)]
enum Verb {
    Demo(demo::DemoArgs),
    Check(check::CheckArgs),
    Apply(apply::ApplyArgs),
    Doctor(doctor::DoctorArgs),
    Init(init::InitArgs),
    Report(report::ReportArgs),
    Msg(msg::MsgArgs),
    Interface(interface::InterfaceArgs),
    Topic(Verbs<topic::Verb>),
    /// Shows callbacks, topics and cores as they are now: response times beside their bounds, rates, losses, load
    Top(sibling::PassedOn),
    Node(Verbs<node::Verb>),
    Graph(graph::GraphArgs),
    Service(Verbs<service::Verb>),
    Action(Verbs<action::Verb>),
    Param(Verbs<param::Verb>),
    Lifecycle(Verbs<lifecycle::Verb>),
    Log(log::LogArgs),
    Trace(Verbs<trace::Verb>),
    /// Records topics into a bag, as rosbag2 writes them: MCAP files and a metadata.yaml
    Record(sibling::PassedOn),
    /// Publishes the messages of a bag at the times of their reception
    Play(sibling::PassedOn),
    /// Shows, checks, repairs, converts and draws bags
    Bag(sibling::PassedOn),
    /// Mirrors this host's topics over the network: one gateway per host and domain
    Gateway(sibling::PassedOn),
    BridgeRos(bridge_ros::BridgeRosArgs),
    Component(component::ComponentArgs),
    Completions(completions::CompletionsArgs),
    Man(man::ManArgs),
}

/// Runs the verb of the command line. Returns the exit code.
pub fn run() -> ExitCode {
    if let Some(code) = completions::answer(Cli::command) {
        return code;
    }
    log_to_stderr();

    let outcome = match Cli::parse().verb {
        Verb::Check(args) => check::run(&args),
        Verb::Init(args) => init::run(&args),
        Verb::Report(args) => report::run(&args),
        Verb::Apply(args) => apply::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Doctor(args) => doctor::run(&args),
        Verb::Demo(args) => demo::run(args),
        Verb::Trace(args) => trace::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Gateway(args) => sibling::GATEWAY.run(&[], &args),
        Verb::Record(args) => sibling::BAG.run(&["record"], &args),
        Verb::Play(args) => sibling::BAG.run(&["play"], &args),
        Verb::Bag(args) => sibling::BAG.run(&["bag"], &args),
        Verb::Top(args) => sibling::TOP.run(&["top"], &args),
        Verb::BridgeRos(args) => bridge_ros::run(args),
        Verb::Msg(args) => msg::run(args).map(|()| ExitCode::SUCCESS),
        Verb::Interface(args) => interface::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Topic(args) => topic::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Node(args) => node::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Graph(args) => graph::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Service(args) => service::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Action(args) => action::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Param(args) => param::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Lifecycle(args) => lifecycle::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Log(args) => log::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Component(args) => component::run(args).map(|()| ExitCode::SUCCESS),
        Verb::Completions(args) => completions::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Man(args) => man::run(&args, Cli::command()).map(|()| ExitCode::SUCCESS),
    };
    outcome.unwrap_or_else(Failure::print)
}

/// The command line of a program with some verbs of `taut`.
#[derive(Parser)]
#[command(name = "taut", bin_name = "taut", version, propagate_version = true, arg_required_else_help = true)]
struct ProgramCli<V: Subcommand> {
    #[command(subcommand)]
    verb: ProgramVerb<V>,
}

#[derive(Subcommand)]
enum ProgramVerb<V: Subcommand> {
    #[command(flatten)]
    Own(V),
    #[command(hide = true)]
    Man(man::ManArgs),
}

/// The main function of a program with some verbs of `taut`: completes a shell's words if the shell requests that, otherwise runs the verb of
/// the command line.
pub fn run_verbs<V: Subcommand>(run: impl FnOnce(V) -> verb::Outcome) -> ExitCode {
    if let Some(code) = completions::answer(ProgramCli::<V>::command) {
        return code;
    }
    log_to_stderr();
    let outcome = match ProgramCli::parse().verb {
        ProgramVerb::Own(verb) => run(verb),
        ProgramVerb::Man(args) => man::write_verbs(&args, ProgramCli::<V>::command()),
    };
    outcome.map_or_else(Failure::print, |()| ExitCode::SUCCESS)
}

/// Prints the libraries' warnings to standard error. RUST_LOG, such as `debug` or `tautline=trace,warn`, selects other levels.
pub fn log_to_stderr() {
    use tracing_subscriber::filter::{LevelFilter, Targets};
    use tracing_subscriber::layer::SubscriberExt;
    use tracing_subscriber::util::SubscriberInitExt;
    let asked = std::env::var("RUST_LOG").ok().and_then(|text| text.parse().ok());
    let targets: Targets = asked.unwrap_or_else(|| Targets::new().with_default(LevelFilter::WARN));
    let written = tracing_subscriber::fmt::layer().with_writer(print::stderr).with_ansi(false).without_time();
    tracing_subscriber::registry().with(written).with(targets).init();
}

#[cfg(test)]
mod tests {
    use super::*;

    /// clap checks a verb's arguments only when the verb is used.
    #[test]
    fn every_verb_is_consistent() {
        Cli::command().debug_assert();
    }
}
