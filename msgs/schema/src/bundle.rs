// SPDX-License-Identifier: MIT OR Apache-2.0
//! One text with a type and all types that it consists of.

use std::collections::BTreeMap;
use std::fmt::{self, Write};
use std::sync::Arc;

use crate::field_type::short_name;
use crate::number::python_float;
use crate::parse::{Numbered, lines, parse_part, shortened};
use crate::{Definition, Fault, Place, SchemaError, TypeName, Value, names};

/// Parses a type and those that follow it.
pub(crate) fn parse(name: &TypeName, text: &str) -> Result<BTreeMap<TypeName, Arc<Definition>>, SchemaError> {
    let file: Arc<str> = name.as_str().into();
    let lines = lines(text);
    let mut definitions = BTreeMap::new();
    let mut sections = lines.split(|(_, line)| is_separator(line));
    let first = sections.next().unwrap_or_default();
    // Some writers start with a separator and name the first type as well.
    if first.iter().any(|(_, line)| !line.trim().is_empty())
        || !lines.first().is_some_and(|(_, line)| is_separator(line))
    {
        definitions.insert(name.clone(), Arc::new(parse_part(name, &file, first, names::check_member)?));
    }
    for section in sections {
        let (name, body) = header(section, &file)?;
        let definition = parse_part(&name, &file, body, names::check_member)?;
        if let Some(known) = definitions.get(&name) {
            if known.to_text() != definition.to_text() {
                return Err(SchemaError::Conflict { name: name.to_string() });
            }
            continue;
        }
        definitions.insert(name, Arc::new(definition));
    }
    Ok(definitions)
}

/// Writes a type and those it consists of.
pub(crate) fn write<'a>(root: &Definition, referenced: impl Iterator<Item = &'a Definition>) -> String {
    let mut text = root.to_text();
    for definition in referenced {
        text.push_str(&"=".repeat(80));
        text.push_str("\nMSG: ");
        text.push_str(&short_name(&definition.name));
        text.push('\n');
        text.push_str(&definition.to_text());
    }
    text
}

impl Definition {
    /// The definition alone as text: as [`Schema::to_text`](crate::Schema::to_text) without the types it consists of.
    pub fn to_text(&self) -> String {
        let mut text = String::new();
        // Writing to a `String` cannot fail.
        for constant in &self.constants {
            let _ = writeln!(text, "{} {}={}", constant.ty, constant.name, constant.value);
        }
        if self.is_empty() {
            return text;
        }
        for field in &self.fields {
            let _ = write!(text, "{} {}", field.ty, field.name);
            if let Some(default) = &field.default {
                let _ = write!(text, " {default}");
            }
            text.push('\n');
        }
        text
    }
}

fn is_separator(line: &str) -> bool {
    let line = line.trim_end();
    line.len() >= 3 && line.bytes().all(|byte| byte == b'=')
}

/// The type that a section defines, and the lines after its name.
fn header<'a, 'b>(
    section: &'a [Numbered<'b>],
    file: &Arc<str>,
) -> Result<(TypeName, &'a [Numbered<'b>]), SchemaError> {
    let (&(number, line), body) = section.split_first().unwrap_or((&(1, ""), &[]));
    let name = line.strip_prefix("MSG:").and_then(|name| name.trim().parse().ok());
    let error = || {
        let place = Place { file: file.clone(), line: number, column: 1 };
        SchemaError::Definition { place, fault: Fault::Section { line: shortened(line) } }
    };
    Ok((name.ok_or_else(error)?, body))
}

/// As constants and defaults are written; a message, which can be neither, as its fields in braces.
impl fmt::Display for Value {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Bool(value) => write!(formatter, "{value}"),
            Self::F32(value) => formatter.write_str(&python_float(*value)),
            Self::F64(value) => formatter.write_str(&python_float(*value)),
            Self::String(text) => formatter.write_str(&quoted(text)),
            Self::Struct(fields) => {
                formatter.write_str("{")?;
                joined(formatter, fields.iter())?;
                formatter.write_str("}")
            }
            Self::List(list) => {
                formatter.write_str("[")?;
                joined(formatter, (0..list.len()).filter_map(|index| list.get(index)))?;
                formatter.write_str("]")
            }
            integer => write!(formatter, "{}", integer.as_integer().unwrap_or(0)),
        }
    }
}

fn joined<T: fmt::Display>(
    formatter: &mut fmt::Formatter<'_>,
    items: impl Iterator<Item = T>,
) -> fmt::Result {
    for (index, item) in items.enumerate() {
        write!(formatter, "{}{item}", if index > 0 { ", " } else { "" })?;
    }
    Ok(())
}

/// Quotes a text, so that no `#` and no line end is left: these would end the value.
fn quoted(text: &str) -> String {
    let mut result = String::from('"');
    for character in text.chars() {
        match character {
            '"' | '\\' => result.extend(['\\', character]),
            '\n' => result.push_str("\\n"),
            '\r' => result.push_str("\\r"),
            '\t' => result.push_str("\\t"),
            '#' => result.push_str("\\x23"),
            _ => result.push(character),
        }
    }
    result.push('"');
    result
}
