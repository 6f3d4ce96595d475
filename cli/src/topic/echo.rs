// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut topic echo`: prints messages.

use super::filter::Filter;
use super::tap::{POLL, Tap, wait_for_type};
use crate::arguments::full_name;
use crate::completions;
use crate::trace::csv::quoted;
use crate::verb::{CommonArgs, End, Failure, Outcome};
use clap::Args;
use std::io::Write;
use tautline_schema::{DynamicMessage, EchoForm, Endian, Value};

/// Prints the messages of a topic
///
/// Publishers on this host are not disturbed. Those on other hosts see a subscription, because messages of a topic without one are not
/// sent over the network. Messages that were overwritten before they were printed are counted at the end.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut topic echo /joint_states                 as ros2 topic echo, until Ctrl-C
  taut topic echo /map --once --no-arr
  taut topic echo /joint_states --field position[0] --csv
  taut topic echo /scan --filter '.range_max > 10' --json | jq .header.stamp")]
pub struct EchoArgs {
    /// The topic; waited for if it does not exist
    #[arg(value_name = "TOPIC", add = completions::topics())]
    topic: String,
    /// End after the first message
    #[arg(long, conflicts_with = "count")]
    once: bool,
    /// End after N messages
    #[arg(short = 'n', long = "count", value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    #[arg(long, value_name = "PATH", help = "Print this field alone, such as pose.position.x or ranges[3]", add = completions::fields())]
    field: Option<String>,
    /// Print the messages for which a result of this jq program is neither false nor null
    #[arg(long, value_name = "JQ")]
    filter: Option<String>,
    /// Print only type and length of arrays and sequences
    #[arg(long)]
    no_arr: bool,
    /// Print only the length of strings
    #[arg(long)]
    no_str: bool,
    /// Print all elements and characters, instead of the first 128
    #[arg(long, short = 'f')]
    full_length: bool,
    /// Print the values of a message in one line, separated by commas
    #[arg(long, conflicts_with = "json")]
    csv: bool,
    /// Print the bytes of CDR, in hexadecimal, as `taut msg decode --hex` reads them
    #[arg(long, conflicts_with_all = ["json", "csv", "field", "filter"])]
    raw: bool,
}

pub fn run(args: &EchoArgs, common: &CommonArgs) -> Outcome {
    let mut filter = args.filter.as_deref().map(Filter::new).transpose()?;
    let end = End::of(common)?;
    let (domain, topic) = (common.domain()?, full_name(&args.topic));
    let topic_type = wait_for_type(domain, &topic, &end)?;
    let mut tap = Tap::open(domain, &topic, topic_type)?;
    let schema = if args.raw { None } else { Some(tap.schema(&end)?) };
    let wanted = if args.once { Some(1) } else { args.count };
    let (mut printed, mut is_checked, mut left) = (0, false, None);
    while wanted.is_none_or(|wanted| printed < wanted) && left != Some(0) {
        // Messages may come faster than they are printed, so at the end only those that are already waiting are printed.
        left = match left {
            None if end.is_reached() => Some(tap.waiting()),
            left => left.map(|left| left - 1),
        };
        let Some(sample) = tap.take()? else {
            if left.is_some() {
                break;
            }
            if printed == 0 {
                end.print_waiting_once(|| format!("a message on '{topic}'"));
            }
            end.pause(POLL);
            continue;
        };
        let mut out = crate::print::stdout();
        let Some(schema) = &schema else {
            let hex = |bytes: &[u8]| bytes.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
            writeln!(out, "{}{}", hex(&tautline_msgs::HEADER), hex(sample.body()))?;
            printed += 1;
            continue;
        };
        match DynamicMessage::from_body(schema, sample.body(), Endian::Little) {
            Ok(message) => {
                // A wrong path is wrong for every message, but an element that is missing may exist in the next one.
                if let Some(path) = args.field.as_ref().filter(|_| !std::mem::replace(&mut is_checked, true))
                {
                    args.check_field(path, &message)?;
                }
                let text = match args.text(&message, filter.as_mut(), common.json) {
                    // A terminal's Ctrl-C ends the filter, too.
                    Err(_) if filter.is_some() && end.is_reached_soon() => break,
                    text => text?,
                };
                if let Some(text) = text {
                    out.write_all(text.as_bytes())?;
                    out.flush()?;
                    printed += 1;
                }
            }
            Err(error) => eprintln!("taut: {error}"),
        }
    }
    if tap.lost() > 0 {
        eprintln!("taut: {} messages were overwritten before they were printed", tap.lost());
    }
    match wanted.filter(|wanted| printed < *wanted) {
        Some(wanted) => Err(Failure::no(format!("{printed} of {wanted} messages came on '{topic}'"))),
        None => Ok(()),
    }
}

impl EchoArgs {
    fn check_field(&self, path: &str, message: &DynamicMessage) -> Outcome {
        let without_indices: String =
            path.split('[').map(|part| part.split_once(']').map_or(part, |(_, rest)| rest)).collect();
        match message.get(path) {
            Err(error) if message.get(&without_indices).is_err() => Err(error.into()),
            _ => Ok(()),
        }
    }

    /// The output for a message; `None` if the filter rejects it, or it does not have the element.
    fn text(
        &self,
        message: &DynamicMessage,
        filter: Option<&mut Filter>,
        json: bool,
    ) -> Outcome<Option<String>> {
        if let Some(filter) = filter
            && !filter.accepts(message)?
        {
            return Ok(None);
        }
        if json {
            let Some(path) = &self.field else { return Ok(Some(message.to_json() + "\n")) };
            return Ok(message.to_json_value().pointer(&pointer(path)).map(|value| format!("{value}\n")));
        }
        if self.csv {
            let mut cells = Vec::new();
            match &self.field {
                None => message.fields().iter().for_each(|field| collect(field, &mut cells)),
                Some(path) => match message.get(path) {
                    Ok(value) => collect(&value, &mut cells),
                    Err(_) => return Ok(None),
                },
            }
            return Ok(Some(cells.join(",") + "\n"));
        }
        let most = if self.full_length { usize::MAX } else { EchoForm::default().most };
        let form = EchoForm { most, no_lists: self.no_arr, no_texts: self.no_str };
        let text = match &self.field {
            None => message.echo(form),
            Some(path) => match message.echo_field(path, form) {
                Ok(text) => text,
                Err(_) => return Ok(None),
            },
        };
        Ok(Some(text + "---\n"))
    }
}

/// The JSON pointer of `a.b[0]`.
fn pointer(path: &str) -> String {
    format!("/{}", path.replace(']', "").replace(['.', '['], "/"))
}

/// Appends all values of a field in order.
fn collect(value: &Value, cells: &mut Vec<String>) {
    match value {
        Value::List(list) => {
            (0..list.len()).filter_map(|n| list.get(n)).for_each(|item| collect(&item, cells))
        }
        Value::Struct(fields) => fields.iter().for_each(|field| collect(field, cells)),
        Value::String(text) => cells.push(quoted(text)),
        Value::Bool(value) => cells.push(value.to_string()),
        Value::F32(value) => cells.push(value.to_string()),
        Value::F64(value) => cells.push(value.to_string()),
        integer => cells.push(integer.as_integer().unwrap_or(0).to_string()),
    }
}
