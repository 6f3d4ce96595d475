// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut topic`: the topics of a domain, and what is published on them, without a compiled-in type.

mod info;

use crate::domain::DomainArgs;
use clap::{Args, Subcommand};
use futures::{FutureExt, StreamExt};
use std::io::{self, Write};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tautline::{Context, EndpointKind, Node, QosProfile, Realtime};
use tautline_schema::DynamicMessage;
use tautline_transport::{Durability, Participant, Qos, Reliability, graph_of};

/// Lists topics; says who publishes and subscribes; prints messages.
///
/// Topics of other hosts are seen if this host runs `taut gateway`.
/// Types need not be compiled in: processes leave their definitions
/// in /tmp/tautline_UID/schemas.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut topic list
  taut topic list --domain 7        another domain
  taut topic list --json            types, hashes, publishers and subscriptions
  taut topic info /joint_states -v  the nodes, and the quality of service of each
  taut topic echo /joint_states     as ros2 topic echo, until Ctrl-C
  taut topic echo /map --once --json")]
pub struct TopicArgs {
    #[command(subcommand)]
    verb: Verb,
    #[command(flatten)]
    domain: DomainArgs,
    /// Print JSON
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Subcommand, Clone, Debug)]
enum Verb {
    /// Prints the topics with their types, where they are, and how many publishers and subscriptions they have
    List,
    /// Prints how many publishers and subscriptions a topic has, and of what type
    Info {
        /// The topic
        #[arg(value_name = "TOPIC")]
        topic: String,
        /// Print the node, the identifier and the quality of service of each
        #[arg(short, long)]
        verbose: bool,
    },
    /// Prints the messages of a topic as they come
    Echo {
        /// The topic; waited for if it does not exist
        #[arg(value_name = "TOPIC")]
        topic: String,
        /// End after the first message
        #[arg(long)]
        once: bool,
    },
}

/// Why there is nothing to print.
#[derive(Debug, thiserror::Error)]
pub enum TopicError {
    #[error(transparent)]
    Node(#[from] tautline::Error),
    #[error(transparent)]
    Transport(#[from] tautline_transport::TransportError),
    #[error(transparent)]
    Schema(#[from] tautline_schema::SchemaError),
    #[error("there is no topic '{0}'; `taut topic list` prints which there are")]
    Unknown(String),
    #[error("signals cannot be caught: {0}")]
    Signal(io::Error),
    #[error("the result cannot be printed: {0}")]
    Print(#[from] io::Error),
}

/// Runs the verb.
pub fn run(args: TopicArgs) -> Result<ExitCode, TopicError> {
    let domain = args.domain.number()?;
    let result = match &args.verb {
        Verb::List => {
            let graph = graph_of(domain)?;
            Ok(info::list(&info::topics(&graph), args.json, &mut io::stdout().lock())?)
        }
        Verb::Info { topic, verbose } => print_info(domain, topic, *verbose, args.json),
        Verb::Echo { topic, once } => echo(domain, topic, *once, args.json),
    };
    match result {
        // Whoever reads has seen enough.
        Err(TopicError::Print(error)) if error.kind() == io::ErrorKind::BrokenPipe => Ok(ExitCode::SUCCESS),
        result => result.map(|()| ExitCode::SUCCESS),
    }
}

fn print_info(domain: u32, topic: &str, verbose: bool, json: bool) -> Result<(), TopicError> {
    let name = if topic.starts_with('/') { topic.to_owned() } else { format!("/{topic}") };
    let graph = graph_of(domain)?;
    let mut topics = info::topics(&graph);
    topics.retain(|topic| topic.name() == name);
    if topics.is_empty() {
        return Err(TopicError::Unknown(name));
    }
    let mut out = io::stdout().lock();
    if json {
        let topics = topics.iter().map(info::Topic::info_json);
        return Ok(writeln!(out, "{}", serde_json::Value::from_iter(topics))?);
    }
    // More than one if hosts disagree on its type.
    Ok(topics.iter().try_for_each(|topic| topic.print(verbose, &mut out))?)
}

fn echo(domain: u32, topic: &str, once: bool, json: bool) -> Result<(), TopicError> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, stop.clone()).map_err(TopicError::Signal)?;
    }
    let participant = Participant::new(domain)?;
    let context = Context::builder().domain(domain).realtime(Realtime::Off).build()?;
    let mut node = Node::create(context, &format!("taut_topic_echo_{}", std::process::id()), "")?;
    let topic = node.resolve_topic_name(topic)?;
    let mut waits = false;
    let (topic_type, publishers) = loop {
        let seen = participant.graph_epoch();
        let graph = participant.graph()?;
        let mut ends: Vec<_> = graph.endpoints.iter().filter(|end| end.topic == topic).cloned().collect();
        if let Some(first) = ends.first() {
            let topic_type = first.topic_type.clone();
            ends.retain(|end| end.kind == EndpointKind::Publisher && end.topic_type == topic_type);
            break (topic_type, ends);
        }
        if stop.load(Ordering::Relaxed) {
            return Ok(());
        }
        if !std::mem::replace(&mut waits, true) {
            eprintln!("taut: there is no topic '{topic}' yet: waiting for it");
        }
        participant.wait_for_graph_change(seen, Duration::from_millis(200));
    };
    let schema = node.find_schema(&topic, &topic_type.name)?;
    // What every publisher offers is asked for, and no more, so that none is left out.
    let offered = |policy: fn(&Qos) -> bool| publishers.iter().all(|publisher| policy(&publisher.qos));
    let mut qos = QosProfile::default();
    if !publishers.is_empty() && offered(|qos| qos.durability == Durability::TransientLocal) {
        qos = qos.transient_local();
    }
    if !offered(|qos| qos.reliability == Reliability::Reliable) {
        qos = qos.best_effort();
    }
    let mut messages = node.subscribe_raw(&topic, &topic_type.name, qos)?;
    while !stop.load(Ordering::Relaxed) {
        node.spin_once(Duration::from_millis(100));
        while let Some(Some(cdr)) = messages.next().now_or_never() {
            let mut out = io::stdout().lock();
            match DynamicMessage::from_cdr(&schema, &cdr) {
                Ok(message) if json => writeln!(out, "{}", message.to_json())?,
                Ok(message) => writeln!(out, "{}---", message.echo(ECHOED))?,
                Err(error) => eprintln!("taut: {error}"),
            }
            out.flush()?;
            if once {
                return Ok(());
            }
        }
    }
    Ok(())
}

/// As `ros2 topic echo`: elements of a list, characters of a text.
const ECHOED: usize = 128;
