// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut lifecycle`: the states of managed nodes, and their transitions.

use crate::call::{Caller, NodeCaller, PATIENCE, no_response, node_serving, nodes_serving};
use crate::completions;
use crate::verb::{CommonArgs, End, Failure, Outcome, Verbs};
use clap::Subcommand;
use serde_json::{Value, json};
use std::io::Write;
use tautline::lifecycle_msgs::msg::{State, TransitionDescription};
use tautline::lifecycle_msgs::srv::{ChangeState, GetAvailableTransitions, GetState};

const STATE: &str = "get_state";
const UNMANAGED: &str = "is not managed";

/// Prints and changes the states of managed nodes.
///
/// Nodes of other hosts are visible if this host runs `taut gateway`.
#[derive(Subcommand, Clone, Debug)]
#[command(after_help = "Examples:
  taut lifecycle nodes
  taut lifecycle get                of all nodes, in parallel
  taut lifecycle list /camera       the transitions that it can make now
  taut lifecycle set /camera configure

Exit codes: 0 done, 1 the answer is no, 2 the arguments cannot be used.")]
pub enum Verb {
    /// Prints the managed nodes
    Nodes,
    /// Prints the state of a node, or of all
    Get {
        /// The node's name with its namespace [default namespace: /]
        #[arg(value_name = "NODE", add = completions::nodes_with(STATE))]
        node: Option<String>,
    },
    /// Prints the transitions that are possible from a node's present state
    List {
        /// The node's name with its namespace [default namespace: /]
        #[arg(value_name = "NODE", add = completions::nodes_with(STATE))]
        node: String,
        /// Print all transitions, from any state
        #[arg(short, long)]
        all: bool,
    },
    /// Triggers a transition of a node and waits for its end; exits with 1 if it fails
    Set {
        /// The node's name with its namespace [default namespace: /]
        #[arg(value_name = "NODE", add = completions::nodes_with(STATE))]
        node: String,
        /// The transition: its label or its number
        #[arg(value_name = "TRANSITION", add = completions::transitions())]
        transition: String,
    },
}

pub fn run(args: &Verbs<Verb>) -> Outcome {
    let common = &args.common;
    match &args.verb {
        Verb::Nodes => {
            let nodes = nodes_serving(common.domain()?, STATE)?;
            let names: Vec<&str> = nodes.iter().map(String::as_str).collect();
            Ok(crate::table::write_names(common.json, &names, &mut crate::print::stdout())?)
        }
        Verb::Get { node } => get(common, node.as_deref()),
        Verb::List { node, all } => list(common, node, *all),
        Verb::Set { node, transition } => set(common, node, transition),
    }
}

fn get(common: &CommonArgs, node: Option<&str>) -> Outcome {
    let (end, domain) = (End::within(PATIENCE, common)?, common.domain()?);
    let nodes = match node {
        Some(node) => vec![node_serving(domain, node, STATE, UNMANAGED)?],
        None => nodes_serving(domain, STATE)?,
    };
    let requests =
        nodes.iter().map(|node| (format!("{node}/{STATE}"), GetState::Request::default())).collect();
    let answers = Caller::new(domain, end)?.call_all::<GetState::Service>(requests)?;
    let (mut told, mut silent, mut out) = (Vec::new(), 0, crate::print::stdout());
    for (name, answer) in nodes.iter().zip(answers) {
        let state = answer.map(|answer| answer.current_state);
        match &state {
            Err(error) => {
                silent += 1;
                eprintln!("taut: {name}: {}", no_response(error));
            }
            Ok(_) if common.json => {}
            Ok(State { id, label }) if node.is_some() => writeln!(out, "{label} [{id}]")?,
            Ok(State { id, label }) => writeln!(out, "{name}: {label} [{id}]")?,
        }
        told.push(json!({ "node": name, "state": state.ok() }));
    }
    if common.json {
        let told = if node.is_some() { told.remove(0) } else { Value::from(told) };
        writeln!(out, "{told}")?;
    }
    match silent {
        0 => Ok(()),
        silent => Err(Failure::no(format!("{silent} of {} nodes did not answer", nodes.len()))),
    }
}

fn list(common: &CommonArgs, node: &str, all: bool) -> Outcome {
    let service = if all { "get_transition_graph" } else { "get_available_transitions" };
    let transitions = transitions(&mut NodeCaller::find(common, node, service, UNMANAGED)?, service)?;
    let mut out = crate::print::stdout();
    if common.json {
        return Ok(writeln!(out, "{}", json!(transitions))?);
    }
    for TransitionDescription { transition, start_state, goal_state } in transitions {
        writeln!(out, "- {} [{}]", transition.label, transition.id)?;
        writeln!(out, "\tStart: {}\n\tGoal: {}", start_state.label, goal_state.label)?;
    }
    Ok(())
}

fn transitions(node: &mut NodeCaller, service: &str) -> Outcome<Vec<TransitionDescription>> {
    let request = GetAvailableTransitions::Request::default();
    Ok(node.call::<GetAvailableTransitions::Service>(service, request)?.available_transitions)
}

fn set(common: &CommonArgs, node: &str, wanted: &str) -> Outcome {
    let mut called = NodeCaller::find(common, node, "change_state", UNMANAGED)?;
    let available = transitions(&mut called, "get_available_transitions")?;
    let node = &called.name;
    let mut transitions = available.iter().map(|one| &one.transition);
    let id = wanted.parse::<u8>().ok();
    let Some(transition) = transitions.find(|one| one.label == wanted || Some(one.id) == id) else {
        let labels = available.iter().map(|one| one.transition.label.as_str());
        let (what, list) = (format!("transition of {node} as it is now"), format!("lifecycle list {node}"));
        return Err(Failure::unknown(&what, wanted, labels, &list));
    };
    // A transition may take long.
    called.caller.end = End::of(common)?;
    let request = ChangeState::Request { transition: transition.clone() };
    let changed = called.call::<ChangeState::Service>("change_state", request)?;
    let (mut out, node) = (crate::print::stdout(), &called.name);
    if common.json {
        let told = json!({ "node": node, "transition": transition, "successful": changed.success });
        writeln!(out, "{told}")?;
    } else if changed.success {
        writeln!(out, "Transitioning successful")?;
    }
    match changed.success {
        true => Ok(()),
        false => Err(Failure::no(format!("Transitioning failed: '{}' of {node}", transition.label))),
    }
}
