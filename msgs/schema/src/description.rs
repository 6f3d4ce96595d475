// SPDX-License-Identifier: MIT OR Apache-2.0
//! Type descriptions: `type_description_interfaces/msg/TypeDescription` and the JSON files of ROS packages.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::parse::parse_python_default;
use crate::{
    Base, Definition, Field, FieldType, Place, Primitive, SchemaError, Shape, TypeHash, TypeName, names,
};

/// A type and all types it consists of, as ROS 2 nodes send it to each other.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TypeDescription {
    /// The type.
    pub type_description: IndividualTypeDescription,
    /// The types it consists of, in the order of their names.
    pub referenced_type_descriptions: Vec<IndividualTypeDescription>,
}

/// One type.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct IndividualTypeDescription {
    /// Its full name.
    pub type_name: String,
    /// Its fields.
    pub fields: Vec<FieldDescription>,
}

/// A field.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FieldDescription {
    /// Its name.
    pub name: String,
    /// Its type.
    #[serde(rename = "type")]
    pub ty: FieldTypeDescription,
    /// Its default as Python prints it, empty if there is none. No part of the hash.
    #[serde(default)]
    pub default_value: String,
}

/// The type of a field.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FieldTypeDescription {
    /// One of the constants of `type_description_interfaces/msg/FieldType`: the type of an element, plus 48 for an
    /// array, 96 for a bounded and 144 for an unbounded sequence.
    pub type_id: u8,
    /// The length of an array or bound of a sequence, else 0.
    pub capacity: u64,
    /// The bound of a string, else 0.
    pub string_capacity: u64,
    /// The message that an element is, else empty.
    pub nested_type_name: String,
}

/// The file `share/<package>/<kind>/<Name>.json` of a ROS package.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HashedTypeDescription {
    /// The type.
    pub type_description_msg: TypeDescription,
    /// The hashes of the type and of those it consists of.
    pub type_hashes: Vec<NamedHash>,
}

/// The hash of a type.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NamedHash {
    /// The type's full name.
    pub type_name: String,
    /// `RIHS01_` and 64 hexadecimal digits.
    pub hash_string: String,
}

impl TypeDescription {
    /// The hash of the type: SHA-256 of the description as JSON without defaults, spaced as Python does.
    pub fn hash(&self) -> TypeHash {
        let mut text = String::from("{\"type_description\": ");
        individual(&mut text, &self.type_description);
        text.push_str(", \"referenced_type_descriptions\": [");
        for (index, referenced) in self.referenced_type_descriptions.iter().enumerate() {
            text.push_str(if index > 0 { ", " } else { "" });
            individual(&mut text, referenced);
        }
        text.push_str("]}");
        TypeHash::of(&text)
    }

    /// The type and all definitions.
    pub(crate) fn definitions(&self) -> Result<(TypeName, BTreeMap<TypeName, Arc<Definition>>), SchemaError> {
        let mut definitions = BTreeMap::new();
        let root = self.type_description.definition()?;
        let name = root.name.clone();
        definitions.insert(name.clone(), Arc::new(root));
        for referenced in &self.referenced_type_descriptions {
            let definition = referenced.definition()?;
            if definitions.insert(definition.name.clone(), Arc::new(definition)).is_some() {
                return Err(SchemaError::Conflict { name: referenced.type_name.clone() });
            }
        }
        Ok((name, definitions))
    }
}

impl HashedTypeDescription {
    /// The text of the file, byte for byte as ROS writes it.
    pub fn to_json(&self) -> String {
        // Strings and numbers can always be serialised.
        ascii(&serde_json::to_string_pretty(self).unwrap_or_default())
    }
}

impl From<&Definition> for IndividualTypeDescription {
    fn from(definition: &Definition) -> Self {
        let fields = definition.fields.iter().map(|field| FieldDescription {
            name: field.name.clone(),
            ty: FieldTypeDescription::from(&field.ty),
            default_value: field.default_text.clone(),
        });
        Self { type_name: definition.name.to_string(), fields: fields.collect() }
    }
}

impl From<&FieldType> for FieldTypeDescription {
    fn from(ty: &FieldType) -> Self {
        let (base, string_capacity, nested) = match &ty.base {
            Base::Nested(name) => (NESTED, None, name.as_str()),
            Base::String { bound } => (if bound.is_some() { BOUNDED_STRING } else { STRING }, *bound, ""),
            Base::WString { bound } => (if bound.is_some() { BOUNDED_WSTRING } else { WSTRING }, *bound, ""),
            Base::Primitive(primitive) => (primitive_id(*primitive), None, ""),
        };
        let (offset, capacity) = match ty.shape {
            Shape::Single => (0, 0),
            Shape::Array(len) => (ARRAY, len),
            Shape::Bounded(bound) => (BOUNDED, bound),
            Shape::Unbounded => (UNBOUNDED, 0),
        };
        Self {
            type_id: base + offset,
            capacity: capacity.into(),
            string_capacity: string_capacity.unwrap_or(0).into(),
            nested_type_name: nested.to_owned(),
        }
    }
}

const NESTED: u8 = 1;
const STRING: u8 = 17;
const WSTRING: u8 = 18;
const BOUNDED_STRING: u8 = 21;
const BOUNDED_WSTRING: u8 = 22;
const ARRAY: u8 = 48;
const BOUNDED: u8 = 96;
const UNBOUNDED: u8 = 144;

/// The `char` of definitions is a `uint8`; that of IDL files is not.
fn primitive_id(primitive: Primitive) -> u8 {
    match primitive {
        Primitive::I8 => 2,
        Primitive::U8 | Primitive::Char => 3,
        Primitive::I16 => 4,
        Primitive::U16 => 5,
        Primitive::I32 => 6,
        Primitive::U32 => 7,
        Primitive::I64 => 8,
        Primitive::U64 => 9,
        Primitive::F32 => 10,
        Primitive::F64 => 11,
        Primitive::IdlChar => 13,
        Primitive::IdlWChar => 14,
        Primitive::Bool => 15,
        Primitive::Byte => 16,
    }
}

fn primitive_of(id: u8) -> Option<Primitive> {
    use Primitive::{Bool, Byte, F32, F64, I8, I16, I32, I64, IdlChar, IdlWChar, U8, U16, U32, U64};
    [I8, U8, I16, U16, I32, U32, I64, U64, F32, F64, IdlChar, IdlWChar, Bool, Byte]
        .into_iter()
        .find(|&one| primitive_id(one) == id)
}

impl IndividualTypeDescription {
    fn definition(&self) -> Result<Definition, SchemaError> {
        let error = |reason: String| SchemaError::Description { name: self.type_name.clone(), reason };
        let name: TypeName = self.type_name.parse()?;
        let file: Arc<str> = format!("the type description of {name}").into();
        let mut seen = std::collections::HashSet::new();
        let mut fields = Vec::new();
        for field in &self.fields {
            names::check_member(&field.name).map_err(|fault| error(fault.to_string()))?;
            if !seen.insert(&field.name) {
                return Err(error(format!("field `{}` is defined twice", field.name)));
            }
            let ty = field.ty.parse().ok_or_else(|| {
                error(format!(
                    "the type of field `{}` (id {}) is none that messages of ROS 2 have",
                    field.name, field.ty.type_id
                ))
            })?;
            // No part of the hash: a description is used without a default that does not fit its type.
            let text = Some(&field.default_value).filter(|text| !text.is_empty());
            let default = text.and_then(|text| parse_python_default(&ty, text).ok());
            fields.push(Field {
                name: field.name.clone(),
                ty,
                default_text: default.as_ref().map_or(String::new(), |_| field.default_value.clone()),
                default,
                docs: String::new(),
                place: Place { file: file.clone(), line: 0, column: 0 },
            });
        }
        if fields.is_empty() {
            return Err(error("it has no fields".to_owned()));
        }
        Ok(Definition { name, fields, constants: vec![], docs: String::new(), file })
    }
}

impl FieldTypeDescription {
    fn parse(&self) -> Option<FieldType> {
        let (offset, capacity) = (self.type_id / ARRAY * ARRAY, u32::try_from(self.capacity).ok()?);
        let shape = match (offset, capacity) {
            (0, _) => Shape::Single,
            (ARRAY, 1..) => Shape::Array(capacity),
            (BOUNDED, 1..) => Shape::Bounded(capacity),
            (UNBOUNDED, _) => Shape::Unbounded,
            _ => return None,
        };
        let bound = Some(u32::try_from(self.string_capacity).ok()?);
        let base = match self.type_id - offset {
            NESTED => Base::Nested(self.nested_type_name.parse().ok()?),
            STRING => Base::String { bound: None },
            WSTRING => Base::WString { bound: None },
            BOUNDED_STRING if bound != Some(0) => Base::String { bound },
            BOUNDED_WSTRING if bound != Some(0) => Base::WString { bound },
            id => Base::Primitive(primitive_of(id)?),
        };
        Some(FieldType { base, shape })
    }
}

/// One type as the hash sees it.
fn individual(text: &mut String, ty: &IndividualTypeDescription) {
    // Writing to a `String` cannot fail.
    let _ = write!(text, "{{\"type_name\": {}, \"fields\": [", json(&ty.type_name));
    for (index, field) in ty.fields.iter().enumerate() {
        let FieldTypeDescription { type_id, capacity, string_capacity, nested_type_name } = &field.ty;
        let _ = write!(
            text,
            "{}{{\"name\": {}, \"type\": {{\"type_id\": {type_id}, \"capacity\": {capacity}, \
             \"string_capacity\": {string_capacity}, \"nested_type_name\": {}}}}}",
            if index > 0 { ", " } else { "" },
            json(&field.name),
            json(nested_type_name),
        );
    }
    text.push_str("]}");
}

fn json(text: &str) -> String {
    ascii(&serde_json::to_string(text).unwrap_or_default())
}

/// Escapes what is not printable ASCII in a JSON text; such characters are only in its strings.
fn ascii(json: &str) -> String {
    let mut result = String::with_capacity(json.len());
    for character in json.chars() {
        if matches!(character, ' '..='~' | '\n') {
            result.push(character);
        } else {
            for unit in character.encode_utf16(&mut [0; 2]) {
                let _ = write!(result, "\\u{unit:04x}");
            }
        }
    }
    result
}
