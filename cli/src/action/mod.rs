// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut action`: lists the actions of a domain, and sends goals.

mod send_goal;

use crate::arguments::full_name;
use crate::completions;
use crate::service::{Named, actions};
use crate::verb::{Failure, Outcome, Verbs};
use clap::Subcommand;
use serde_json::Value;
use std::io::{self, Write};
use tautline_transport::{ServiceKind, graph_of};

/// Lists actions and their nodes, and sends goals.
///
/// Actions of other hosts are visible if this host runs `taut gateway`.
#[derive(Subcommand, Clone, Debug)]
#[command(after_help = "Examples:
  taut action list
  taut action info /fibonacci
  taut action send_goal /fibonacci '{order: 5}' --feedback

Exit codes: 0 done, 1 the answer is no, 2 the arguments cannot be used.")]
pub enum Verb {
    /// Prints the actions with their types and their numbers of servers and clients
    List,
    /// Prints the nodes that serve an action, and those that send it goals
    Info {
        /// The action
        #[arg(value_name = "ACTION", add = completions::actions())]
        action: String,
    },
    #[command(name = "send_goal", visible_alias = "send-goal")]
    SendGoal(send_goal::SendGoalArgs),
}

pub fn run(args: &Verbs<Verb>) -> Outcome {
    let common = &args.common;
    if let Verb::SendGoal(args) = &args.verb {
        return send_goal::run(args, common);
    }
    let graph = graph_of(common.domain()?)?;
    let mut actions = actions(&graph);
    let mut out = crate::print::stdout();
    if let Verb::Info { action } = &args.verb {
        let name = full_name(action);
        if !actions.iter().any(|action| action.name == name) {
            let there = actions.iter().map(|action| action.name);
            return Err(Failure::unknown("action", &name, there, "action list"));
        }
        // More than one if nodes disagree on its type.
        actions.retain(|action| action.name == name);
        if !common.json {
            return Ok(actions.iter().try_for_each(|action| print(action, &mut out))?);
        }
    }
    if common.json {
        let actions = actions.iter().map(|action| action.to_json("action"));
        return Ok(writeln!(out, "{}", Value::from_iter(actions))?);
    }
    let head = ["action", "type", "where", "servers", "clients"];
    Ok(crate::table::write_table(&head, 3, actions.iter().map(Named::row).collect(), &mut out)?)
}

fn print(action: &Named, out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "Action: {}\nType: {}", action.name, action.type_name)?;
    for (kind, title) in [(ServiceKind::Client, "clients"), (ServiceKind::Server, "servers")] {
        writeln!(out, "Action {title}: {}", action.count(kind))?;
        action.nodes(kind).try_for_each(|node| writeln!(out, "    {node}"))?;
    }
    Ok(())
}
