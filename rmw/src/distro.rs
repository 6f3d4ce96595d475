// SPDX-License-Identifier: MIT OR Apache-2.0
//! What differs between distributions of ROS 2, from Humble on. All else compiles with the headers of each.

mod interface;
#[cfg(any(humble, test))]
pub(crate) mod introspection;

use crate::bindings::*;
use crate::cdr::Callbacks;
use crate::error::{Error, Result};
use crate::support::{self, KnownType, described_type, no_support};
use std::ffi::{CString, c_char, c_void};

#[cfg(humble)]
pub(crate) use humble::*;
#[cfg(not(humble))]
pub(crate) use since_jazzy::*;

/// Checks that the loaded librmw, and `ROS_DISTRO` if it is set, are of the distribution of the build: structs differ between
/// distributions.
pub(crate) fn check() -> Result {
    let sourced = std::env::var("ROS_DISTRO").unwrap_or_default();
    check_loaded(interface::of(is_loaded), &sourced)
}

pub(crate) fn check_loaded(loaded: &str, sourced: &str) -> Result {
    const INTERFACE: &str = env!("RMW_INTERFACE");
    const BUILT: &str = env!("ROS_DISTRO");
    let built = if BUILT.is_empty() { INTERFACE } else { BUILT };
    let (found, other) = if loaded != INTERFACE {
        ("the librmw that is loaded is of", loaded)
    } else if !BUILT.is_empty() && !sourced.is_empty() && sourced != BUILT {
        ("ROS_DISTRO is", sourced)
    } else {
        return Ok(());
    };
    Err(Error::unsupported(format!(
        "this rmw_tautline is built for ROS 2 {built}, and {found} {other}: build it with {other} sourced, or use another RMW"
    )))
}

/// The error for a null argument of two functions for which ROS 2's tests require, until Jazzy, another code than rmw's headers document.
pub(crate) fn null_argument(what: &str) -> Error {
    match env!("RMW_INTERFACE") {
        "humble" | "jazzy" => Error::other(format!("{what} is null")),
        _ => Error::null(what),
    }
}

/// A message type.
///
/// # Safety
/// `support` is null or a type support.
pub(crate) unsafe fn message(
    support: *const rosidl_message_type_support_t,
) -> Result<(Callbacks, KnownType)> {
    // SAFETY: the caller's contract; callbacks of a type support of this name.
    unsafe {
        let found = support::find(support)?;
        Ok((Callbacks::new(found.data), type_of_message(found, support)?))
    }
}

/// Whether a loaded library has this function.
fn is_loaded(function: &str) -> bool {
    unsafe extern "C" {
        fn dlsym(handle: *mut c_void, symbol: *const c_char) -> *mut c_void;
    }
    const RTLD_DEFAULT: *mut c_void = std::ptr::null_mut();
    // SAFETY: a text that outlives the call. The address is not used.
    CString::new(function).is_ok_and(|name| unsafe { !dlsym(RTLD_DEFAULT, name.as_ptr()).is_null() })
}

#[cfg(not(humble))]
mod since_jazzy {
    use super::*;
    use crate::error::checked;
    use tautline_schema::{
        FieldDescription, FieldTypeDescription, IndividualTypeDescription, TypeDescription,
    };

    pub(crate) const LAST_SUBSCRIPTION_EVENT: rmw_event_type_t = RMW_EVENT_SUBSCRIPTION_MATCHED;
    pub(crate) const LAST_EVENT: rmw_event_type_t = RMW_EVENT_PUBLICATION_MATCHED;

    /// Checks whether the options for discovery can be met.
    pub(crate) fn check_discovery(options: &rmw_init_options_t) -> Result {
        let discovery = &options.discovery_options;
        if discovery.automatic_discovery_range == RMW_AUTOMATIC_DISCOVERY_RANGE_OFF {
            return Err(Error::unsupported(
                "ROS_AUTOMATIC_DISCOVERY_RANGE=OFF: rmw_tautline cannot hide a context. Set TAUT_SCOPE to a private name, \
                 or use another domain",
            ));
        }
        if discovery.static_peers_count != 0 {
            tracing::warn!(
                "ROS_STATIC_PEERS has no effect: use `taut gateway --connect tcp/HOST:PORT` to reach other hosts"
            );
        }
        Ok(())
    }

    /// Copies the options for discovery into those of `to`, which are uninitialised.
    ///
    /// # Safety
    /// The options for discovery of `from` are initialised.
    pub(crate) unsafe fn copy_discovery(from: &rmw_init_options_t, to: &mut rmw_init_options_t) -> Result {
        // SAFETY: the caller's contract.
        unsafe {
            to.discovery_options = rmw_get_zero_initialized_discovery_options();
            let mut allocator = from.allocator;
            let (from, to) = (&from.discovery_options, &mut to.discovery_options);
            checked(rmw_discovery_options_copy(from, &mut allocator, to), "copying the discovery options")
        }
    }

    /// Frees the memory of the options for discovery.
    ///
    /// # Safety
    /// They are initialised or zero.
    pub(crate) unsafe fn finish_discovery(options: &mut rmw_init_options_t) {
        // SAFETY: the caller's contract.
        let _ = unsafe { rmw_discovery_options_fini(&mut options.discovery_options) };
    }

    pub(crate) fn set_type_hash(info: &mut rmw_topic_endpoint_info_t, hash: Option<&str>) -> rmw_ret_t {
        // SAFETY: valid structs.
        unsafe { rmw_topic_endpoint_info_set_topic_type_hash(info, &type_hash(hash)) }
    }

    /// A hash as bytes; version 0 (unset) if unknown.
    pub(crate) fn type_hash(hash: Option<&str>) -> rosidl_type_hash_t {
        let digits = hash.and_then(|hash| hash.strip_prefix("RIHS01_")).unwrap_or_default();
        let mut found = rosidl_type_hash_t { version: 0, value: [0; 32] };
        for (byte, digits) in found.value.iter_mut().zip(digits.as_bytes().chunks(2)) {
            let text = std::str::from_utf8(digits).unwrap_or_default();
            *byte = u8::from_str_radix(text, 16).unwrap_or(0);
            found.version = 1;
        }
        found
    }

    /// `ROSIDL_TYPE_HASH_VERSION_1`.
    const HASH_VERSION: u8 = 1;

    /// # Safety
    /// Both are type supports of one type.
    pub(crate) unsafe fn type_of_message(
        found: &rosidl_message_type_support_t,
        _asked: *const rosidl_message_type_support_t,
    ) -> Result<KnownType> {
        let (Some(hash), Some(description)) = (found.get_type_hash_func, found.get_type_description_func)
        else {
            return Err(no_support());
        };
        // SAFETY: both return constants of the type support's library.
        unsafe { type_by_hash(hash(found), description(found)) }
    }

    /// A service, its request and its response.
    ///
    /// # Safety
    /// As [`type_of_message`].
    pub(crate) unsafe fn service(
        found: &rosidl_service_type_support_t,
        _asked: *const rosidl_service_type_support_t,
    ) -> Result<(KnownType, [(Callbacks, KnownType); 2])> {
        let (Some(hash), Some(description)) = (found.get_type_hash_func, found.get_type_description_func)
        else {
            return Err(no_support());
        };
        // SAFETY: as in `type_of_message`; a service's messages have type supports.
        unsafe {
            let messages = [message(found.request_typesupport)?, message(found.response_typesupport)?];
            Ok((type_by_hash(hash(found), description(found))?, messages))
        }
    }

    /// # Safety
    /// Both are null, or constants of a type support's library.
    unsafe fn type_by_hash(
        hash: *const rosidl_type_hash_t,
        description: *const rosidl_runtime_c__type_description__TypeDescription,
    ) -> Result<KnownType> {
        // SAFETY: the caller's contract.
        let (hash, description) = unsafe { (hash.as_ref(), description.as_ref()) };
        let (hash, description) = hash.zip(description).ok_or_else(no_support)?;
        if hash.version != HASH_VERSION {
            return Err(no_support());
        }
        let digits: String = hash.value.iter().map(|byte| format!("{byte:02x}")).collect();
        // SAFETY: a description from its generator.
        described_type(format!("RIHS01_{digits}"), || Ok(unsafe { described(description) }))
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
}

#[cfg(humble)]
mod humble {
    use super::*;
    use std::ffi::CStr;

    pub(crate) const LAST_SUBSCRIPTION_EVENT: rmw_event_type_t = RMW_EVENT_MESSAGE_LOST;
    pub(crate) const LAST_EVENT: rmw_event_type_t = RMW_EVENT_OFFERED_QOS_INCOMPATIBLE;

    // Events that this distribution does not have, so that none is requested.
    pub(crate) const RMW_EVENT_SUBSCRIPTION_INCOMPATIBLE_TYPE: rmw_event_type_t = RMW_EVENT_INVALID + 1;
    pub(crate) const RMW_EVENT_SUBSCRIPTION_MATCHED: rmw_event_type_t = RMW_EVENT_INVALID + 2;
    pub(crate) const RMW_EVENT_PUBLISHER_INCOMPATIBLE_TYPE: rmw_event_type_t = RMW_EVENT_INVALID + 3;
    pub(crate) const RMW_EVENT_PUBLICATION_MATCHED: rmw_event_type_t = RMW_EVENT_INVALID + 4;

    #[allow(non_camel_case_types, dead_code, reason = "rmw's name; no such event is taken")]
    pub(crate) struct rmw_matched_status_t {
        pub(crate) total_count: usize,
        pub(crate) total_count_change: usize,
        pub(crate) current_count: usize,
        pub(crate) current_count_change: i32,
    }

    // Policies that no profile of this rcl has. As in later distributions, each is the number after `UNKNOWN`.
    pub(crate) const RMW_QOS_POLICY_RELIABILITY_BEST_AVAILABLE: u32 = 4;
    pub(crate) const RMW_QOS_POLICY_DURABILITY_BEST_AVAILABLE: u32 = 4;
    pub(crate) const RMW_QOS_POLICY_LIVELINESS_BEST_AVAILABLE: u32 = 5;

    /// Accepts all options: discovery is limited to this host, with or without `ROS_LOCALHOST_ONLY`.
    pub(crate) fn check_discovery(_: &rmw_init_options_t) -> Result {
        Ok(())
    }

    /// There are no options for discovery.
    pub(crate) unsafe fn copy_discovery(_: &rmw_init_options_t, _: &mut rmw_init_options_t) -> Result {
        Ok(())
    }

    pub(crate) unsafe fn finish_discovery(_: &mut rmw_init_options_t) {}

    /// Does nothing: information on endpoints has no type hash.
    pub(crate) fn set_type_hash(_: &mut rmw_topic_endpoint_info_t, _: Option<&str>) -> rmw_ret_t {
        crate::bindings::RET_OK
    }

    /// # Safety
    /// Both are type supports of one type.
    pub(crate) unsafe fn type_of_message(
        _found: &rosidl_message_type_support_t,
        asked: *const rosidl_message_type_support_t,
    ) -> Result<KnownType> {
        // SAFETY: a type support finds the requested one, or null.
        let find = |name: &CStr| unsafe { get_message_typesupport_handle(asked, name.as_ptr()).as_ref() };
        let found = introspection::SUPPORTS.into_iter().find_map(find).ok_or_else(no_support)?;
        // SAFETY: of a type support of this name.
        unsafe { message_type(found.data.cast()) }
    }

    /// A service, its request and its response.
    ///
    /// # Safety
    /// As [`type_of_message`].
    pub(crate) unsafe fn service(
        found: &rosidl_service_type_support_t,
        asked: *const rosidl_service_type_support_t,
    ) -> Result<(KnownType, [(Callbacks, KnownType); 2])> {
        /// `service_type_support_callbacks_t` of rosidl_typesupport_fastrtps_cpp, whose header is for C++.
        #[repr(C)]
        struct Messages {
            names: [*const c_char; 2],
            request: *const rosidl_message_type_support_t,
            response: *const rosidl_message_type_support_t,
        }
        // SAFETY: a type support finds the requested one, or null.
        let find = |name: &CStr| unsafe { get_service_typesupport_handle(asked, name.as_ptr()).as_ref() };
        let members = introspection::SUPPORTS.into_iter().find_map(find).ok_or_else(no_support)?;
        // SAFETY: of type supports of these names; a service has both messages.
        unsafe {
            let messages = &*found.data.cast::<Messages>();
            let members = &*members.data.cast::<rosidl_typesupport_introspection_c__ServiceMembers>();
            let of = |callbacks: *const rosidl_message_type_support_t, members| {
                message_type(members).map(|known| (Callbacks::new((*callbacks).data), known))
            };
            let messages = [
                of(messages.request, members.request_members_)?,
                of(messages.response, members.response_members_)?,
            ];
            let name = introspection::name(members.service_namespace_, members.service_name_);
            Ok((described_type(name, || Ok(introspection::service(members)))?, messages))
        }
    }

    /// # Safety
    /// The members come from their generator.
    unsafe fn message_type(
        members: *const rosidl_typesupport_introspection_c__MessageMembers,
    ) -> Result<KnownType> {
        // SAFETY: the caller's contract.
        unsafe {
            let members = members.as_ref().ok_or_else(no_support)?;
            let name = introspection::name(members.message_namespace_, members.message_name_);
            described_type(name, || Ok(introspection::message(members)))
        }
    }
}
