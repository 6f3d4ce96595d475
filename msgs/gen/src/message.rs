// SPDX-License-Identifier: MIT OR Apache-2.0
//! The struct of one message, and what reads and writes it in place.

use std::collections::BTreeSet;

use tautline_schema::{Base, Definition, Field, Schema, SchemaError, Shape, TypeName, Value};

use crate::in_place::Types;
use crate::memory::Memory;
use crate::names::Taken;
use crate::text::Text;
use crate::types::{constant, default_of, form, has_default, is_zero, literal, owned, rust, serde};
use crate::units::unit;
use crate::{Options, names};

/// Writes the struct `name`, in the module `module`, with all that is implemented for it.
pub fn write(
    text: &mut Text,
    schema: &Schema,
    name: &str,
    module: &str,
    (options, taken): (&Options, &Taken),
) -> Result<(), SchemaError> {
    let definition = schema.definition();
    let memory = Memory::of(schema);
    let fields = if definition.is_empty() { &[] } else { &definition.fields[..] };
    let derives_default = fields.iter().all(|field| match &field.default {
        Some(default) => is_zero(default),
        None => has_default(&field.ty),
    });

    text.gap();
    docs(text, definition, fields);
    let serde_path = format!("{}::serde", options.msgs);
    text.line("#[derive(");
    for derived in ["Clone", "Copy", "Debug", "Default", "PartialEq"] {
        if (derives_default || derived != "Default") && (memory.is_plain() || derived != "Copy") {
            text.line(&format!("{derived},"));
        }
    }
    text.line(&format!("{serde_path}::Serialize,"));
    text.line(&format!("{serde_path}::Deserialize,"));
    text.line(")]");
    text.line(&format!("#[serde(crate = \"{serde_path}\", default)]"));
    if memory.is_plain() {
        text.line("#[repr(C)]");
    }
    if fields.is_empty() {
        text.line(&format!("pub struct {name} {{}}"));
    } else {
        text.line(&format!("pub struct {name} {{"));
        for field in fields {
            write_field(text, definition, field, module, options);
        }
        text.line("}");
    }
    constants(text, definition, name);
    if !derives_default {
        write_default(text, fields, name);
    }
    let types = Types { schema, module, options, taken };
    forms(text, definition, fields, name, &types, memory);
    if memory == Memory::Dense {
        text.line(&format!("{}::dense_struct! {{ {name} }}", options.msgs));
    } else {
        in_place(text, definition, fields, name, &types)?;
    }
    text.line(&format!("{}::message! {{", options.msgs));
    let view =
        if memory.is_plain() { "plain".to_owned() } else { taken.avoid(&definition.name, name, "Ref") };
    text.line(&format!("{view} {name} \"{}\" {{", definition.name));
    text.line(&format!("\"{}\",", schema.hash()));
    text.line(&format!("{:?},", definition.to_text()));
    let nested: BTreeSet<_> = fields
        .iter()
        .filter_map(|field| match &field.ty.base {
            Base::Nested(name) => Some(names::relative(name, module, options)),
            _ => None,
        })
        .collect();
    text.line(&format!("[{}],", nested.into_iter().collect::<Vec<_>>().join(", ")));
    text.line("}");
    text.line("}");
    if fields.iter().any(is_header) {
        text.line(&format!("{}::stamped! {{ {name} }}", options.msgs));
    }
    Ok(())
}

/// Whether a field says when the message's content was measured, by ROS's convention.
fn is_header(field: &Field) -> bool {
    let is_type = |name: &TypeName| (name.package(), name.name()) == ("std_msgs", "Header");
    let is_nested = matches!(&field.ty.base, Base::Nested(name) if is_type(name));
    field.name == "header" && field.ty.shape == Shape::Single && is_nested
}

/// Writes the conversion to and from CDR.
fn forms(
    text: &mut Text,
    definition: &Definition,
    fields: &[Field],
    name: &str,
    types: &Types<'_>,
    memory: Memory,
) {
    let Types { module, options, .. } = types;
    let macro_name = if memory.is_plain() { "plain_struct" } else { "cdr_form" };
    text.gap();
    text.line(&format!("{}::{macro_name}! {{", options.msgs));
    text.line(&format!("\"{}\";", definition.name));
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

/// Writes the view, the writer and the sizes of a message.
fn in_place(
    text: &mut Text,
    definition: &Definition,
    fields: &[Field],
    name: &str,
    types: &Types<'_>,
) -> Result<(), SchemaError> {
    let Types { module, options, taken, .. } = types;
    let sizes = types.sizes(name)?;
    text.line(&format!("{}::in_place! {{", options.msgs));
    text.line(&format!("\"{}\";", definition.name));
    let [view, writer] = ["Ref", "Writer"].map(|suffix| taken.avoid(&definition.name, name, suffix));
    text.line(&format!("{name} {view} {writer} {};", sizes.ty));
    text.line("{");
    for field in fields {
        field_docs(text, definition, field);
        let field_name = names::field(&field.name);
        let sized = sizes.fields.iter().any(|(sized, _)| *sized == field.name);
        let sized = if sized { &field_name[..] } else { "" };
        let (form, view) = (form(&field.ty, module, options), types.view(&field.ty)?);
        text.line(&format!("{field_name}: {form} as {view} [{sized}],"));
    }
    text.line("}");
    text.line("}");
    if sizes.fields.is_empty() {
        return Ok(());
    }
    text.gap();
    text.doc(&format!(
        "The lengths of an [`{name}`], stated before it is written in place: of strings in bytes of"
    ));
    text.doc("UTF-8 (`wstring`: units of UTF-16), of sequences in elements.");
    text.line("#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]");
    text.line(&format!("pub struct {} {{", sizes.ty));
    for (field, ty) in &sizes.fields {
        text.doc(&format!("Of `{field}`."));
        let field = format!("pub {}:", names::field(field));
        // rustfmt breaks these two columns earlier.
        match text.fits(&format!("{field} {ty},  ")) {
            true => text.pair(&field, &format!("{ty},")),
            false => text.broken(&field, &format!("{ty},")),
        }
    }
    text.line("}");
    text.gap();
    Ok(())
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

fn write_field(text: &mut Text, definition: &Definition, field: &Field, module: &str, options: &Options) {
    let name = names::field(&field.name);
    field_docs(text, definition, field);
    let renamed = (name != field.name).then(|| format!("rename = \"{}\"", field.name));
    let attributes: Vec<_> = renamed.into_iter().chain(serde(&field.ty, options)).collect();
    if !attributes.is_empty() {
        text.line(&format!("#[serde({})]", attributes.join(", ")));
    }
    text.pair(&format!("pub {name}:"), &format!("{},", rust(&field.ty, module, options)));
}

fn field_docs(text: &mut Text, definition: &Definition, field: &Field) {
    let unit =
        unit(definition.name.as_str(), &field.name).map_or(String::new(), |unit| format!(", in {unit}"));
    text.doc(&format!("`{}`{unit}", field.ty));
    text.comment(&field.docs);
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
