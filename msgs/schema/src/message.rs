// SPDX-License-Identifier: MIT OR Apache-2.0
//! Messages of types that are known at run time only.

use std::fmt;
use std::sync::Arc;

use crate::cdr::{Failure, Reader, Writer};
use crate::{Base, FieldType, List, MessageError, Schema, Shape, Value, check};

/// A message of any type, with its schema.
///
/// ```
/// use std::sync::Arc;
/// use tautline_schema::{DynamicMessage, Schema};
///
/// let text = "Point position\nfloat32[] ranges\n===\nMSG: demo_msgs/Point\nfloat64 x\nfloat64 y\n";
/// let schema = Arc::new(Schema::from_text(&"demo_msgs/msg/Scan".parse()?, text)?);
///
/// let mut scan = DynamicMessage::from_yaml(&schema, "{position: {x: 1.5}, ranges: [1, .inf]}")?;
/// scan.set("position.y", -2.0)?;
/// assert_eq!(scan.get("ranges[0]")?.as_f64(), Some(1.0));
/// assert_eq!(scan.to_json(), r#"{"position":{"x":1.5,"y":-2.0},"ranges":[1.0,"Infinity"]}"#);
///
/// let bytes = scan.to_cdr(); // as on the ROS 2 wire
/// assert_eq!(bytes.len(), 4 + 8 + 8 + 4 + 2 * 4);
/// let again = DynamicMessage::from_cdr(&schema, &bytes)?;
/// assert_eq!(again.fields(), scan.fields());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone)]
pub struct DynamicMessage {
    pub(crate) schema: Arc<Schema>,
    /// Always values that fit the schema.
    pub(crate) fields: Vec<Value>,
    trailing: usize,
}

/// The order of a number's bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Endian {
    /// Least significant first: what ROS 2 writes on x86-64 and aarch64.
    Little,
    /// Most significant first.
    Big,
}

/// Plain CDR, little-endian, no options.
const HEADER: [u8; 4] = [0, 1, 0, 0];

impl DynamicMessage {
    /// A message of defaults.
    pub fn new(schema: &Arc<Schema>) -> Self {
        Self { schema: schema.clone(), fields: defaults(schema, 0), trailing: 0 }
    }

    /// A message of these fields, in the order of their definition.
    ///
    /// # Errors
    /// [`MessageError::Value`] if one does not fit: see [`set`](Self::set).
    pub fn from_fields(schema: &Arc<Schema>, fields: Vec<Value>) -> Result<Self, MessageError> {
        let fields = check::structure(schema, 0, fields).map_err(|fault| fault.of(schema))?;
        Ok(Self { schema: schema.clone(), fields, trailing: 0 })
    }

    /// Decodes the format of the ROS 2 wire and of bags: the encapsulation header of 4 bytes, then the body.
    ///
    /// Allocates at most in proportion to the length of `bytes`, whatever lengths they claim.
    ///
    /// # Errors
    /// [`MessageError::Encapsulation`] for a header that is not that of plain CDR, [`MessageError::Decode`] with
    /// field and byte for bytes that are not a value of the type.
    pub fn from_cdr(schema: &Arc<Schema>, bytes: &[u8]) -> Result<Self, MessageError> {
        let endian = match bytes {
            [0, 1, _, _, ..] => Endian::Little,
            [0, 0, _, _, ..] => Endian::Big,
            _ => {
                let found: Vec<_> = bytes.iter().take(4).map(|byte| format!("{byte:02x}")).collect();
                let found = if found.is_empty() { "nothing".to_owned() } else { found.join(" ") };
                return Err(MessageError::Encapsulation { type_name: schema.name().to_string(), found });
            }
        };
        Self::from_body(schema, &bytes[4..], endian)
    }

    /// Decodes a body without header, as it lies in shared memory.
    ///
    /// # Errors
    /// [`MessageError::Decode`], as [`from_cdr`](Self::from_cdr).
    pub fn from_body(schema: &Arc<Schema>, body: &[u8], endian: Endian) -> Result<Self, MessageError> {
        let reader = Reader::new(schema, body, endian == Endian::Big);
        let (fields, trailing) = reader.message().map_err(|failure| decode_error(schema, failure))?;
        Ok(Self { schema: schema.clone(), fields, trailing })
    }

    /// Whether a body is a message of this type, without decoding it: the same result as that of
    /// [`from_body`](Self::from_body). Only the content of a `wstring` is allocated. Returns how many bytes follow the last
    /// field.
    ///
    /// # Errors
    /// [`MessageError::Decode`], as [`from_cdr`](Self::from_cdr).
    pub fn validate(schema: &Schema, body: &[u8], endian: Endian) -> Result<usize, MessageError> {
        Reader::new(schema, body, endian == Endian::Big)
            .validate()
            .map_err(|failure| decode_error(schema, failure))
    }

    /// How many bytes followed the last field when this was decoded. ROS 2 may append up to 8, and up to 8 more for
    /// every empty sequence of 8-byte numbers and every `wstring`.
    pub fn trailing_bytes(&self) -> usize {
        self.trailing
    }

    /// Encodes as on the ROS 2 wire: header, then the little-endian body, padding zeroed.
    pub fn to_cdr(&self) -> Vec<u8> {
        Writer::new(&self.schema, HEADER.to_vec()).message(&self.fields)
    }

    /// Encodes the little-endian body alone.
    pub fn to_body(&self) -> Vec<u8> {
        Writer::new(&self.schema, Vec::new()).message(&self.fields)
    }

    /// The schema.
    pub fn schema(&self) -> &Arc<Schema> {
        &self.schema
    }

    /// The fields, in the order of their definition.
    pub fn fields(&self) -> &[Value] {
        &self.fields
    }
}

/// The type and the fields, as JSON.
impl fmt::Debug for DynamicMessage {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} {}", self.schema.name(), self.to_json())
    }
}

fn decode_error(schema: &Schema, Failure { path, offset, fault }: Failure) -> MessageError {
    MessageError::Decode { type_name: schema.name().to_string(), path, offset, fault }
}

/// The fields of a new message of type `index`.
pub(crate) fn defaults(schema: &Schema, index: usize) -> Vec<Value> {
    let node = schema.node(index);
    let fields = node.definition.fields.iter().zip(&node.nested);
    fields.map(|(field, nested)| default_of(schema, &field.ty, *nested, field.default.as_ref())).collect()
}

/// The value of a field that was not set.
fn default_of(schema: &Schema, ty: &FieldType, nested: Option<usize>, default: Option<&Value>) -> Value {
    if let Some(default) = default {
        return default.clone();
    }
    match (ty.shape, &ty.base, nested) {
        (Shape::Single, Base::Nested(_), Some(nested)) => Value::Struct(defaults(schema, nested)),
        (Shape::Single, base, _) => Value::zero(base),
        (Shape::Array(len), Base::Nested(_), Some(nested)) => {
            Value::List(List::Struct(vec![defaults(schema, nested); len as usize]))
        }
        (Shape::Array(len), base, _) => Value::List(List::zeros(base, len as usize)),
        (Shape::Bounded(_) | Shape::Unbounded, base, _) => Value::List(List::empty(base)),
    }
}
