// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut msg show`: the fields of a type and their offsets.

use crate::find::Finder;
use crate::verb::Outcome;
use serde::Serialize;
use std::fmt::Write;
use tautline_schema::{Definition, Kind, Layout, Plain, Schema, Size};

/// The output for a type.
#[derive(Serialize)]
pub struct Report {
    #[serde(rename = "type")]
    name: String,
    hash: String,
    file: String,
    #[serde(skip_serializing_if = "String::is_empty")]
    docs: String,
    /// A service's request and response, an action's goal, result and feedback, or the type itself.
    messages: Vec<Message>,
    /// The nested types.
    referenced: Vec<String>,
}

#[derive(Serialize)]
struct Message {
    #[serde(rename = "type")]
    name: String,
    constants: Vec<Constant>,
    fields: Vec<Field>,
    size: Size,
    /// The C struct with the layout of its bytes, if there is one.
    plain: Option<Struct>,
    #[serde(skip_serializing_if = "Option::is_none")]
    not_plain: Option<String>,
}

#[derive(Serialize)]
struct Constant {
    #[serde(rename = "type")]
    ty: String,
    name: String,
    value: String,
}

#[derive(Serialize)]
struct Field {
    #[serde(rename = "type")]
    ty: String,
    name: String,
    offset: Size,
    size: Size,
    #[serde(skip_serializing_if = "String::is_empty")]
    default: String,
    #[serde(skip_serializing_if = "String::is_empty")]
    docs: String,
}

#[derive(Serialize)]
struct Struct {
    size: usize,
    align: usize,
}

impl Report {
    /// Looks a type up.
    pub fn of(finder: &mut Finder, name: &str) -> Outcome<Self> {
        let schema = finder.schema(name)?;
        let mut messages = Vec::new();
        for part in parts(&schema) {
            let name = schema.name();
            let part =
                format!("{}/{}/{}{part}", name.package(), name.kind().as_str(), name.name()).parse()?;
            messages.push(Message::of(&schema.of_part(&part)?));
        }
        if messages.is_empty() {
            messages.push(Message::of(&schema));
        }
        let Definition { name, docs, file, .. } = schema.definition();
        Ok(Self {
            name: name.to_string(),
            hash: schema.hash().to_string(),
            file: file.to_string(),
            docs: docs.clone(),
            messages,
            referenced: schema.referenced().map(|definition| definition.name.to_string()).collect(),
        })
    }

    pub fn json(&self) -> String {
        // Strings and numbers can always be serialised.
        serde_json::to_string_pretty(self).unwrap_or_default() + "\n"
    }

    pub fn text(&self) -> String {
        let mut text = format!("{}\n{}\n{}\n", self.name, self.hash, self.file);
        for message in &self.messages {
            text.push('\n');
            if self.messages.len() > 1 {
                // Writing to a `String` cannot fail.
                let _ = writeln!(text, "{}", message.name);
            }
            message.print(&mut text);
        }
        text
    }
}

/// The suffixes of the messages that users of a service or action fill in; empty for a message.
pub fn parts(schema: &Schema) -> &'static [&'static str] {
    let first = schema.definition().fields.first().map(|field| field.name.as_str());
    match (schema.name().kind(), first) {
        (Kind::Srv | Kind::Action, Some("request_message")) => &["_Request", "_Response"],
        (Kind::Action, Some("goal")) if schema.definition().fields.len() == 6 => {
            &["_Goal", "_Result", "_Feedback"]
        }
        _ => &[],
    }
}

impl Message {
    fn of(schema: &Schema) -> Self {
        let Layout { plain, size, fields } = Layout::of(schema);
        let definition = schema.definition();
        let fields = fields.into_iter().zip(&definition.fields).map(|(layout, field)| Field {
            ty: layout.ty.to_string(),
            name: layout.name,
            offset: layout.offset,
            size: layout.size,
            default: field.default.as_ref().map_or_else(String::new, ToString::to_string),
            docs: field.docs.clone(),
        });
        let constants = definition.constants.iter().map(|constant| Constant {
            ty: constant.ty.to_string(),
            name: constant.name.clone(),
            value: constant.value.to_string(),
        });
        Self {
            name: definition.name.to_string(),
            constants: constants.collect(),
            fields: fields.collect(),
            size,
            not_plain: plain.as_ref().err().map(ToString::to_string),
            plain: plain.ok().map(|Plain { size, align, .. }| Struct { size, align }),
        }
    }

    fn print(&self, text: &mut String) {
        let header = ["type", "field", "offset", "size"].map(str::to_owned);
        let rows = self.fields.iter().map(|field| {
            let default =
                if field.default.is_empty() { String::new() } else { format!(" {}", field.default) };
            let (offset, size) = (field.offset.to_string(), field.size.to_string());
            [field.ty.clone(), format!("{}{default}", field.name), offset, size]
        });
        let rows: Vec<_> = std::iter::once(header).chain(rows).collect();
        // A formula may be long, but what comes after it is short.
        let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
        let widths = [width(0), width(1), width(2)];
        // Writing to a `String` cannot fail.
        for [ty, name, offset, size] in &rows {
            let [a, b, c] = widths;
            let _ = writeln!(text, "  {ty:a$}  {name:b$}  {offset:c$}  {size}");
        }
        for constant in &self.constants {
            let _ = writeln!(text, "  {} {}={}", constant.ty, constant.name, constant.value);
        }
        let plain = match (&self.plain, &self.not_plain) {
            (Some(Struct { size, align }), _) => {
                format!("plain: a C struct of {size} bytes aligned to {align}, read and written in place")
            }
            (None, reason) => format!("not plain: {}", reason.as_deref().unwrap_or_default()),
        };
        let _ = writeln!(text, "  {} bytes; {plain}", self.size);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(file: &str, definition: &str) -> Report {
        let folder =
            std::env::temp_dir().join(format!("taut_msg_{}_{}", std::process::id(), file.replace('/', "_")));
        let path = folder.join("demo_msgs").join(file);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, definition).unwrap();
        let report = Report::of(&mut Finder::new(&[]), path.to_str().unwrap());
        std::fs::remove_dir_all(&folder).unwrap();
        report.unwrap()
    }

    #[test]
    fn a_plain_message_has_offsets() {
        let text = report("msg/Tick.msg", "uint64 stamp\nuint8 count 3\nuint8 LOST=255\n").text();
        let lines: Vec<_> = text.lines().skip(4).collect();
        assert_eq!(
            lines,
            [
                "  type    field    offset  size",
                "  uint64  stamp    0       8",
                "  uint8   count 3  8       1",
                "  uint8 LOST=255",
                "  9 bytes; plain: a C struct of 16 bytes aligned to 8, read and written in place",
            ]
        );
    }

    #[test]
    fn a_service_has_two_messages() {
        let json: serde_json::Value =
            serde_json::from_str(&report("srv/Get.srv", "---\nstring text\n").json()).unwrap();
        assert_eq!(json["type"], "demo_msgs/srv/Get");
        assert_eq!(json["messages"][0]["plain"]["size"], 1);
        assert_eq!(json["messages"][1]["size"], "|text| + 5");
        assert_eq!(json["messages"][1]["not_plain"], "`text` has no fixed size");
    }
}
