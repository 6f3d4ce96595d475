// SPDX-License-Identifier: MIT OR Apache-2.0
//! Converts messages from and to JSON and YAML according to the schema.

mod read;
mod write;

use std::sync::Arc;

use serde::de::DeserializeSeed;

#[cfg(feature = "yaml")]
use crate::error::MAX_DEPTH;
use crate::{DynamicMessage, MessageError, Schema, Value};
use read::Root;
#[cfg(feature = "yaml")]
use read::Stamps;

impl DynamicMessage {
    /// Reads JSON: an object of the fields; omitted fields have their defaults. NaN and infinities are the strings `"NaN"`, `"Infinity"` and
    /// `"-Infinity"`. A `bool` may be 0 or 1, and an integer of at most 2^53 may be a float without a fraction, such as `1.0`.
    ///
    /// # Errors
    /// [`MessageError::Text`] with field and place if it is not valid or does not fit the type.
    pub fn from_json(schema: &Arc<Schema>, text: &str) -> Result<Self, MessageError> {
        let mut deserializer = serde_json::Deserializer::from_str(text);
        let fields = Root::seed(schema, None).deserialize(&mut deserializer);
        let fields = fields.and_then(|fields| deserializer.end().map(|()| fields));
        Self::from_text_fields(schema, fields.map_err(|error| error.to_string()))
    }

    /// Reads YAML, with the feature `yaml`: a mapping of the fields, as [`from_json`](Self::from_json) reads an object.
    ///
    /// # Errors
    /// [`MessageError::Text`] with field and place if it is not valid or does not fit the type.
    #[cfg(feature = "yaml")]
    pub fn from_yaml(schema: &Arc<Schema>, text: &str) -> Result<Self, MessageError> {
        Self::from_yaml_of(schema, text, None)
    }

    /// Reads YAML, with the feature `yaml`, as `ros2 topic pub` does: as [`from_yaml`](Self::from_yaml), but a `std_msgs/Header` may be the word
    /// `auto`, and a `builtin_interfaces/Time` the word `now`. Returns the paths of the times to set, such as `header.stamp`; they are 0.
    ///
    /// # Errors
    /// As [`from_yaml`](Self::from_yaml).
    #[cfg(feature = "yaml")]
    pub fn from_yaml_with_stamps(
        schema: &Arc<Schema>,
        text: &str,
    ) -> Result<(Self, Vec<String>), MessageError> {
        let stamps = Stamps::default();
        let message = Self::from_yaml_of(schema, text, Some(&stamps))?;
        Ok((message, stamps.into_inner()))
    }

    #[cfg(feature = "yaml")]
    fn from_yaml_of(schema: &Arc<Schema>, text: &str, stamps: Option<&Stamps>) -> Result<Self, MessageError> {
        let options = yaml_options(text);
        let fields = serde_saphyr::with_deserializer_from_str_with_options(text, options, |deserializer| {
            Root::seed(schema, stamps).deserialize(deserializer)
        });
        Self::from_text_fields(schema, fields.map_err(|error| error.to_string()))
    }

    /// [`from_json`](Self::from_json) of what was parsed already.
    ///
    /// # Errors
    /// [`MessageError::Text`] with the field if it does not fit the type.
    pub fn from_json_value(schema: &Arc<Schema>, json: &serde_json::Value) -> Result<Self, MessageError> {
        let fields = Root::seed(schema, None).deserialize(json);
        Self::from_text_fields(schema, fields.map_err(|error| error.to_string()))
    }

    fn from_text_fields(
        schema: &Arc<Schema>,
        fields: Result<Vec<Value>, String>,
    ) -> Result<Self, MessageError> {
        let error = |reason| MessageError::Text { type_name: schema.name().to_string(), reason };
        Self::from_fields(schema, fields.map_err(error)?)
    }

    /// Writes JSON in one line. [`serde::Serialize`] gives every other form.
    pub fn to_json(&self) -> String {
        // All keys are strings, all numbers finite.
        serde_json::to_string(self).unwrap_or_default()
    }

    /// As [`to_json`](Self::to_json), but NaN and infinities are the numbers `NaN`, `Infinity` and `-Infinity`, as jq and Python's `json` read
    /// them. JSON itself has no such numbers.
    pub fn to_extended_json(&self) -> String {
        write::extended_json(self)
    }

    /// The same as [`to_json`](Self::to_json), as a value.
    pub fn to_json_value(&self) -> serde_json::Value {
        serde_json::to_value(self).unwrap_or_default()
    }
}

/// Limits in proportion to the text, since images and point clouds have many numbers.
#[cfg(feature = "yaml")]
fn yaml_options(text: &str) -> serde_saphyr::Options {
    let most = text.len() + 16;
    serde_saphyr::options! {
        // As in YAML 1.1, which ROS 2 reads: `010` is 8.
        legacy_octal_numbers: true,
        non_finite_float_policy: serde_saphyr::NonFiniteFloatPolicy::PassThrough,
        with_snippet: false,
        budget: serde_saphyr::budget! {
            max_events: most,
            max_nodes: most,
            // A list at every level of nesting.
            max_depth: 2 * MAX_DEPTH,
        },
    }
}
