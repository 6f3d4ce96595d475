// SPDX-License-Identifier: MIT OR Apache-2.0
//! Type supports: ROS's information about a type, converted for Tautline.

use crate::bindings::*;
use crate::cdr::{Callbacks, Length};
use crate::distro;
use crate::error::{Error, Result, without_text};
use crate::layout;
use std::collections::HashMap;
use std::ffi::CStr;
use std::ops::Range;
use std::sync::Arc;
use tautline_rt::fork::ProcessMutex;
use tautline_schema::{Schema, TypeDescription};
use tautline_transport::{Claim, Limits, ServiceType, TopicType};

/// The type supports with Fast CDR callbacks, for C and C++ structs.
const SUPPORTS: [&CStr; 2] = [c"rosidl_typesupport_fastrtps_c", c"rosidl_typesupport_fastrtps_cpp"];

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
        // SAFETY: the caller's contract; callbacks of a type support of this name.
        unsafe {
            let found = find(support)?;
            Ok(Self::new(Callbacks::new(found.data), distro::message(found, support)?))
        }
    }

    pub(crate) fn new(callbacks: Callbacks, known: KnownType) -> Self {
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
        MessageType { callbacks, length, topic_type, schema: known.schema, bools }
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
        // SAFETY: the caller's contract.
        let (known, request, response) = unsafe { distro::service(found, support)? };
        let name = TopicType::new(known.schema.name().to_string());
        let service_type = ServiceType {
            request: name.with_hash(known.hash).with_definition(known.definition),
            response: response.topic_type.clone(),
        };
        Ok(ServiceSupport { request, response, service_type })
    }
}

pub(crate) fn no_support() -> Error {
    Error::invalid(
        "the type has no support of rosidl_typesupport_fastrtps_c or _cpp with what rmw_tautline needs of it: build its package \
         with the ROS 2 that rmw_tautline is built with",
    )
}

/// A type's information besides its structs.
#[derive(Clone)]
pub(crate) struct KnownType {
    hash: String,
    schema: Arc<Schema>,
    definition: String,
}

/// Types found before.
static KNOWN: ProcessMutex<Option<HashMap<String, KnownType>>> = ProcessMutex::new(None, || None);

/// The type with this hash or, where types have none, this name.
pub(crate) fn described_type(
    key: String,
    describe: impl FnOnce() -> Result<TypeDescription>,
) -> Result<KnownType> {
    let mut types = KNOWN.lock();
    let types = types.get_or_insert_default();
    if let Some(known) = types.get(&key) {
        return Ok(known.clone());
    }
    let schema = Schema::from_description(&describe()?).map_err(Error::other)?;
    let (name, hash) = (schema.name(), schema.hash().to_string());
    if key != hash && key != name.to_string() {
        return Err(Error::other(format!(
            "the description of {name} does not match its hash: rebuild its package"
        )));
    }
    let known = KnownType { definition: schema.to_text(), schema: Arc::new(schema), hash };
    types.insert(key, known.clone());
    Ok(known)
}
