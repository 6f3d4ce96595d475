// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut`, the command line of Tautline.
#![forbid(unsafe_code)]

mod bridge_ros;
mod check;
mod component;
mod demo;
mod domain;
mod gateway;
mod init;
mod msg;
mod node;
mod report;
mod service;
mod sibling;
mod table;
mod topic;
mod trace;

use clap::{Parser, Subcommand};
use std::process::ExitCode;

/// Zero-copy, real-time middleware for robots.
#[derive(Parser)]
#[command(version, propagate_version = true, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Subcommand)]
enum Verb {
    Demo(demo::DemoArgs),
    Check(check::CheckArgs),
    Init(init::InitArgs),
    Report(report::ReportArgs),
    Msg(msg::MsgArgs),
    Topic(topic::TopicArgs),
    Node(node::NodeArgs),
    Service(service::ServiceArgs),
    Trace(trace::TraceArgs),
    Gateway(gateway::GatewayArgs),
    BridgeRos(bridge_ros::BridgeRosArgs),
    Component(component::ComponentArgs),
}

fn main() -> ExitCode {
    // Warnings of the libraries, to standard error; RUST_LOG changes what is shown.
    let filter = tracing_subscriber::EnvFilter::builder()
        .with_default_directive(tracing_subscriber::filter::LevelFilter::WARN.into())
        .from_env_lossy();
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).without_time().init();

    let outcome = match Cli::parse().verb {
        Verb::Demo(args) => demo::run(args).map_err(|error| error.to_string()),
        Verb::Check(args) => Ok(check::run(&args)),
        Verb::Init(args) => Ok(init::run(&args)),
        Verb::Report(args) => Ok(report::run(&args)),
        Verb::Trace(args) => trace::run(args).map_err(|error| error.to_string()),
        Verb::Topic(args) => topic::run(args).map_err(|error| error.to_string()),
        Verb::Node(args) => node::run(&args).map_err(|error| error.to_string()),
        Verb::Service(args) => service::run(&args).map_err(|error| error.to_string()),
        Verb::Gateway(args) => gateway::run(args).map_err(|error| error.to_string()),
        Verb::BridgeRos(args) => bridge_ros::run(args).map_err(|error| error.to_string()),
        Verb::Component(args) => component::run(args).map_err(|error| error.to_string()),
        Verb::Msg(args) => msg::run(args).map_err(|error| error.to_string()),
    };
    outcome.unwrap_or_else(|error| {
        eprintln!("taut: {error}");
        ExitCode::FAILURE
    })
}
