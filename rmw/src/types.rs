// SPDX-License-Identifier: MIT OR Apache-2.0
//! Type supports: what ROS gives of a type, as what Tautline wants to know of it.

use crate::bindings::*;
use crate::cdr::{Callbacks, Length};
use crate::error::{Error, Result, without_text};
use crate::layout;
use std::collections::HashMap;
use std::ffi::CStr;
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};
use tautline_schema::{
    FieldDescription, FieldTypeDescription, IndividualTypeDescription, Schema, TypeDescription,
};
use tautline_transport::{Claim, Limits, ServiceType, TopicType};

/// The type supports whose callbacks are of Fast CDR: that for structs of C, and that for those of C++.
const SUPPORTS: [&CStr; 2] = [c"rosidl_typesupport_fastrtps_c", c"rosidl_typesupport_fastrtps_cpp"];

/// `ROSIDL_TYPE_HASH_VERSION_1`.
const HASH_VERSION: u8 = 1;

/// A type of messages.
pub(crate) struct MessageType {
    pub(crate) callbacks: Callbacks,
    pub(crate) length: Length,
    pub(crate) topic_type: TopicType,
    /// For bytes of another order.
    pub(crate) schema: Arc<Schema>,
    /// Of a plain type: where its bools are.
    bools: Vec<Range<usize>>,
}

/// A type of services.
pub(crate) struct ServiceSupport {
    pub(crate) request: MessageType,
    pub(crate) response: MessageType,
    pub(crate) service_type: ServiceType,
}

impl MessageType {
    /// # Safety
    /// `support` is null or a type support.
    pub(crate) unsafe fn of(support: *const rosidl_message_type_support_t) -> Result<Self> {
        // SAFETY: the caller's word.
        let found = unsafe { find(support)? };
        let (Some(hash), Some(description)) = (found.get_type_hash_func, found.get_type_description_func)
        else {
            return Err(no_support());
        };
        // SAFETY: both give constants of the library that the type support is in.
        let (hash, description) = unsafe { (hash(found).as_ref(), description(found).as_ref()) };
        let (hash, description) = hash.zip(description).ok_or_else(no_support)?;
        // SAFETY: the callbacks of a type support of this name.
        let callbacks = unsafe { Callbacks::new(found.data) };
        // SAFETY: a description that its generator made.
        let known = unsafe { known(hash, description)? };
        let topic_type = TopicType::new(known.schema.name().to_string()).with_hash(known.hash);
        let topic_type = topic_type.with_definition(known.definition);
        // Its generator calls a type plain whose last field alone is where it is in CDR.
        let (length, bools) = match (callbacks.length(), layout::same_in_memory(&known.schema)) {
            (Length::Plain(bytes), Some(same)) if same.len_bytes == bytes => {
                (Length::Plain(bytes), same.bools)
            }
            (Length::Plain(bytes), _) => (Length::AtMost(bytes), Vec::new()),
            (length, _) => (length, Vec::new()),
        };
        Ok(MessageType { callbacks, length, topic_type, schema: known.schema, bools })
    }

    /// What is written for a bool is 0 or 1, whatever is in memory: C's structs may not have been filled in.
    ///
    /// # Real-time
    /// O(bools); no allocation; no syscall.
    pub(crate) fn tidy(&self, body: &mut [u8]) {
        for bools in &self.bools {
            let bytes = body.get_mut(bools.clone()).unwrap_or_default();
            bytes.iter_mut().filter(|byte| **byte > 1).for_each(|byte| *byte = 1);
        }
    }

    /// Whether each bool of a body is one.
    ///
    /// # Real-time
    /// As [`tidy`](Self::tidy).
    pub(crate) fn is_tidy(&self, body: &[u8]) -> bool {
        let mut all = self.bools.iter().filter_map(|bools| body.get(bools.clone()));
        all.all(|bytes| bytes.iter().all(|byte| *byte <= 1))
    }

    /// What an end has room for: memory is claimed when it is first needed, and grows with what is sent.
    pub(crate) fn limits(&self) -> Limits {
        let message_bytes = match self.length {
            Length::Plain(bytes) | Length::AtMost(bytes) => bytes.clamp(1, LARGE_BYTES),
            Length::Any => Limits::default().message_bytes,
        };
        Limits { held: HELD, loans: HELD, message_bytes, claim: Claim::OnUse, ..Limits::default() }
    }

    /// Whether messages lie in memory as they are sent, and can be lent.
    pub(crate) fn is_plain(&self) -> bool {
        matches!(self.length, Length::Plain(_))
    }

    pub(crate) fn name(&self) -> &str {
        &self.topic_type.name
    }
}

/// The support whose callbacks are of Fast CDR.
///
/// # Safety
/// `support` is null or a type support.
unsafe fn find<'s>(
    support: *const rosidl_message_type_support_t,
) -> Result<&'s rosidl_message_type_support_t> {
    if support.is_null() {
        return Err(Error::null("the type support"));
    }
    // SAFETY: a type support finds the one that is asked for, or null.
    let find = |name: &CStr| unsafe { get_message_typesupport_handle(support, name.as_ptr()).as_ref() };
    without_text(|| SUPPORTS.into_iter().find_map(find)).ok_or_else(no_support)
}

impl Callbacks {
    /// Those of a type support.
    ///
    /// # Safety
    /// `support` is null or a type support.
    pub(crate) unsafe fn find(support: *const rosidl_message_type_support_t) -> Result<Self> {
        // SAFETY: the caller's word; the support has this name.
        Ok(unsafe { Callbacks::new(find(support)?.data) })
    }
}

/// A bound that nobody reaches is not to be provided for.
const LARGE_BYTES: usize = 1 << 20;
/// Threads that may take from one end at once, and messages that may be out as loans.
pub(crate) const HELD: usize = 64;

impl ServiceSupport {
    /// # Safety
    /// `support` is null or a type support.
    pub(crate) unsafe fn of(support: *const rosidl_service_type_support_t) -> Result<Self> {
        if support.is_null() {
            return Err(Error::null("the type support"));
        }
        // SAFETY: a type support finds the one that is asked for, or null.
        let find = |name: &CStr| unsafe { get_service_typesupport_handle(support, name.as_ptr()).as_ref() };
        let found = without_text(|| SUPPORTS.into_iter().find_map(find)).ok_or_else(no_support)?;
        let (Some(hash), Some(description)) = (found.get_type_hash_func, found.get_type_description_func)
        else {
            return Err(no_support());
        };
        // SAFETY: both give constants of the library that the type support is in.
        let (hash, description) = unsafe { (hash(found).as_ref(), description(found).as_ref()) };
        let (hash, description) = hash.zip(description).ok_or_else(no_support)?;
        // SAFETY: a description that its generator made; a service's messages have type supports.
        let (known, request, response) = unsafe {
            let request = MessageType::of(found.request_typesupport)?;
            (known(hash, description)?, request, MessageType::of(found.response_typesupport)?)
        };
        let name = TopicType::new(known.schema.name().to_string());
        let service_type = ServiceType {
            request: name.with_hash(known.hash).with_definition(known.definition),
            response: response.topic_type.clone(),
        };
        Ok(ServiceSupport { request, response, service_type })
    }
}

fn no_support() -> Error {
    Error::invalid(
        "the type has no support that rmw_tautline can use, which is rosidl_typesupport_fastrtps_c or _cpp with a type hash: \
         build its package with ROS 2 Jazzy or later",
    )
}

/// What is known of a type besides its structs.
#[derive(Clone)]
struct Known {
    hash: String,
    schema: Arc<Schema>,
    definition: String,
}

/// Types that were met before.
static KNOWN: Mutex<Option<HashMap<String, Known>>> = Mutex::new(None);

/// # Safety
/// `description` is as its generator made it.
unsafe fn known(
    hash: &rosidl_type_hash_t,
    description: &rosidl_runtime_c__type_description__TypeDescription,
) -> Result<Known> {
    if hash.version != HASH_VERSION {
        return Err(no_support());
    }
    let digits: String = hash.value.iter().map(|byte| format!("{byte:02x}")).collect();
    let hash = format!("RIHS01_{digits}");
    let mut types = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
    let types = types.get_or_insert_default();
    if let Some(known) = types.get(&hash) {
        return Ok(known.clone());
    }
    // SAFETY: the caller's word.
    let description = unsafe { described(description) };
    let schema = Schema::from_description(&description).map_err(Error::other)?;
    if schema.hash().to_string() != hash {
        let name = schema.name();
        return Err(Error::other(format!(
            "{name} is described as another type than its hash says: rebuild its package"
        )));
    }
    let known = Known { definition: schema.to_text(), schema: Arc::new(schema), hash: hash.clone() };
    types.insert(hash, known.clone());
    Ok(known)
}

/// # Safety
/// The description is as its generator made it.
unsafe fn described(description: &rosidl_runtime_c__type_description__TypeDescription) -> TypeDescription {
    let referenced = &description.referenced_type_descriptions;
    // SAFETY: the caller's word.
    unsafe {
        TypeDescription {
            type_description: individual(&description.type_description),
            referenced_type_descriptions: all(referenced.data, referenced.size)
                .iter()
                .map(|one| individual(one))
                .collect(),
        }
    }
}

/// # Safety
/// As [`described`].
unsafe fn individual(
    one: &rosidl_runtime_c__type_description__IndividualTypeDescription,
) -> IndividualTypeDescription {
    let field = |field: &rosidl_runtime_c__type_description__Field| FieldDescription {
        // SAFETY: the caller's word.
        name: unsafe { string(&field.name) },
        ty: FieldTypeDescription {
            type_id: field.type_.type_id,
            capacity: field.type_.capacity,
            string_capacity: field.type_.string_capacity,
            // SAFETY: the caller's word.
            nested_type_name: unsafe { string(&field.type_.nested_type_name) },
        },
        // SAFETY: the caller's word.
        default_value: unsafe { string(&field.default_value) },
    };
    // SAFETY: the caller's word.
    unsafe {
        IndividualTypeDescription {
            type_name: string(&one.type_name),
            fields: all(one.fields.data, one.fields.size).iter().map(field).collect(),
        }
    }
}

/// # Safety
/// `data` is null, or has `size` elements.
unsafe fn all<'d, T>(data: *const T, size: usize) -> &'d [T] {
    // SAFETY: the caller's word.
    if data.is_null() { &[] } else { unsafe { std::slice::from_raw_parts(data, size) } }
}

/// # Safety
/// As [`described`].
unsafe fn string(text: &rosidl_runtime_c__String) -> String {
    // SAFETY: the caller's word.
    String::from_utf8_lossy(unsafe { all(text.data.cast::<u8>(), text.size) }).into_owned()
}
