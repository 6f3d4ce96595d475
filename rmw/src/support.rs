// SPDX-License-Identifier: MIT OR Apache-2.0
//! What type supports of ROS say of a type: its Fast CDR callbacks, and its description.

use crate::bindings::*;
use crate::cdr::Callbacks;
use crate::error::{Error, Result, without_text};
use std::collections::HashMap;
use std::ffi::CStr;
use std::sync::Arc;
use tautline_rt::fork::ProcessMutex;
use tautline_schema::{Schema, TypeDescription};

/// The type supports with Fast CDR callbacks, for C and C++ structs.
pub(crate) const SUPPORTS: [&CStr; 2] =
    [c"rosidl_typesupport_fastrtps_c", c"rosidl_typesupport_fastrtps_cpp"];

/// The support with Fast CDR callbacks.
///
/// # Safety
/// `support` is null or a type support.
pub(crate) unsafe fn find<'s>(
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

pub(crate) fn no_support() -> Error {
    Error::invalid(
        "the type has no support of rosidl_typesupport_fastrtps_c or _cpp with what rmw_tautline needs of it: build its package \
         with the ROS 2 that rmw_tautline is built with",
    )
}

/// A type's information besides its structs.
#[derive(Clone)]
pub(crate) struct KnownType {
    pub(crate) hash: String,
    pub(crate) schema: Arc<Schema>,
    pub(crate) definition: String,
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
