// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a topic carries: the name, hash and size of its type, as far as who opens it knows them.

use crate::error::TransportError;
use iceoryx2::service::attribute::{AttributeKey, AttributeSet, AttributeSpecifier, AttributeValue};
use std::borrow::Cow;
use tautline_msgs::Message;

/// Attribute keys of a topic's service.
const NAME: &str = "ros.type";
const HASH: &str = "ros.hash";
const SIZE: &str = "ros.size";
/// How a type hash begins, and how long it is.
const HASH_PREFIX: &str = "RIHS01_";
const HASH_DIGITS: usize = 64;
/// iceoryx2's limit of an attribute is 256.
const MAX_NAME_BYTES: usize = 255;

/// The type of a topic's messages. What is not known is left out, and then agrees with everything.
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
    /// The definition as ros2msg text, with those of the types it uses. If the hash is known too, opening a topic keeps it in
    /// the [`SchemaStore`](crate::SchemaStore).
    pub definition: Option<Cow<'static, str>>,
}

impl TopicType {
    /// A type of which only the name is known.
    pub fn new(name: impl Into<Cow<'static, str>>) -> Self {
        TopicType { name: name.into(), hash: None, body_bytes: None, definition: None }
    }

    /// The same with its hash.
    #[must_use]
    pub fn with_hash(self, hash: impl Into<Cow<'static, str>>) -> Self {
        TopicType { hash: Some(hash.into()), ..self }
    }

    /// The same with a fixed size.
    #[must_use]
    pub fn with_body_bytes(self, body_bytes: usize) -> Self {
        TopicType { body_bytes: Some(body_bytes), ..self }
    }

    /// The same with its definition.
    #[must_use]
    pub fn with_definition(self, definition: impl Into<Cow<'static, str>>) -> Self {
        TopicType { definition: Some(definition.into()), ..self }
    }

    /// The type `T`.
    pub fn of<T: Message>() -> Self {
        TopicType {
            name: T::TYPE_NAME.into(),
            hash: T::TYPE_HASH.map(Cow::from),
            body_bytes: T::FIXED_LEN,
            definition: T::DEFINITION.map(|definition| definition.to_text().into()),
        }
    }

    /// Name, size and hash, for messages.
    pub(crate) fn describe(&self) -> String {
        let size = self.body_bytes.map(|bytes| format!("{bytes} bytes"));
        let facts: Vec<&str> = size.as_deref().into_iter().chain(self.hash.as_deref()).collect();
        if facts.is_empty() { self.name.to_string() } else { format!("{} ({})", self.name, facts.join(", ")) }
    }

    /// Whether both can be the same type.
    fn agrees_with(&self, other: &TopicType) -> bool {
        fn agree<V: PartialEq>(one: &Option<V>, other: &Option<V>) -> bool {
            one.is_none() || other.is_none() || one == other
        }
        self.name == other.name
            && agree(&self.hash, &other.hash)
            && agree(&self.body_bytes, &other.body_bytes)
    }

    /// What is known of the type when a topic of type `existing` is opened as this one.
    pub(crate) fn join(&self, topic: &str, existing: Option<TopicType>) -> Result<TopicType, TransportError> {
        match existing {
            Some(existing) if self.agrees_with(&existing) => Ok(TopicType {
                name: self.name.clone(),
                hash: self.hash.clone().or(existing.hash),
                body_bytes: self.body_bytes.or(existing.body_bytes),
                definition: self.definition.clone(),
            }),
            existing => Err(self.mismatch(topic, existing.as_ref())),
        }
    }

    /// The topic has another type, or one that is not Tautline's.
    pub(crate) fn mismatch(&self, topic: &str, existing: Option<&TopicType>) -> TransportError {
        let stranger = || "something that is not a Tautline message".into();
        TransportError::TypeMismatch {
            topic: topic.into(),
            existing: existing.map_or_else(stranger, TopicType::describe),
            requested: self.describe(),
        }
    }

    pub(crate) fn check(&self, topic: &str) -> Result<(), TransportError> {
        let refuse = |reason| Err(TransportError::TopicType { topic: topic.into(), reason });
        if self.name.is_empty() || self.name.len() > MAX_NAME_BYTES {
            return refuse(format!(
                "a type name has 1 to {} bytes, this one {}",
                MAX_NAME_BYTES,
                self.name.len()
            ));
        }
        match self.hash.as_deref() {
            Some(hash) if !is_hash(hash) => refuse(format!(
                "'{hash}' is not a type hash, which is {HASH_PREFIX} and {HASH_DIGITS} hexadecimal digits"
            )),
            _ => Ok(()),
        }
    }

    /// The attributes of a new topic's service.
    pub(crate) fn to_attributes(&self) -> Result<AttributeSpecifier, String> {
        let define = |specifier: AttributeSpecifier, name: &str, value: &str| {
            let value = AttributeValue::try_from(value).map_err(|error| format!("{error:?}"))?;
            specifier.define(&key(name)?, &value).map_err(|error| format!("{error:?}"))
        };
        let mut specifier = define(AttributeSpecifier::new(), NAME, &self.name)?;
        if let Some(hash) = &self.hash {
            specifier = define(specifier, HASH, hash)?;
        }
        if let Some(bytes) = self.body_bytes {
            specifier = define(specifier, SIZE, &bytes.to_string())?;
        }
        Ok(specifier)
    }

    /// The type of an existing topic. `None` if the attributes are not Tautline's.
    pub(crate) fn from_attributes(attributes: &AttributeSet) -> Option<Self> {
        let attribute = |name| Some(attributes.key_value(&key(name).ok()?, 0)?.to_string());
        Some(TopicType {
            name: attribute(NAME)?.into(),
            hash: attribute(HASH).filter(|hash| is_hash(hash)).map(Cow::from),
            body_bytes: match attribute(SIZE) {
                Some(bytes) => Some(bytes.parse().ok()?),
                None => None,
            },
            definition: None,
        })
    }
}

/// Whether this is `RIHS01_` and 64 hexadecimal digits.
pub(crate) fn is_hash(hash: &str) -> bool {
    hash.strip_prefix(HASH_PREFIX).is_some_and(|digits| {
        digits.len() == HASH_DIGITS && digits.bytes().all(|digit| digit.is_ascii_hexdigit())
    })
}

fn key(name: &str) -> Result<AttributeKey, String> {
    AttributeKey::try_from(name).map_err(|error| format!("{error:?}"))
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
        let join = |one: &TopicType, other: &TopicType| one.join("/t", Some(other.clone()));
        assert_eq!(join(&bare, &full).unwrap(), full);
        assert_eq!(join(&full, &bare).unwrap(), full);
        for other in
            [TopicType::new("a/msg/B"), bare.clone().with_hash(hash('2')), bare.clone().with_body_bytes(9)]
        {
            let text = join(&other, &full).unwrap_err().to_string();
            assert!(text.contains(&full.describe()) && text.contains(&other.describe()), "{text}");
        }
        assert!(full.join("/t", None).is_err());
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
