// SPDX-License-Identifier: MIT OR Apache-2.0
//! Messages as YAML, as `ros2 topic echo` prints them.

use std::fmt::{self, Write};

use crate::number::python_float;
use crate::{DynamicMessage, FieldType, List, MessageError, Schema, Shape, Value};

/// YAML in block style, a line per value: what `ros2 topic echo --full-length` prints between two `---`, except that
/// `byte` is a number and `float32` has no more digits than it needs. `DynamicMessage::from_yaml` reads it.
impl fmt::Display for DynamicMessage {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let form = EchoForm { most: usize::MAX, ..EchoForm::default() };
        Printer { out: formatter, schema: &self.schema, form }.fields(0, &self.fields, 0, false)
    }
}

/// How much of a message is printed.
#[derive(Clone, Copy, Debug)]
pub struct EchoForm {
    /// Elements of a list, and characters of a text, at most.
    pub most: usize,
    /// Of lists, only type and length are printed, as with `--no-arr`.
    pub no_lists: bool,
    /// Of texts, only the length is printed, as with `--no-str`.
    pub no_texts: bool,
}

/// As `ros2 topic echo`: 128 elements or characters.
impl Default for EchoForm {
    fn default() -> Self {
        EchoForm { most: 128, no_lists: false, no_texts: false }
    }
}

impl DynamicMessage {
    /// As [`Display`](fmt::Display), with long parts truncated or left out.
    pub fn echo(&self, form: EchoForm) -> String {
        let mut text = String::new();
        // Writing to a `String` cannot fail.
        let _ = Printer { out: &mut text, schema: &self.schema, form }.fields(0, &self.fields, 0, false);
        text
    }

    /// The same for the value at a path, as `ros2 topic echo --field` prints it.
    ///
    /// # Errors
    /// As [`get`](Self::get).
    pub fn echo_field(&self, path: &str, form: EchoForm) -> Result<String, MessageError> {
        let (value, nested) = self.find(path)?;
        let mut text = String::new();
        let mut printer = Printer { out: &mut text, schema: &self.schema, form };
        // Writing to a `String` cannot fail.
        let _ = match &*value {
            Value::Struct(values) => printer.fields(nested, values, 0, false),
            Value::List(list) if list.is_empty() => printer.out.write_str("[]\n"),
            Value::List(list) => printer.list(nested, list, 0),
            value => printer.scalar(value, 0).and_then(|()| printer.out.write_char('\n')),
        };
        Ok(text)
    }
}

struct Printer<'a, W> {
    out: &'a mut W,
    schema: &'a Schema,
    form: EchoForm,
}

impl<W: Write> Printer<'_, W> {
    /// The fields of type `node`, a line each; if `continues`, the first one continues the current line.
    fn fields(&mut self, node: usize, values: &[Value], indent: usize, mut continues: bool) -> fmt::Result {
        let schema = self.schema;
        let node = schema.node(node);
        if node.definition.is_empty() {
            return self.out.write_str("{}\n");
        }
        for ((field, nested), value) in node.definition.fields.iter().zip(&node.nested).zip(values) {
            let margin = if std::mem::take(&mut continues) { 0 } else { indent };
            write!(self.out, "{:margin$}{}:", "", field.name)?;
            match value {
                Value::List(list) if self.form.no_lists => {
                    writeln!(self.out, " {}", single_quoted(&summary(&field.ty, list.len()), 0))?;
                }
                value => self.value(nested.unwrap_or(0), value, indent)?,
            }
        }
        Ok(())
    }

    /// What follows `name:`.
    fn value(&mut self, nested: usize, value: &Value, indent: usize) -> fmt::Result {
        match value {
            Value::Struct(_) if self.schema.node(nested).definition.is_empty() => self.out.write_str(" {}\n"),
            Value::Struct(values) => {
                self.out.write_char('\n')?;
                self.fields(nested, values, indent + 2, false)
            }
            Value::List(list) if list.is_empty() => self.out.write_str(" []\n"),
            Value::List(list) => {
                self.out.write_char('\n')?;
                self.list(nested, list, indent)
            }
            value => {
                self.out.write_char(' ')?;
                self.scalar(value, indent + 2)?;
                self.out.write_char('\n')
            }
        }
    }

    fn list(&mut self, nested: usize, list: &List, indent: usize) -> fmt::Result {
        for index in 0..list.len().min(self.form.most) {
            write!(self.out, "{:indent$}- ", "")?;
            if let List::Struct(items) = list {
                self.fields(nested, &items[index], indent + 2, true)?;
            } else {
                self.scalar(&list.get(index).unwrap_or(Value::U8(0)), indent + 2)?;
                self.out.write_char('\n')?;
            }
        }
        if list.len() > self.form.most { writeln!(self.out, "{:indent$}- '...'", "") } else { Ok(()) }
    }

    /// A value in its line; a text with line ends goes on at `indent`.
    fn scalar(&mut self, value: &Value, indent: usize) -> fmt::Result {
        match value {
            Value::Bool(value) => write!(self.out, "{value}"),
            Value::F32(value) => self.out.write_str(&yaml_float(python_float(*value))),
            Value::F64(value) => self.out.write_str(&yaml_float(python_float(*value))),
            Value::String(text) if self.form.no_texts => {
                let summary = format!("<string length: <{}>>", text.chars().count());
                self.out.write_str(&single_quoted(&summary, 0))
            }
            Value::String(text) => match text.char_indices().nth(self.form.most) {
                Some((end, _)) => self.out.write_str(&yaml_text(&format!("{}...", &text[..end]), indent)),
                None => self.out.write_str(&yaml_text(text, indent)),
            },
            integer => write!(self.out, "{}", integer.as_integer().unwrap_or(0)),
        }
    }
}

/// A list of `len` elements, as ROS 2's tools print it.
fn summary(ty: &FieldType, len: usize) -> String {
    let base = &ty.base;
    match ty.shape {
        Shape::Array(size) => format!("<array type: {base}[{size}]>"),
        Shape::Bounded(most) => format!("<sequence type: {base}[{most}], length: {len}>"),
        _ => format!("<sequence type: {base}, length: {len}>"),
    }
}

/// Converts a float from Python's format to YAML's: `.nan`, `.inf`, and a point before the exponent.
fn yaml_float(text: String) -> String {
    match text.as_str() {
        "nan" => ".nan".to_owned(),
        "inf" => ".inf".to_owned(),
        "-inf" => "-.inf".to_owned(),
        _ if text.contains('e') && !text.contains('.') => text.replacen('e', ".0e", 1),
        _ => text,
    }
}

/// A text without quotes if that is possible, else in single, else in double quotes.
fn yaml_text(text: &str, indent: usize) -> String {
    let special =
        |character: char| character != '\n' && (character.is_control() || BREAKS.contains(character));
    if text.contains(special) || text.contains(" \n") || text.contains("\n ") {
        double_quoted(text)
    } else if text.contains('\n') || !is_plain(text) {
        single_quoted(text, indent)
    } else {
        text.to_owned()
    }
}

/// Characters that YAML may take for the end of a line, or leave out.
const BREAKS: &str = "\u{2028}\u{2029}\u{feff}";

/// A text in single quotes, in which n + 1 line ends stand for n.
fn single_quoted(text: &str, indent: usize) -> String {
    let mut quoted = String::from("'");
    let mut previous = ' ';
    for character in text.chars() {
        match (previous, character) {
            ('\n', '\n') => quoted.push('\n'),
            (_, '\n') => quoted.push_str("\n\n"),
            ('\n', _) => quoted.extend(std::iter::repeat_n(' ', indent)),
            _ => {}
        }
        match character {
            '\n' => {}
            '\'' => quoted.push_str("''"),
            _ => quoted.push(character),
        }
        previous = character;
    }
    if previous == '\n' {
        quoted.extend(std::iter::repeat_n(' ', indent));
    }
    quoted + "'"
}

fn double_quoted(text: &str) -> String {
    let mut quoted = String::from('"');
    for character in text.chars() {
        // Writing to a `String` cannot fail.
        let _ = match character {
            '"' | '\\' => write!(quoted, "\\{character}"),
            '\n' => quoted.write_str("\\n"),
            '\r' => quoted.write_str("\\r"),
            '\t' => quoted.write_str("\\t"),
            '\0' => quoted.write_str("\\0"),
            _ if BREAKS.contains(character) => write!(quoted, "\\u{:04X}", u32::from(character)),
            _ if character.is_control() => write!(quoted, "\\x{:02X}", u32::from(character)),
            '\u{10000}'.. => write!(quoted, "\\U{:08X}", u32::from(character)),
            _ => quoted.write_char(character),
        };
    }
    quoted + "\""
}

/// Whether YAML reads these characters, without quotes, as this text.
fn is_plain(text: &str) -> bool {
    let mut characters = text.chars();
    let Some(first) = characters.next() else { return false };
    let second = characters.next();
    let marker = match first {
        '-' | '?' | ':' => second.is_none_or(|second| second == ' '),
        first => ",[]{}#&*!|>'\"%@`".contains(first),
    };
    let word = ["=", "yes", "no", "on", "off", "true", "false", "null", "~", "<<"];
    let number = "0123456789+-.".contains(first)
        && text
            .chars()
            .all(|character| character.is_ascii_hexdigit() || "xXoO_:.+-iInNfatTZ ".contains(character));
    !marker
        && !number
        && !text.starts_with(' ')
        && !text.ends_with(' ')
        && !text.ends_with(':')
        && !text.contains(": ")
        && !text.contains(" #")
        && !text.starts_with("---")
        && !text.starts_with("...")
        && !word.contains(&text.to_ascii_lowercase().as_str())
}
