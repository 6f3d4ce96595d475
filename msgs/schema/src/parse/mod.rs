// SPDX-License-Identifier: MIT OR Apache-2.0
//! Text of `.msg`, `.srv` and `.action` files to definitions.
//!
//! Accepts what ROS 2's `rosidl_adapter` accepts and reads it the same way, also where that is surprising: `#` starts a
//! comment even inside a string, and the comment lines at the very start belong to the message, not to its first field.
//! Fields whose names are keywords of C++ are refused: ROS 2 cannot build their packages.

mod docs;
mod line;
mod literal;

use std::collections::HashSet;
use std::sync::Arc;

use crate::definition::EMPTY_MEMBER;
use crate::{
    Base, Constant, Definition, Fault, Field, FieldType, Kind, Place, Primitive, SchemaError, Shape,
    TypeName, derived, names,
};
use docs::Docs;
use line::Line;
pub(crate) use line::{Numbered, lines, shortened};
pub(crate) use literal::parse_python_default;

/// Parses a `.msg` file's text. `file` is what errors call it.
///
/// # Errors
/// [`SchemaError::Definition`] with the place of the first fault.
pub fn parse_message(name: &TypeName, file: &str, text: &str) -> Result<Definition, SchemaError> {
    parse_part(name, &file.into(), &lines(text), names::check_field)
}

/// Parses a `.srv` file's text: the service, its request, response and event, in this order.
///
/// # Errors
/// [`SchemaError::Definition`] with the place of the first fault.
pub fn parse_service(name: &TypeName, file: &str, text: &str) -> Result<Vec<Definition>, SchemaError> {
    let file = Arc::from(file);
    let lines = lines(text);
    let [request, response] = split(&lines, &file, "service")?;
    let request = parse_part(&derived::part(name, "_Request"), &file, request, names::check_field)?;
    let response = parse_part(&derived::part(name, "_Response"), &file, response, names::check_field)?;
    Ok(derived::service(name, request, response))
}

/// Parses an `.action` file's text: the action, its goal, result and feedback, and all services and messages that ROS
/// derives from them.
///
/// # Errors
/// [`SchemaError::Definition`] with the place of the first fault.
pub fn parse_action(name: &TypeName, file: &str, text: &str) -> Result<Vec<Definition>, SchemaError> {
    let file = Arc::from(file);
    let lines = lines(text);
    let [goal, result, feedback] = split(&lines, &file, "action")?;
    let goal = parse_part(&derived::part(name, "_Goal"), &file, goal, names::check_field)?;
    let result = parse_part(&derived::part(name, "_Result"), &file, result, names::check_field)?;
    let feedback = parse_part(&derived::part(name, "_Feedback"), &file, feedback, names::check_field)?;
    Ok(derived::action(name, goal, result, feedback))
}

/// Parses the text of a file of the name's kind.
///
/// # Errors
/// [`SchemaError::Definition`] with the place of the first fault.
pub fn parse(name: &TypeName, file: &str, text: &str) -> Result<Vec<Definition>, SchemaError> {
    match name.kind() {
        Kind::Msg => Ok(vec![parse_message(name, file, text)?]),
        Kind::Srv => parse_service(name, file, text),
        Kind::Action => parse_action(name, file, text),
    }
}

/// The parts between lines `---`.
fn split<'a, const N: usize>(
    lines: &'a [Numbered<'a>],
    file: &Arc<str>,
    what: &'static str,
) -> Result<[&'a [Numbered<'a>]; N], SchemaError> {
    let parts: Vec<_> = lines.split(|(_, line)| line.trim_end() == "---").collect();
    let found = parts.len() - 1;
    parts.try_into().map_err(|_| {
        let line = lines.last().map_or(1, |(number, _)| *number);
        let place = Place { file: file.clone(), line, column: 1 };
        SchemaError::Definition { place, fault: Fault::Separators { what, needed: N - 1, found } }
    })
}

/// Whether a field may have this name. Files have stricter rules than texts that were written from type descriptions.
pub(crate) type CheckField = fn(&str) -> Result<(), Fault>;

/// Parses the lines of one message.
pub(crate) fn parse_part(
    name: &TypeName,
    file: &Arc<str>,
    lines: &[Numbered<'_>],
    check_field: CheckField,
) -> Result<Definition, SchemaError> {
    let mut definition = Definition {
        name: name.clone(),
        fields: vec![],
        constants: vec![],
        docs: String::new(),
        file: file.clone(),
    };
    let (mut docs, lines) = Docs::start(lines);
    let mut names = HashSet::new();
    for &(number, text) in lines {
        let error = |line: &Line<'_>, fault| {
            let place = Place { file: file.clone(), line: number, column: line.column() };
            Err(SchemaError::Definition { place, fault })
        };
        let mut line = Line::new(docs.strip(text));
        if line.is_empty() {
            continue;
        }
        let type_start = line;
        let type_text = line.word();
        let name_start = line;
        let member = line.name();
        if member.is_empty() {
            return error(&type_start, Fault::Line { line: shortened(type_start.rest()) });
        }
        // A field and a constant cannot have the same name either.
        if !names.insert(member) {
            return error(&name_start, Fault::Duplicate { name: member.to_owned() });
        }
        if let Some(value) = line.constant_value() {
            match parse_constant(type_text, member, value.rest(), name.package()) {
                Ok(constant) => definition.constants.push(constant),
                Err((At::Type, fault)) => return error(&type_start, fault),
                Err((At::Name, fault)) => return error(&name_start, fault),
                Err((At::Value, fault)) => return error(&value, fault),
            }
            docs.constant(definition.constants.len() - 1);
        } else {
            let place = Place { file: file.clone(), line: number, column: type_start.column() };
            match parse_field(type_text, (member, check_field), line.rest(), name.package(), place) {
                Ok(field) => definition.fields.push(field),
                Err((At::Type, fault)) => return error(&type_start, fault),
                Err((At::Name, fault)) => return error(&name_start, fault),
                Err((At::Value, fault)) => return error(&line, fault),
            }
            docs.field(definition.fields.len() - 1);
        }
    }
    docs.attach(&mut definition);
    if definition.fields.is_empty() {
        definition.fields.push(empty_member(file));
    }
    Ok(definition)
}

/// What ROS puts into a message without fields.
fn empty_member(file: &Arc<str>) -> Field {
    Field {
        name: EMPTY_MEMBER.to_owned(),
        ty: FieldType { base: Base::Primitive(Primitive::U8), shape: Shape::Single },
        default: None,
        default_text: String::new(),
        docs: String::new(),
        place: Place { file: file.clone(), line: 0, column: 0 },
    }
}

/// The part of a line that is wrong.
enum At {
    Type,
    Name,
    Value,
}

fn parse_constant(ty: &str, name: &str, value: &str, package: &str) -> Result<Constant, (At, Fault)> {
    let parsed = parse_type(ty, package).map_err(|fault| (At::Type, fault))?;
    if parsed.shape != Shape::Single || matches!(parsed.base, Base::Nested(_)) {
        return Err((At::Type, Fault::ConstantType { text: shortened(ty) }));
    }
    names::check_constant(name).map_err(|fault| (At::Name, fault))?;
    let (value, _) = literal::scalar(&parsed.base, value).map_err(|fault| (At::Value, fault))?;
    Ok(Constant { name: name.to_owned(), ty: parsed.base, value, docs: String::new() })
}

fn parse_field(
    ty: &str,
    (name, check_field): (&str, CheckField),
    default: &str,
    package: &str,
    place: Place,
) -> Result<Field, (At, Fault)> {
    let ty = parse_type(ty, package).map_err(|fault| (At::Type, fault))?;
    check_field(name).map_err(|fault| (At::Name, fault))?;
    let (default, default_text) = match default {
        "" => (None, String::new()),
        text => {
            let (value, text) = literal::default(&ty, text).map_err(|fault| (At::Value, fault))?;
            (Some(value), text)
        }
    };
    Ok(Field { name: name.to_owned(), ty, default, default_text, docs: String::new(), place })
}

/// Parses a type such as `string<=5[<=3]` or `Point[]`; `package` is that of names without one.
pub(crate) fn parse_type(text: &str, package: &str) -> Result<FieldType, Fault> {
    let bad = || Fault::Type { text: shortened(text) };
    let (base, shape) = match text.strip_suffix(']') {
        None => (text, Shape::Single),
        Some(rest) => {
            let (base, len) = rest.rsplit_once('[').ok_or_else(bad)?;
            let shape = match (len, len.strip_prefix("<=")) {
                ("", _) => Shape::Unbounded,
                (_, Some(bound)) => Shape::Bounded(parse_bound(bound)?),
                (len, None) => Shape::Array(parse_bound(len)?),
            };
            (base, shape)
        }
    };
    let base = match base.split_once("<=") {
        Some(("string", bound)) => Base::String { bound: Some(parse_bound(bound)?) },
        Some(("wstring", bound)) => Base::WString { bound: Some(parse_bound(bound)?) },
        Some(_) => return Err(bad()),
        None => match (base, Primitive::from_name(base)) {
            (_, Some(primitive)) => Base::Primitive(primitive),
            ("string", _) => Base::String { bound: None },
            ("wstring", _) => Base::WString { bound: None },
            _ if base.contains('/') => Base::Nested(base.parse().map_err(|_| bad())?),
            _ => Base::Nested(TypeName::new(package, Kind::Msg, base).map_err(|_| bad())?),
        },
    };
    Ok(FieldType { base, shape })
}

fn parse_bound(text: &str) -> Result<u32, Fault> {
    let digits = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let bound = if digits { text.parse().unwrap_or(0) } else { 0 };
    if bound == 0 { Err(Fault::Bound { text: shortened(text) }) } else { Ok(bound) }
}
