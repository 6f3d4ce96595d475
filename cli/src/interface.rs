// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut interface`: lists types, and prints their definitions as ROS 2's tools do.

use crate::completions;
use crate::find::Finder;
use crate::msg::parts;
use crate::table::{write_names, write_wanted};
use crate::verb::{CommonArgs, Failure, Outcome};
use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, Subcommand};
use serde_json::json;
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::io::Write;
use std::path::PathBuf;
use std::sync::Arc;
use tautline_schema::{Base, Definition, DynamicMessage, EchoForm, Kind, Schema, TypeName};

/// Lists the types of messages, services and actions; prints their definitions.
///
/// Types are searched in --path, in the prefixes of AMENT_PREFIX_PATH (source your ROS 2), in this program, and in the
/// definitions that the domain's processes have cached. `taut msg` shows their layouts and hashes.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut interface show sensor_msgs/msg/LaserScan
  taut interface show example_interfaces/action/Fibonacci --no-comments
  taut interface proto geometry_msgs/msg/Twist     the values, to be edited for `taut topic pub`
  taut interface list --only srvs
  taut interface package my_msgs --path ~/ws/src

Exit codes: 0 done, 1 there is no such type, 2 the arguments cannot be used.")]
pub struct InterfaceArgs {
    #[command(subcommand)]
    verb: Verb,
    /// Search this folder too: a prefix, a folder of packages, or a package
    #[arg(long, value_name = "DIR", global = true)]
    path: Vec<PathBuf>,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Subcommand, Clone, Debug)]
enum Verb {
    /// Prints the types
    List {
        /// Print only these
        #[arg(long, value_parser = kinds(), value_name = "KIND")]
        only: Option<Kind>,
    },
    /// Prints the types of a package
    Package {
        /// The package
        #[arg(value_name = "PACKAGE", add = completions::packages())]
        package: String,
    },
    /// Prints the packages that have types
    Packages {
        /// Print only packages with these
        #[arg(long, value_parser = kinds(), value_name = "KIND")]
        only: Option<Kind>,
    },
    /// Prints the definition of a type, with those of its fields
    Show {
        /// package/Name, package/srv/Name, package/action/Name, or a file (.msg, .srv, .action)
        #[arg(value_name = "TYPE", add = completions::interfaces())]
        name: String,
        /// Leave out comments
        #[arg(long)]
        no_comments: bool,
        /// Print comments of the fields' types too
        #[arg(long, conflicts_with = "no_comments")]
        all_comments: bool,
    },
    /// Prints the values of a message, request or goal, all with their defaults, as YAML or JSON
    Proto {
        /// The type, as for show
        #[arg(value_name = "TYPE", add = completions::interfaces())]
        name: String,
    },
}

fn kinds() -> impl TypedValueParser<Value = Kind> {
    let kind = |name: String| Kind::from_name(name.trim_end_matches('s')).ok_or("it is no kind");
    PossibleValuesParser::new(["msgs", "srvs", "actions"]).try_map(kind)
}

pub fn run(args: &InterfaceArgs) -> Outcome {
    let common = &args.common;
    let mut out = crate::print::stdout();
    match &args.verb {
        Verb::List { only } => {
            let mut types = finder(args)?.list()?;
            types.retain(|name| only.is_none_or(|only| name.kind() == only));
            if common.json {
                let names: Vec<&str> = types.iter().map(TypeName::as_str).collect();
                return Ok(write_names(true, &names, &mut out)?);
            }
            for (title, kind) in
                [("Messages:", Kind::Msg), ("Services:", Kind::Srv), ("Actions:", Kind::Action)]
            {
                let mut of_kind = types.iter().filter(|name| name.kind() == kind).peekable();
                if of_kind.peek().is_some() {
                    writeln!(out, "{title}")?;
                    of_kind.try_for_each(|name| writeln!(out, "    {name}"))?;
                }
            }
            Ok(())
        }
        Verb::Package { package } => {
            let types = finder(args)?.list()?;
            let all: Vec<_> = types.iter().map(|name| (name.package(), name.as_str())).collect();
            write_wanted(common.json, package, &all, ("package", "interface packages"))
        }
        Verb::Packages { only } => {
            let types = finder(args)?.list()?;
            let wanted = types.iter().filter(|name| only.is_none_or(|only| name.kind() == only));
            let names: BTreeSet<&str> = wanted.map(TypeName::package).collect();
            Ok(write_names(common.json, &names.into_iter().collect::<Vec<_>>(), &mut out)?)
        }
        Verb::Show { name, no_comments, all_comments } => {
            let schema = find(args, name)?;
            let depth = match (no_comments, all_comments) {
                (true, _) => 0,
                (_, true) => usize::MAX,
                _ => 1,
            };
            let text = shown(&schema, depth);
            if common.json {
                let (name, hash) = (schema.name().to_string(), schema.hash().to_string());
                return Ok(writeln!(out, "{}", json!({ "type": name, "hash": hash, "definition": text }))?);
            }
            Ok(out.write_all(text.as_bytes())?)
        }
        Verb::Proto { name } => {
            let schema = find(args, name)?;
            let message = match parts(&schema).first() {
                Some(part) => schema.of_part(&format!("{}{part}", schema.name()).parse()?)?,
                None => schema,
            };
            let message = DynamicMessage::new(&Arc::new(message));
            match common.json {
                true => Ok(writeln!(out, "{}", message.to_json())?),
                false => Ok(out.write_all(message.echo(EchoForm::default()).as_bytes())?),
            }
        }
    }
}

fn finder(args: &InterfaceArgs) -> Outcome<Finder> {
    Ok(Finder::new(&args.path).in_domain(args.common.domain()?))
}

fn find(args: &InterfaceArgs, name: &str) -> Outcome<Schema> {
    let mut finder = finder(args)?;
    finder.schema(name).map_err(|error| {
        let whole = name.parse::<TypeName>().map_or(name.to_owned(), |name| name.to_string());
        match finder.list() {
            // The domain has the type, but no process has cached its definition.
            Ok(types) if types.iter().any(|name| name.as_str() == whole) => Failure::no(error.to_string()),
            Ok(types) if error.is_missing(&whole) => {
                Failure::unknown("type", &whole, types.iter().map(TypeName::as_str), "interface list")
            }
            _ => Failure::from(error),
        }
    })
}

/// The text of `ros2 interface show`: nested fields are indented, and the first `comments` levels have their comments.
fn shown(schema: &Schema, comments: usize) -> String {
    let mut text = String::new();
    let parts = parts(schema);
    if parts.is_empty() {
        print(schema, schema.definition(), 0, comments, &mut text);
    }
    for (index, part) in parts.iter().enumerate() {
        if index > 0 {
            text.push_str("---\n");
        }
        let name = format!("{}{part}", schema.name());
        if let Some(definition) = schema.referenced().find(|one| one.name.as_str() == name) {
            print(schema, definition, 0, comments, &mut text);
        }
    }
    text
}

fn print(schema: &Schema, definition: &Definition, depth: usize, comments: usize, text: &mut String) {
    let margin = "\t".repeat(depth);
    let comment = |docs: &str, text: &mut String| {
        if depth < comments {
            for line in docs.lines() {
                // Writing to a `String` cannot fail.
                let _ = writeln!(text, "{}", format!("{margin}# {line}").trim_end());
            }
        }
    };
    comment(&definition.docs, text);
    for constant in &definition.constants {
        comment(&constant.docs, text);
        let _ = writeln!(text, "{margin}{} {}={}", constant.ty, constant.name, constant.value);
    }
    if definition.is_empty() {
        return;
    }
    for field in &definition.fields {
        comment(&field.docs, text);
        let default = field.default.as_ref().map_or_else(String::new, |value| format!(" {value}"));
        let _ = writeln!(text, "{margin}{} {}{default}", field.ty, field.name);
        if let Base::Nested(name) = &field.ty.base
            && let Some(of_field) = schema.referenced().find(|one| one.name == *name)
        {
            print(schema, of_field, depth + 1, comments, text);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn definitions_are_printed_with_those_of_their_fields() {
        let text = "# Where it is\n\nuint8 LOST=255\n# Since the start\nbuiltin_interfaces/Time stamp\nstring<=5[<=3] names [\"a\"]\n";
        let name = "demo_msgs/msg/Place".parse().unwrap();
        let schema = Schema::from_text(&name, text).unwrap();
        let fields =
            "builtin_interfaces/Time stamp\n\tint32 sec\n\tuint32 nanosec\nstring<=5[<=3] names [\"a\"]\n";
        assert_eq!(shown(&schema, 0), format!("uint8 LOST=255\n{fields}"));
        assert_eq!(shown(&schema, 1), format!("# Where it is\nuint8 LOST=255\n# Since the start\n{fields}"));
    }

    #[test]
    fn services_have_two_parts() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("demo_msgs/srv/Get.srv");
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(&file, "---\nstring text\n").unwrap();
        let schema = Finder::new(&[]).schema(file.to_str().unwrap()).unwrap();
        assert_eq!(shown(&schema, 1), "---\nstring text\n");
    }
}
