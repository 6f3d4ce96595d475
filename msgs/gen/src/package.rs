// SPDX-License-Identifier: MIT OR Apache-2.0
//! Packages to modules.

use std::collections::{BTreeMap, BTreeSet};

use tautline_schema::{Base, Kind, Packages, Schema, TypeName};

use crate::memory::Memory;
use crate::names::Taken;
use crate::text::Text;
use crate::{GenerateError, Options, message, names};

/// A message, a part of a service or of an action, and where generated code has it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RustType {
    /// Its ROS 2 name.
    pub name: TypeName,
    /// Its path from the module of the packages: `std_srvs::srv::SetBool::Request`.
    pub path: String,
    /// Whether it is `Plain`.
    pub is_plain: bool,
}

/// The code of these packages: a module for each, side by side.
///
/// # Errors
/// [`GenerateError`] if a package has no definitions, one of them is not valid, or needs a package that is neither
/// given nor [external](Options::external).
pub fn generate(packages: &mut Packages, names: &[&str], options: &Options) -> Result<String, GenerateError> {
    let taken = Taken::among(&packages.list());
    let mut generator = Generator { packages, names, options, taken, text: Text::default() };
    for package in names.iter().collect::<BTreeSet<_>>() {
        generator.package(package)?;
    }
    Ok(generator.text.finish())
}

/// The messages for which [`generate`] writes structs, those of services and actions included, in order of their names.
///
/// # Errors
/// As [`generate`].
pub fn messages(packages: &mut Packages, names: &[&str]) -> Result<Vec<RustType>, GenerateError> {
    let mut types = BTreeMap::new();
    for name in names.iter().copied().collect::<BTreeSet<_>>() {
        for name in definitions(packages, name)? {
            let schema = packages.schema(&name)?;
            let parts = schema.referenced().chain([schema.definition()]);
            let own = parts.filter(|part| {
                part.name.package() == name.package()
                    && part.name.kind() == name.kind()
                    && !is_service_or_action(part)
            });
            for part in own {
                types.insert(part.name.clone(), Memory::of(&schema.of_part(&part.name)?).is_plain());
            }
        }
    }
    let path = |name: &TypeName| format!("{}::{}", names::item(name.package()), names::path(name));
    Ok(types.into_iter().map(|(name, is_plain)| RustType { path: path(&name), name, is_plain }).collect())
}

/// Services and actions are definitions whose fields are their parts.
fn is_service_or_action(definition: &tautline_schema::Definition) -> bool {
    let first = definition.fields.first().map(|field| &field.ty.base);
    let part = |suffix: &str| format!("{}_{suffix}", definition.name);
    definition.name.kind() != Kind::Msg
        && matches!(first, Some(Base::Nested(first)) if first.as_str() == part("Request") || first.as_str() == part("Goal"))
}

/// The types that a package's folders have files of.
fn definitions(packages: &Packages, package: &str) -> Result<Vec<TypeName>, GenerateError> {
    let names: Vec<_> = packages.list().into_iter().filter(|name| name.package() == package).collect();
    if names.is_empty() {
        let folders: Vec<_> = packages.folders().iter().map(|folder| folder.display().to_string()).collect();
        let searched = if folders.is_empty() { "no folder at all".to_owned() } else { folders.join(", ") };
        return Err(GenerateError::Empty { package: package.to_owned(), searched });
    }
    Ok(names)
}

/// The functions of `Action`: signatures, and bodies, line by line.
const ACTION_FUNCTIONS: &[(&str, &str)] = &[
    (
        "make_goal_request_msg(goal_id: [u8; 16], goal: Goal) -> SendGoal::Request",
        "let mut msg = SendGoal::Request::default();\nmsg.goal_id.uuid = goal_id;\nmsg.goal = goal;\nmsg",
    ),
    (
        "make_goal_response_msg(accepted: bool, stamp: (i32, u32)) -> SendGoal::Response",
        "let mut msg = SendGoal::Response::default();\nmsg.accepted = accepted;\n(msg.stamp.sec, msg.stamp.nanosec) = stamp;\nmsg",
    ),
    (
        "make_feedback_msg(goal_id: [u8; 16], feedback: Feedback) -> FeedbackMessage",
        "let mut msg = FeedbackMessage::default();\nmsg.goal_id.uuid = goal_id;\nmsg.feedback = feedback;\nmsg",
    ),
    (
        "make_result_request_msg(goal_id: [u8; 16]) -> GetResult::Request",
        "let mut msg = GetResult::Request::default();\nmsg.goal_id.uuid = goal_id;\nmsg",
    ),
    (
        "make_result_response_msg(status: i8, result: Result) -> GetResult::Response",
        "GetResult::Response { status, result }",
    ),
    (
        "destructure_goal_request_msg(msg: SendGoal::Request) -> ([u8; 16], Goal)",
        "(msg.goal_id.uuid, msg.goal)",
    ),
    (
        "destructure_goal_response_msg(msg: SendGoal::Response) -> (bool, (i32, u32))",
        "(msg.accepted, (msg.stamp.sec, msg.stamp.nanosec))",
    ),
    (
        "destructure_feedback_msg(msg: FeedbackMessage) -> ([u8; 16], Feedback)",
        "(msg.goal_id.uuid, msg.feedback)",
    ),
    ("destructure_result_response_msg(msg: GetResult::Response) -> (i8, Result)", "(msg.status, msg.result)"),
    ("destructure_result_request_msg(msg: GetResult::Request) -> [u8; 16]", "msg.goal_id.uuid"),
];

struct Generator<'a> {
    packages: &'a mut Packages,
    names: &'a [&'a str],
    options: &'a Options,
    taken: Taken,
    text: Text,
}

impl Generator<'_> {
    fn package(&mut self, package: &str) -> Result<(), GenerateError> {
        let definitions = definitions(self.packages, package)?;
        self.text.gap();
        self.text.doc(&format!("Package `{package}`."));
        self.text.line("#[allow(clippy::all, non_camel_case_types, non_snake_case)]");
        let package_module = names::item(package);
        self.text.line(&format!("pub mod {package_module} {{"));
        for (kind, docs) in [(Kind::Action, "Actions."), (Kind::Msg, "Messages."), (Kind::Srv, "Services.")] {
            let of_kind: Vec<_> = definitions.iter().filter(|name| name.kind() == kind).collect();
            if of_kind.is_empty() {
                continue;
            }
            self.open(kind.as_str(), docs);
            for name in of_kind {
                let schema = self.packages.schema(name)?;
                let module = format!("{package_module}::{}", kind.as_str());
                match kind {
                    Kind::Msg => self.message(&schema, &names::item(name.name()), &module)?,
                    Kind::Srv => self.service(&schema, &names::item(name.name()), &module)?,
                    Kind::Action => self.action(&schema, &module)?,
                }
            }
            self.text.line("}");
        }
        self.text.line("}");
        Ok(())
    }

    fn open(&mut self, module: &str, docs: &str) {
        self.text.gap();
        self.text.doc(docs);
        self.text.line(&format!("pub mod {module} {{"));
    }

    fn message(&mut self, schema: &Schema, name: &str, module: &str) -> Result<(), GenerateError> {
        let definition = schema.definition();
        for field in &definition.fields {
            if let Base::Nested(nested) = &field.ty.base {
                let package = nested.package();
                if !self.names.contains(&package) && !self.options.external.contains_key(package) {
                    return Err(GenerateError::Package {
                        type_name: definition.name.to_string(),
                        field: field.name.clone(),
                        package: package.to_owned(),
                    });
                }
            }
        }
        Ok(message::write(&mut self.text, schema, name, module, (self.options, &self.taken))?)
    }

    /// The schema of a part of a service or action.
    fn part(&mut self, schema: &Schema, part: &str) -> Result<Schema, GenerateError> {
        let name: TypeName = format!("{}_{part}", schema.name()).parse()?;
        Ok(self.packages.schema(&name)?)
    }

    /// The module `name` in the module `parent`.
    fn service(&mut self, schema: &Schema, name: &str, parent: &str) -> Result<(), GenerateError> {
        let module = format!("{parent}::{name}");
        self.open(name, &format!("Service `{}`.", schema.name()));
        self.marker(schema, "Service", &["Request", "Response", "Event"], &[]);
        for part in ["Request", "Response", "Event"] {
            let schema = self.part(schema, part)?;
            self.message(&schema, part, &module)?;
        }
        self.text.line("}");
        Ok(())
    }

    fn action(&mut self, schema: &Schema, parent: &str) -> Result<(), GenerateError> {
        let name = names::item(schema.name().name());
        let module = format!("{parent}::{name}");
        self.open(&name, &format!("Action `{}`.", schema.name()));
        let messages = ["Goal", "Result", "Feedback", "FeedbackMessage"];
        let services = ["SendGoal", "GetResult"];
        self.marker(schema, "Action", &[&messages[..], &services[..]].concat(), ACTION_FUNCTIONS);
        for part in messages {
            let schema = self.part(schema, part)?;
            self.message(&schema, part, &module)?;
        }
        for part in services {
            let schema = self.part(schema, part)?;
            self.service(&schema, part, &module)?;
        }
        self.text.line("}");
        Ok(())
    }

    /// The struct that stands for a service or an action.
    fn marker(&mut self, schema: &Schema, name: &str, parts: &[&str], functions: &[(&str, &str)]) {
        let text = &mut self.text;
        text.doc(&format!("`{}`", schema.name()));
        text.line("#[derive(Clone, Copy, Debug, PartialEq, Eq)]");
        text.line(&format!("pub struct {name};"));
        text.gap();
        text.line(&format!("impl {}::{name} for {name} {{", self.options.msgs));
        for part in parts {
            let service = matches!(*part, "SendGoal" | "GetResult");
            text.line(&format!("type {part} = {part}{};", if service { "::Service" } else { "" }));
        }
        text.pair("const TYPE_NAME: &'static str =", &format!("\"{}\";", schema.name()));
        text.pair("const TYPE_HASH: &'static str =", &format!("\"{}\";", schema.hash()));
        for (signature, body) in functions {
            text.gap();
            text.line(&format!("fn {signature} {{"));
            body.lines().for_each(|line| text.line(line));
            text.line("}");
        }
        text.line("}");
    }
}
