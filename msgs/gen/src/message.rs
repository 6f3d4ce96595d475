// SPDX-License-Identifier: MIT OR Apache-2.0
//! The struct of one message.

use tautline_schema::{Definition, Field, Schema, Shape, Value};

use crate::text::Text;
use crate::types::{constant, default_of, form, has_default, is_zero, literal, owned, rust, serde};
use crate::{Options, names};

/// Writes the struct `name`, in the module `module`, with all that is implemented for it.
pub fn write(text: &mut Text, schema: &Schema, name: &str, module: &str, options: &Options) {
    let definition = schema.definition();
    let fields = if definition.is_empty() { &[] } else { &definition.fields[..] };
    let derives_default = fields.iter().all(|field| match &field.default {
        Some(default) => is_zero(default),
        None => has_default(&field.ty),
    });

    text.gap();
    docs(text, definition, fields);
    let serde_path = format!("{}::serde", options.msgs);
    text.line("#[derive(");
    for derived in ["Clone", "Debug", "Default", "PartialEq"] {
        if derives_default || derived != "Default" {
            text.line(&format!("{derived},"));
        }
    }
    text.line(&format!("{serde_path}::Serialize,"));
    text.line(&format!("{serde_path}::Deserialize,"));
    text.line(")]");
    text.line(&format!("#[serde(crate = \"{serde_path}\", default)]"));
    if fields.is_empty() {
        text.line(&format!("pub struct {name} {{}}"));
    } else {
        text.line(&format!("pub struct {name} {{"));
        for field in fields {
            write_field(text, field, module, options);
        }
        text.line("}");
    }
    constants(text, definition, name);
    if !derives_default {
        write_default(text, fields, name);
    }
    text.gap();
    text.line(&format!("{}::cdr_struct! {{", options.msgs));
    text.line(&format!("\"{}\", \"{}\";", definition.name, schema.hash()));
    if fields.is_empty() {
        text.line(&format!("{name} {{}}"));
    } else {
        text.line(&format!("{name} {{"));
        for field in fields {
            text.line(&format!("{}: {},", names::field(&field.name), form(&field.ty, module, options)));
        }
        text.line("}");
    }
    text.line("}");
}

/// The definition, normalised.
fn docs(text: &mut Text, definition: &Definition, fields: &[Field]) {
    text.doc(&format!("`{}`", definition.name));
    if fields.is_empty() && definition.constants.is_empty() {
        return;
    }
    text.doc("");
    text.doc("```text");
    for constant in &definition.constants {
        text.doc(&format!("{} {}={}", constant.ty, constant.name, literal(&constant.value)));
    }
    for field in fields {
        let default =
            field.default.as_ref().map(|default| format!(" {}", literal(default))).unwrap_or_default();
        text.doc(&format!("{} {}{default}", field.ty, field.name));
    }
    text.doc("```");
}

fn write_field(text: &mut Text, field: &Field, module: &str, options: &Options) {
    let name = names::field(&field.name);
    text.doc(&format!("`{}`", field.ty));
    let renamed =
        (name.trim_start_matches("r#") != field.name).then(|| format!("rename = \"{}\"", field.name));
    let attributes: Vec<_> = renamed.into_iter().chain(serde(&field.ty, options)).collect();
    if !attributes.is_empty() {
        text.line(&format!("#[serde({})]", attributes.join(", ")));
    }
    text.pair(&format!("pub {name}:"), &format!("{},", rust(&field.ty, module, options)));
}

fn constants(text: &mut Text, definition: &Definition, name: &str) {
    if definition.constants.is_empty() {
        return;
    }
    text.gap();
    text.line(&format!("impl {name} {{"));
    for item in &definition.constants {
        text.doc(&format!("`{}`", item.ty));
        let (ty, value) = (constant(&item.ty), literal(&item.value));
        text.pair(&format!("pub const {}: {ty} =", item.name), &format!("{value};"));
    }
    text.line("}");
}

fn write_default(text: &mut Text, fields: &[Field], name: &str) {
    text.gap();
    text.line(&format!("impl ::core::default::Default for {name} {{"));
    text.line("fn default() -> Self {");
    text.line("Self {");
    for field in fields {
        let value = match &field.default {
            Some(default) => owned(default, field.ty.shape),
            None => default_of(&field.ty),
        };
        let line = format!("{}: {value},", names::field(&field.name));
        match &field.default {
            Some(Value::List(list)) if !text.fits(&line) => {
                let (open, close) =
                    if value.ends_with(')') { ("::std::vec::Vec::from([", "]),") } else { ("[", "],") };
                text.line(&format!("{}: {open}", names::field(&field.name)));
                for item in (0..list.len()).filter_map(|index| list.get(index)) {
                    text.line(&format!("{},", owned(&item, Shape::Single)));
                }
                text.line(close);
            }
            _ => text.line(&line),
        }
    }
    text.line("}");
    text.line("}");
    text.line("}");
}
