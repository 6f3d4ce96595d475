// SPDX-License-Identifier: MIT OR Apache-2.0
//! The type of a topic: its name, hash and size, as far as the endpoint that opens the topic knows them.

use crate::error::TransportError;
use crate::names::{HASH_DIGITS, HASH_PREFIX, MAX_NAME_BYTES, is_hash, is_type};
use std::borrow::Cow;
use tautline_msgs::{Message, definition_text};

/// The type of a topic's messages. Unknown properties are omitted, and agree with every value.
///
/// ```
/// # use tautline_transport::TopicType;
/// let image = TopicType::new("sensor_msgs/msg/Image");
/// assert_eq!((image.hash, image.body_bytes), (None, None));
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicType {
    /// The ROS 2 name, `package/msg/Name`.
    pub name: Cow<'static, str>,
    /// The type hash, `RIHS01_` and 64 hexadecimal digits.
    pub hash: Option<Cow<'static, str>>,
    /// Length of every body in bytes, if the type's size is fixed and known: CDR without the 4 encapsulation bytes and
    /// without trailing padding.
    pub body_bytes: Option<usize>,
    /// The definition as ros2msg text, with those of the types it uses. If the hash is known, too, opening a topic stores the
    /// definition in the [`SchemaStore`](crate::SchemaStore).
    pub definition: Option<Cow<'static, str>>,
}

impl TopicType {
    /// A type of which only the name is known.
    pub fn new(name: impl Into<Cow<'static, str>>) -> Self {
        TopicType { name: name.into(), hash: None, body_bytes: None, definition: None }
    }

    /// The same with its hash.
    #[must_use = "it returns the changed type"]
    pub fn with_hash(self, hash: impl Into<Cow<'static, str>>) -> Self {
        TopicType { hash: Some(hash.into()), ..self }
    }

    /// The same with a fixed size.
    #[must_use = "it returns the changed type"]
    pub fn with_body_bytes(self, body_bytes: usize) -> Self {
        TopicType { body_bytes: Some(body_bytes), ..self }
    }

    /// The same with its definition.
    #[must_use = "it returns the changed type"]
    pub fn with_definition(self, definition: impl Into<Cow<'static, str>>) -> Self {
        TopicType { definition: Some(definition.into()), ..self }
    }

    /// The type `T`.
    pub fn of<T: Message>() -> Self {
        TopicType {
            name: T::TYPE_NAME.into(),
            hash: T::TYPE_HASH.map(Cow::from),
            body_bytes: T::FIXED_LEN,
            definition: definition_text::<T>().map(Cow::from),
        }
    }

    /// Name, size and hash, for messages.
    pub(crate) fn describe(&self) -> String {
        let size = self.body_bytes.map(|bytes| format!("{bytes} bytes"));
        let facts: Vec<&str> = size.as_deref().into_iter().chain(self.hash.as_deref()).collect();
        if facts.is_empty() { self.name.to_string() } else { format!("{} ({})", self.name, facts.join(", ")) }
    }

    /// Whether both can be the same type, so that messages can be delivered between them.
    pub fn agrees_with(&self, other: &TopicType) -> bool {
        fn agree<V: PartialEq>(one: &Option<V>, other: &Option<V>) -> bool {
            one.is_none() || other.is_none() || one == other
        }
        self.name == other.name
            && agree(&self.hash, &other.hash)
            && agree(&self.body_bytes, &other.body_bytes)
    }

    /// The combined knowledge of both about the type; `None` if they do not agree.
    pub fn join(self, other: &TopicType) -> Option<TopicType> {
        self.agrees_with(other).then(|| TopicType {
            hash: self.hash.or_else(|| other.hash.clone()),
            body_bytes: self.body_bytes.or(other.body_bytes),
            definition: self.definition.or_else(|| other.definition.clone()),
            name: self.name,
        })
    }

    pub(crate) fn check(&self, topic: &str) -> Result<(), TransportError> {
        let refuse = |reason| Err(TransportError::TopicType { topic: topic.into(), reason });
        if !is_type(&self.name, None) {
            return refuse(format!(
                "'{}' cannot be a type's name, which has 1 to {MAX_NAME_BYTES} visible characters of ASCII",
                self.name.escape_default()
            ));
        }
        match self.hash.as_deref() {
            Some(hash) if !is_hash(hash) => refuse(format!(
                "'{}' is not a type hash, which is {HASH_PREFIX} and {HASH_DIGITS} hexadecimal digits",
                hash.escape_default()
            )),
            _ => Ok(()),
        }
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    fn hash(digit: char) -> String {
        format!("{HASH_PREFIX}{}", String::from(digit).repeat(HASH_DIGITS))
    }

    #[test]
    fn what_is_unknown_agrees_with_everything() {
        let bare = TopicType::new("a/msg/A");
        let full = bare.clone().with_hash(hash('1')).with_body_bytes(8);
        assert_eq!(bare.clone().join(&full).unwrap(), full);
        assert_eq!(full.clone().join(&bare).unwrap(), full);
        for other in
            [TopicType::new("a/msg/B"), bare.clone().with_hash(hash('2')), bare.clone().with_body_bytes(9)]
        {
            assert!(!other.agrees_with(&full) && !full.agrees_with(&other) && other.join(&full).is_none());
        }
    }

    #[test]
    fn names_and_hashes_are_checked() {
        for bad in ["", "RIHS01_", "RIHS01_../../etc", &hash('g'), &hash('1')[1..]] {
            assert!(TopicType::new("a/msg/A").with_hash(bad.to_owned()).check("/t").is_err(), "{bad}");
        }
        assert!(TopicType::new("a/msg/A").with_hash(hash('f')).check("/t").is_ok());
        assert!(TopicType::new("").check("/t").is_err());
        assert!(TopicType::new("a".repeat(300)).check("/t").is_err());
    }
}
