// SPDX-License-Identifier: MIT OR Apache-2.0
//! Type supports: ROS's information about a type, converted for Tautline.

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

/// The type supports with Fast CDR callbacks, for C and C++ structs.
const SUPPORTS: [&CStr; 2] = [c"rosidl_typesupport_fastrtps_c", c"rosidl_typesupport_fastrtps_cpp"];

/// `ROSIDL_TYPE_HASH_VERSION_1`.
const HASH_VERSION: u8 = 1;

/// A message type.
pub(crate) struct MessageType {
    pub(crate) callbacks: Callbacks,
    pub(crate) length: Length,
    pub(crate) topic_type: TopicType,
    /// For big-endian bodies.
    pub(crate) schema: Arc<Schema>,
    /// Positions of bools, for a plain type.
    bools: Vec<Range<usize>>,
}

/// A service type.
pub(crate) struct ServiceSupport {
    pub(crate) request: MessageType,
    pub(crate) response: MessageType,
    pub(crate) service_type: ServiceType,
}

impl MessageType {
    /// # Safety
    /// `support` is null or a type support.
    pub(crate) unsafe fn of(support: *const rosidl_message_type_support_t) -> Result<Self> {
        // SAFETY: the caller's contract.
        let found = unsafe { find(support)? };
        let (Some(hash), Some(description)) = (found.get_type_hash_func, found.get_type_description_func)
        else {
            return Err(no_support());
        };
        // SAFETY: both return constants of the type support's library.
        let (hash, description) = unsafe { (hash(found).as_ref(), description(found).as_ref()) };
        let (hash, description) = hash.zip(description).ok_or_else(no_support)?;
        // SAFETY: callbacks of a type support of this name.
        let callbacks = unsafe { Callbacks::new(found.data) };
        // SAFETY: a description from its generator.
        let known = unsafe { known(hash, description)? };
        let topic_type = TopicType::new(known.schema.name().to_string()).with_hash(known.hash);
        let topic_type = topic_type.with_definition(known.definition);
        // The generator calls a type plain if only its last field has the same position in CDR.
        let (length, bools) = match (callbacks.length(), layout::same_in_memory(&known.schema)) {
            (Length::Plain(bytes), Some(same)) if same.len_bytes == bytes => {
                (Length::Plain(bytes), same.bools)
            }
            (Length::Plain(bytes), _) => (Length::AtMost(bytes), Vec::new()),
            (length, _) => (length, Vec::new()),
        };
        Ok(MessageType { callbacks, length, topic_type, schema: known.schema, bools })
    }

    /// Writes bools as 0 or 1, whatever is in memory: C's structs may be uninitialised.
    ///
    /// # Real-time
    /// O(bools); no allocation; no syscall.
    pub(crate) fn tidy(&self, body: &mut [u8]) {
        for bools in &self.bools {
            let bytes = body.get_mut(bools.clone()).unwrap_or_default();
            bytes.iter_mut().filter(|byte| **byte > 1).for_each(|byte| *byte = 1);
        }
    }

    /// Whether each bool of a body is 0 or 1.
    ///
    /// # Real-time
    /// As [`tidy`](Self::tidy).
    pub(crate) fn is_tidy(&self, body: &[u8]) -> bool {
        let mut all = self.bools.iter().filter_map(|bools| body.get(bools.clone()));
        all.all(|bytes| bytes.iter().all(|byte| *byte <= 1))
    }

    /// An endpoint's limits: memory is claimed on first use, and grows with messages.
    pub(crate) fn limits(&self) -> Limits {
        let message_bytes = match self.length {
            Length::Plain(bytes) | Length::AtMost(bytes) => bytes.clamp(1, LARGE_BYTES),
            Length::Any => Limits::default().message_bytes,
        };
        Limits { held: HELD, loans: HELD, message_bytes, claim: Claim::OnUse, ..Limits::default() }
    }

    /// Whether messages have the same layout in memory and in CDR, and can be loaned.
    pub(crate) fn is_plain(&self) -> bool {
        matches!(self.length, Length::Plain(_))
    }

    pub(crate) fn name(&self) -> &str {
        &self.topic_type.name
    }
}

/// The support with Fast CDR callbacks.
///
/// # Safety
/// `support` is null or a type support.
unsafe fn find<'s>(
    support: *const rosidl_message_type_support_t,
) -> Result<&'s rosidl_message_type_support_t> {
    if support.is_null() {
        return Err(Error::null("the type support"));
    }
    // SAFETY: a type support finds the requested one, or null.
    let find = |name: &CStr| unsafe { get_message_typesupport_handle(support, name.as_ptr()).as_ref() };
    without_text(|| SUPPORTS.into_iter().find_map(find)).ok_or_else(no_support)
}

impl Callbacks {
    /// The callbacks of a type support.
    ///
    /// # Safety
    /// `support` is null or a type support.
    pub(crate) unsafe fn find(support: *const rosidl_message_type_support_t) -> Result<Self> {
        // SAFETY: the caller's contract; the support has this name.
        Ok(unsafe { Callbacks::new(find(support)?.data) })
    }
}

/// Larger bounds are not reserved in advance.
const LARGE_BYTES: usize = 1 << 20;
/// Maximum of threads in a take at one endpoint, and of loaned messages.
pub(crate) const HELD: usize = 64;

impl ServiceSupport {
    /// # Safety
    /// `support` is null or a type support.
    pub(crate) unsafe fn of(support: *const rosidl_service_type_support_t) -> Result<Self> {
        if support.is_null() {
            return Err(Error::null("the type support"));
        }
        // SAFETY: a type support finds the requested one, or null.
        let find = |name: &CStr| unsafe { get_service_typesupport_handle(support, name.as_ptr()).as_ref() };
        let found = without_text(|| SUPPORTS.into_iter().find_map(find)).ok_or_else(no_support)?;
        let (Some(hash), Some(description)) = (found.get_type_hash_func, found.get_type_description_func)
        else {
            return Err(no_support());
        };
        // SAFETY: both return constants of the type support's library.
        let (hash, description) = unsafe { (hash(found).as_ref(), description(found).as_ref()) };
        let (hash, description) = hash.zip(description).ok_or_else(no_support)?;
        // SAFETY: a description from its generator; a service's messages have type supports.
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
        "the type has no support of rosidl_typesupport_fastrtps_c or _cpp with a type hash, which rmw_tautline needs: \
         build its package with ROS 2 Jazzy or later",
    )
}

/// A type's information besides its structs.
#[derive(Clone)]
struct CachedType {
    hash: String,
    schema: Arc<Schema>,
    definition: String,
}

/// Types found before.
static KNOWN: Mutex<Option<HashMap<String, CachedType>>> = Mutex::new(None);

/// # Safety
/// `description` comes from its generator.
unsafe fn known(
    hash: &rosidl_type_hash_t,
    description: &rosidl_runtime_c__type_description__TypeDescription,
) -> Result<CachedType> {
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
    // SAFETY: the caller's contract.
    let description = unsafe { described(description) };
    let schema = Schema::from_description(&description).map_err(Error::other)?;
    if schema.hash().to_string() != hash {
        let name = schema.name();
        return Err(Error::other(format!(
            "the description of {name} does not match its hash: rebuild its package"
        )));
    }
    let known = CachedType { definition: schema.to_text(), schema: Arc::new(schema), hash: hash.clone() };
    types.insert(hash, known.clone());
    Ok(known)
}

/// # Safety
/// The description comes from its generator.
pub(crate) unsafe fn described(
    description: &rosidl_runtime_c__type_description__TypeDescription,
) -> TypeDescription {
    let referenced = &description.referenced_type_descriptions;
    // SAFETY: the caller's contract.
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
        // SAFETY: the caller's contract.
        name: unsafe { string(&field.name) },
        ty: FieldTypeDescription {
            type_id: field.type_.type_id,
            capacity: field.type_.capacity,
            string_capacity: field.type_.string_capacity,
            // SAFETY: the caller's contract.
            nested_type_name: unsafe { string(&field.type_.nested_type_name) },
        },
        // SAFETY: the caller's contract.
        default_value: unsafe { string(&field.default_value) },
    };
    // SAFETY: the caller's contract.
    unsafe {
        IndividualTypeDescription {
            type_name: string(&one.type_name),
            fields: all(one.fields.data, one.fields.size).iter().map(field).collect(),
        }
    }
}

/// # Safety
/// `data` is null or has `size` elements.
unsafe fn all<'d, T>(data: *const T, size: usize) -> &'d [T] {
    // SAFETY: the caller's contract.
    if data.is_null() { &[] } else { unsafe { std::slice::from_raw_parts(data, size) } }
}

/// # Safety
/// As [`described`].
unsafe fn string(text: &rosidl_runtime_c__String) -> String {
    // SAFETY: the caller's contract.
    String::from_utf8_lossy(unsafe { all(text.data.cast::<u8>(), text.size) }).into_owned()
}
