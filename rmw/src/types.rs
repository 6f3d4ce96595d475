// SPDX-License-Identifier: MIT OR Apache-2.0
//! Types of messages and services, converted for Tautline from ROS's type supports.

use crate::bindings::*;
use crate::cdr::{Callbacks, Length};
use crate::distro;
use crate::error::{Error, Result, without_text};
use crate::layout;
use crate::support::{KnownType, SUPPORTS, no_support};
use std::ffi::CStr;
use std::ops::Range;
use std::sync::Arc;
use tautline_schema::Schema;
use tautline_transport::{Claim, Limits, ServiceType, TopicType};

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
        unsafe { distro::message(support) }.map(Self::new)
    }

    fn new((callbacks, known): (Callbacks, KnownType)) -> Self {
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
        let (known, messages) = unsafe { distro::service(found, support)? };
        let [request, response] = messages.map(MessageType::new);
        let name = TopicType::new(known.schema.name().to_string());
        let service_type = ServiceType {
            request: name.with_hash(known.hash).with_definition(known.definition),
            response: response.topic_type.clone(),
        };
        Ok(ServiceSupport { request, response, service_type })
    }
}
