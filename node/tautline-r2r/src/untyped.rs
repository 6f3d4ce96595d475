// SPDX-License-Identifier: MIT OR Apache-2.0

use std::cell::RefCell;
use std::sync::Arc;
use tautline::Result;
use tautline_definitions::find_schema;
use tautline_schema::{DynamicMessage, Schema};

/// A message of a type that is known by name, between CDR and JSON.
/// [`DynamicMessage`] has more.
///
/// ```
/// use tautline_r2r::WrappedNativeMsgUntyped;
///
/// let message = WrappedNativeMsgUntyped::new_from("geometry_msgs/msg/Point")?;
/// message.from_json(serde_json::json!({ "x": 1.5 }))?; // what is left out has its default
/// assert_eq!(message.to_json()?, serde_json::json!({ "x": 1.5, "y": 0.0, "z": 0.0 }));
/// # Ok::<(), tautline_r2r::Error>(())
/// ```
#[derive(Debug)]
pub struct WrappedNativeMsgUntyped {
    schema: Arc<Schema>,
    message: RefCell<DynamicMessage>,
}

impl WrappedNativeMsgUntyped {
    /// A message of the type `package/msg/Name` with default values. Its definition is searched as in
    /// [`find_schema`].
    ///
    /// # Errors
    /// [`Error::UnknownType`](tautline::Error::UnknownType) if the definition is not found, [`Error::Schema`](tautline::Error::Schema)
    /// if it, or the name, is wrong.
    pub fn new_from(typename: &str) -> Result<Self> {
        let schema = find_schema("", &typename.parse()?, None)?;
        let message = RefCell::new(DynamicMessage::new(&schema));
        Ok(WrappedNativeMsgUntyped { schema, message })
    }

    /// Reads the CDR of a message, with its encapsulation header.
    ///
    /// # Errors
    /// [`Error::Message`](tautline::Error::Message) with field and byte if it is not valid for the type; this message is then
    /// unchanged.
    pub fn from_serialized_bytes(&mut self, data: &[u8]) -> Result<()> {
        *self.message.get_mut() = DynamicMessage::from_cdr(&self.schema, data)?;
        Ok(())
    }

    /// The message as JSON.
    ///
    /// # Errors
    /// None.
    pub fn to_json(&self) -> Result<serde_json::Value> {
        Ok(self.message.borrow().to_json_value())
    }

    /// Reads a message from JSON: an object of its fields. Omitted fields get their defaults.
    ///
    /// # Errors
    /// [`Error::Message`](tautline::Error::Message) with the field if it is not valid for the type; this message is then
    /// unchanged.
    #[allow(clippy::wrong_self_convention, reason = "the name is r2r's")]
    pub fn from_json(&self, json: serde_json::Value) -> Result<()> {
        *self.message.borrow_mut() = DynamicMessage::from_json_value(&self.schema, &json)?;
        Ok(())
    }
}
