// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut service`: lists and calls the services of a domain, without compiled-in types.

mod call;
mod named;

use crate::arguments::{full_name, full_type};
use crate::completions;
use crate::table::{write_table, write_wanted};
use crate::verb::{Outcome, Verbs};
use clap::Subcommand;
use named::services;
pub use named::{Named, actions, type_to_call};
use serde_json::Value;
use std::io::Write;
use tautline_transport::graph_of;

/// Lists and calls services.
///
/// Services of other hosts are visible if this host runs `taut gateway`.
/// Types need not be compiled in: processes cache their definitions
/// in /tmp/tautline_UID/schemas.
#[derive(Subcommand, Clone, Debug)]
#[command(after_help = "Examples:
  taut service list
  taut service list --json          with the nodes that answer
  taut service find std_srvs/srv/Trigger
  taut service call /lights '{data: true}'

Exit codes: 0 done, 1 the answer is no, 2 the arguments cannot be used.")]
pub enum Verb {
    /// Prints the services with their types and their numbers of servers and clients
    List,
    /// Prints the type of a service
    Type {
        /// The service
        #[arg(value_name = "SERVICE", add = completions::services())]
        service: String,
    },
    /// Prints the services of a type; exits with 1 if there are none
    Find {
        /// The type, such as std_srvs/srv/Trigger
        #[arg(value_name = "TYPE", add = completions::service_types())]
        type_name: String,
    },
    Call(call::CallArgs),
}

pub fn run(args: &Verbs<Verb>) -> Outcome {
    let common = &args.common;
    if let Verb::Call(args) = &args.verb {
        return call::run(args, common);
    }
    let graph = graph_of(common.domain()?)?;
    let services = services(&graph);
    let mut out = crate::print::stdout();
    match &args.verb {
        Verb::List if common.json => {
            let services = services.iter().map(|service| service.to_json("service"));
            writeln!(out, "{}", Value::from_iter(services))?;
        }
        Verb::List => {
            let head = ["service", "type", "where", "servers", "clients"];
            write_table(&head, 3, services.iter().map(Named::row).collect(), &mut out)?;
        }
        Verb::Type { service } => {
            let all: Vec<_> = services.iter().map(|service| (service.name, service.type_name)).collect();
            write_wanted(common.json, &full_name(service), &all, ("service", "service list"))?;
        }
        Verb::Find { type_name } => {
            let all: Vec<_> = services.iter().map(|service| (service.type_name, service.name)).collect();
            let wanted = full_type(type_name, "srv");
            write_wanted(common.json, &wanted, &all, ("service of type", "service list"))?;
        }
        Verb::Call(_) => {}
    }
    Ok(())
}
