// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut`, the command line of Tautline.
#![forbid(unsafe_code)]

mod action;
mod apply;
mod asking;
mod bag;
mod bridge_ros;
mod check;
mod completions;
mod component;
mod counts;
mod definitions;
mod demo;
mod doctor;
mod fits;
mod gateway;
mod graph;
mod init;
mod interface;
mod keys;
mod lifecycle;
mod log;
mod man;
mod moment;
mod msg;
mod node;
mod offers;
mod param;
mod play;
mod record;
mod report;
mod ring;
mod service;
mod sibling;
mod table;
mod times;
mod top;
mod topic;
mod trace;
mod verb;

use clap::{CommandFactory, Parser, Subcommand};
use std::process::ExitCode;
use verb::Failure;

/// Zero-copy, real-time middleware for robots.
#[derive(Parser)]
#[command(
    version,
    propagate_version = true,
    arg_required_else_help = true,
    after_help = "Examples:
  taut demo                         five topics beside their computed bounds, in ten seconds
  taut doctor                       what delays real-time threads on this host, and the fixes
  taut top                          what runs now
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
    Topic(topic::TopicArgs),
    Top(top::TopArgs),
    Node(node::NodeArgs),
    Graph(graph::GraphArgs),
    Service(service::ServiceArgs),
    Action(action::ActionArgs),
    Param(param::ParamArgs),
    Lifecycle(lifecycle::LifecycleArgs),
    Log(log::LogArgs),
    Trace(trace::TraceArgs),
    Record(Box<record::RecordArgs>),
    Play(play::PlayArgs),
    Bag(bag::BagArgs),
    Gateway(gateway::GatewayArgs),
    BridgeRos(bridge_ros::BridgeRosArgs),
    Component(component::ComponentArgs),
    Completions(completions::CompletionsArgs),
    Man(man::ManArgs),
}

fn main() -> ExitCode {
    if let Some(code) = completions::answer(Cli::command) {
        return code;
    }
    // Warnings of the libraries, to standard error; RUST_LOG changes what is shown.
    let filter = tracing_subscriber::EnvFilter::builder()
        .with_default_directive(tracing_subscriber::filter::LevelFilter::WARN.into())
        .from_env_lossy();
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).without_time().init();

    let said = |error: &dyn std::fmt::Display| Err(Failure::unusable(error.to_string()));
    let outcome = match Cli::parse().verb {
        Verb::Check(args) => return check::run(&args),
        Verb::Init(args) => return init::run(&args),
        Verb::Report(args) => return report::run(&args),
        Verb::Apply(args) => apply::run(&args),
        Verb::Doctor(args) => doctor::run(&args),
        Verb::Demo(args) => demo::run(args).or_else(|error| said(&error)),
        Verb::Trace(args) => trace::run(args).or_else(|error| said(&error)),
        Verb::Gateway(args) => gateway::run(args).or_else(|error| said(&error)),
        Verb::BridgeRos(args) => bridge_ros::run(args).or_else(|error| said(&error)),
        Verb::Msg(args) => msg::run(args).or_else(|error| said(&error)),
        Verb::Interface(args) => interface::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Top(args) => top::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Topic(args) => topic::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Node(args) => node::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Graph(args) => graph::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Service(args) => service::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Action(args) => action::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Param(args) => param::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Lifecycle(args) => lifecycle::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Log(args) => log::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Record(args) => record::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Play(args) => play::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Bag(args) => bag::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Component(args) => component::run(args).map(|()| ExitCode::SUCCESS),
        Verb::Completions(args) => completions::run(&args).map(|()| ExitCode::SUCCESS),
        Verb::Man(args) => man::run(&args, Cli::command()).map(|()| ExitCode::SUCCESS),
    };
    outcome.unwrap_or_else(Failure::tell)
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
