// SPDX-License-Identifier: MIT OR Apache-2.0
//! The structure of plain types. The definition of a type that is only written in Rust is made from it.

use crate::Message;
use core::fmt::Write;
use std::collections::BTreeMap;

/// The structure of a plain type, in the terms of a definition.
#[doc(hidden)]
#[derive(Debug)]
pub enum Shape {
    /// A primitive, by its name in definitions.
    Primitive(&'static str),
    /// This number of elements of one shape.
    Array(&'static Shape, usize),
    /// A derived or generated struct.
    Struct(&'static StructShape),
}

/// A struct and its fields.
#[doc(hidden)]
#[derive(Debug)]
pub struct StructShape {
    /// Its name in Rust.
    pub ident: &'static str,
    /// Its name in ROS, if it has one.
    pub type_name: Option<&'static str>,
    /// The fields, with their names in Rust.
    pub fields: &'static [(&'static str, &'static Shape)],
}

/// The definition of `T` in the form of bags, with those of the types it consists of: see
/// [`Definition::to_text`](crate::Definition::to_text). The definition of a derived type is made from its fields: a struct without a ROS
/// name gets its Rust name in the same package, an enum becomes its integer, an array of arrays becomes one array.
///
/// `None` if no definition is possible: two different structs would have the same name.
///
/// # Real-time
/// Setup only: allocates.
pub fn definition_text<T: Message>() -> Option<String> {
    match (T::DEFINITION, T::SHAPE) {
        (Some(definition), _) => Some(definition.to_text()),
        (None, Some(Shape::Struct(shape))) => Text::of(T::TYPE_NAME, shape),
        _ => None,
    }
}

/// A text that is being made.
struct Text<'n> {
    package: &'n str,
    /// The definitions of the types of fields, by their names.
    needed: BTreeMap<String, String>,
}

impl<'n> Text<'n> {
    fn of(type_name: &'n str, shape: &StructShape) -> Option<String> {
        let package = type_name.split('/').next().unwrap_or_default();
        let mut this = Text { package, needed: BTreeMap::new() };
        let mut text = this.lines(shape)?;
        this.needed.remove(type_name);
        for (name, lines) in &this.needed {
            // Writing to a `String` cannot fail.
            let _ = write!(text, "{}\nMSG: {}\n{lines}", "=".repeat(80), name.replacen("/msg/", "/", 1));
        }
        Some(text)
    }

    fn lines(&mut self, shape: &StructShape) -> Option<String> {
        let mut lines = String::new();
        for (name, field) in shape.fields {
            let (base, len) = self.base(field)?;
            let len = if len == 0 { String::new() } else { format!("[{len}]") };
            let _ = writeln!(lines, "{base}{len} {}", name.trim_start_matches("r#"));
        }
        Some(lines)
    }

    /// The name of a field's type, and its number of elements; 0 if it is no array.
    fn base(&mut self, shape: &Shape) -> Option<(String, usize)> {
        match shape {
            Shape::Primitive(name) => Some(((*name).to_owned(), 0)),
            Shape::Array(element, len) => {
                let (base, inner) = self.base(element)?;
                Some((base, len * inner.max(1)))
            }
            Shape::Struct(shape) => {
                let own = format!("{}/msg/{}", self.package, shape.ident);
                let name = shape.type_name.map_or(own, str::to_owned);
                let lines = self.lines(shape)?;
                let base = name.replacen("/msg/", "/", 1);
                let is_same = self.needed.get(&name).is_none_or(|known| *known == lines);
                self.needed.insert(name, lines);
                is_same.then_some((base, 0))
            }
        }
    }
}
