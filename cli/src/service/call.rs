// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut service call`: sends a request and prints the response.

use super::named::{services, type_to_call};
use crate::arguments::{WrittenMessage, full_name, type_and_values};
use crate::call::Caller;
use crate::completions;
use crate::verb::{CommonArgs, End, Failure, Outcome};
use clap::Args;
use std::io::Write;
use tautline::{Error, Json};
use tautline_schema::DynamicMessage;
use tautline_transport::graph_of;

/// Calls a service and prints its response
///
/// Values are YAML or JSON; omitted fields have their defaults, a header may be `auto` and a time `now`. Waits for the response until Ctrl-C, or until --timeout.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut service call /lights '{data: true}'
  taut service call /lights std_srvs/srv/SetBool '{data: true}' --timeout 2s
  taut service call /reset --json | jq .success

Exit codes: 0 answered, 1 no such service, or no answer, 2 no request of its type.")]
pub struct CallArgs {
    /// The service
    #[arg(value_name = "SERVICE", add = completions::servers())]
    service: String,
    /// The type, if there are servers of several, and the values, if they are not the defaults
    #[arg(value_name = "[TYPE] [VALUES]", num_args = 0..=2, add = completions::types_of_service())]
    request: Vec<String>,
}

pub fn run(args: &CallArgs, common: &CommonArgs) -> Outcome {
    let (end, domain, service) = (End::of(common)?, common.domain()?, full_name(&args.service));
    let (type_name, values) = type_and_values(&args.request, "srv");
    let graph = graph_of(domain)?;
    let type_name = type_to_call("service", &service, &services(&graph), type_name)?;
    let mut caller = Caller::new(domain, end)?;
    let client = caller.node.create_client_untyped(&service, &type_name)?;
    let (request, response) = client.definitions();
    let request = Json(WrittenMessage::new(request, values)?.message.to_json_value());
    let answer = caller.wait(|| format!("'{service}' to answer"), async {
        client.wait_for_service()?.await?;
        client.request(&request)?.await
    })?;
    // A response that is not a valid message exits with 2 (the second `?`), not with 1.
    let answer = answer.map_err(|error: Error| Failure::no(error.to_string()))??;
    let mut out = crate::print::stdout();
    if common.json {
        return Ok(writeln!(out, "{answer}")?);
    }
    let response = DynamicMessage::from_json_value(response, &answer)?;
    Ok(write!(out, "{response}")?)
}
