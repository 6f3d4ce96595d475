// SPDX-License-Identifier: MIT OR Apache-2.0
//! Type supports: those of ROS's packages, and one of a plain type of any length, which no package has.

use crate::bindings::*;
use libloading::Library;
use std::ffi::{CStr, c_char, c_void};
use std::sync::OnceLock;
use tautline_exchange::Result;
use tautline_schema::Schema;

/// Of a message of ROS's.
pub fn message(package: &str, name: &str) -> Result<*const rosidl_message_type_support_t> {
    // SAFETY: rosidl's generator makes a function of this type for each message.
    unsafe { generated("message", package, "msg", name) }
}

/// Of a service of ROS's.
pub fn service(package: &str, name: &str) -> Result<*const rosidl_service_type_support_t> {
    // SAFETY: as for messages.
    unsafe { generated("service", package, "srv", name) }
}

/// # Safety
/// Type supports of this kind are of the type `T`.
unsafe fn generated<T>(kind: &str, package: &str, folder: &str, name: &str) -> Result<*const T> {
    // SAFETY: a library of constants, never unloaded; the caller's word.
    unsafe {
        let library = Library::new(format!("lib{package}__rosidl_typesupport_c.so"))?;
        let library = Box::leak(Box::new(library));
        let symbol =
            format!("rosidl_typesupport_c__get_{kind}_type_support_handle__{package}__{folder}__{name}");
        Ok(library.get::<unsafe extern "C" fn() -> *const T>(symbol.as_bytes())?())
    }
}

/// `message_type_support_callbacks_t` of rosidl_typesupport_fastrtps_cpp, a header of C++.
#[repr(C)]
struct Callbacks {
    namespace: *const c_char,
    name: *const c_char,
    serialize: extern "C" fn(*const c_void, *mut c_void) -> bool,
    deserialize: extern "C" fn(*mut c_void, *mut c_void) -> bool,
    size: extern "C" fn(*const c_void) -> u32,
    longest: extern "C" fn(*mut c_char) -> usize,
    key: *const c_void,
}

/// `ROSIDL_TYPESUPPORT_FASTRTPS_PLAIN_TYPE`.
const PLAIN: c_char = 3;
const CDR: &CStr = c"rosidl_typesupport_fastrtps_c";
const INTROSPECTION: &CStr = c"rosidl_typesupport_introspection_c";
/// Of `rosidl_typesupport_introspection_c`, and of descriptions; there with 48 more if it is an array of fixed length.
const UINT8: u8 = 8;
const DESCRIBED_UINT8_ARRAY: u8 = 3 + 48;

/// What there is to know of the one such type of a process.
struct Bytes {
    len: usize,
    hash: rosidl_type_hash_t,
    description: rosidl_runtime_c__type_description__TypeDescription,
    cdr: rosidl_message_type_support_t,
    introspection: rosidl_message_type_support_t,
}

// SAFETY: pointers to what is leaked, and never written again.
unsafe impl Send for Bytes {}
// SAFETY: as above.
unsafe impl Sync for Bytes {}

static BYTES: OnceLock<Bytes> = OnceLock::new();

/// `uint8[LEN] data`, to be lent: nothing of it can be serialized. One length for a process.
pub fn bytes(len: usize) -> Result<*const rosidl_message_type_support_t> {
    let schema = Schema::from_text(&"tautline_bench/msg/Bytes".parse()?, &format!("uint8[{len}] data"))?;
    let hash = schema.hash().to_string();
    let digits = hash.strip_prefix("RIHS01_").ok_or("a hash of another version")?;
    let mut value = [0; 32];
    for (byte, at) in value.iter_mut().zip((0..).step_by(2)) {
        *byte = u8::from_str_radix(&digits[at..at + 2], 16)?;
    }
    let support = |identifier: &CStr, data: *const c_void| rosidl_message_type_support_t {
        typesupport_identifier: identifier.as_ptr(),
        data,
        func: Some(find),
        get_type_hash_func: Some(hash_of),
        get_type_description_func: Some(description_of),
        get_type_description_sources_func: None,
    };
    let made = BYTES.get_or_init(|| Bytes {
        len,
        hash: rosidl_type_hash_t { version: 1, value },
        description: description(len),
        cdr: support(CDR, callbacks()),
        introspection: support(INTROSPECTION, members(len)),
    });
    if made.len == len { Ok(&made.cdr) } else { Err("one length for a process".into()) }
}

fn leaked<T>(value: T) -> *mut T {
    Box::leak(Box::new(value))
}

fn callbacks() -> *const c_void {
    extern "C" fn serialize(_: *const c_void, _: *mut c_void) -> bool {
        false
    }
    extern "C" fn deserialize(_: *mut c_void, _: *mut c_void) -> bool {
        false
    }
    extern "C" fn size(_: *const c_void) -> u32 {
        BYTES.get().map_or(0, |bytes| bytes.len as u32)
    }
    extern "C" fn longest(bounds: *mut c_char) -> usize {
        // SAFETY: a reference in C++.
        unsafe { *bounds = PLAIN };
        BYTES.get().map_or(0, |bytes| bytes.len)
    }
    let (namespace, name) = (c"tautline_bench::msg".as_ptr(), c"Bytes".as_ptr());
    leaked(Callbacks { namespace, name, serialize, deserialize, size, longest, key: std::ptr::null() })
        .cast_const()
        .cast()
}

/// As Fast DDS wants it, for types that are found by their fields.
fn members(len: usize) -> *const c_void {
    let field = rosidl_typesupport_introspection_c__MessageMember {
        name_: c"data".as_ptr(),
        type_id_: UINT8,
        is_array_: true,
        array_size_: len,
        ..Default::default()
    };
    leaked(rosidl_typesupport_introspection_c__MessageMembers {
        message_namespace_: c"tautline_bench__msg".as_ptr(),
        message_name_: c"Bytes".as_ptr(),
        member_count_: 1,
        size_of_: len,
        members_: leaked(field),
        ..Default::default()
    })
    .cast_const()
    .cast()
}

fn description(len: usize) -> rosidl_runtime_c__type_description__TypeDescription {
    let text = |text: &'static CStr| rosidl_runtime_c__String {
        data: text.as_ptr().cast_mut(),
        size: text.count_bytes(),
        capacity: text.count_bytes() + 1,
    };
    let field = rosidl_runtime_c__type_description__Field {
        name: text(c"data"),
        type_: rosidl_runtime_c__type_description__FieldType {
            type_id: DESCRIBED_UINT8_ARRAY,
            capacity: len as u64,
            ..Default::default()
        },
        ..Default::default()
    };
    rosidl_runtime_c__type_description__TypeDescription {
        type_description: rosidl_runtime_c__type_description__IndividualTypeDescription {
            type_name: text(c"tautline_bench/msg/Bytes"),
            fields: rosidl_runtime_c__type_description__Field__Sequence {
                data: leaked(field),
                size: 1,
                capacity: 1,
            },
        },
        ..Default::default()
    }
}

/// # Safety
/// As rosidl's: `identifier` is text.
unsafe extern "C" fn find(
    _: *const rosidl_message_type_support_t,
    identifier: *const c_char,
) -> *const rosidl_message_type_support_t {
    // SAFETY: the caller's word.
    let (identifier, bytes) = (unsafe { CStr::from_ptr(identifier) }, BYTES.get());
    match bytes {
        Some(bytes) if identifier == CDR => &bytes.cdr,
        Some(bytes) if identifier == INTROSPECTION => &bytes.introspection,
        _ => std::ptr::null(),
    }
}

unsafe extern "C" fn hash_of(_: *const rosidl_message_type_support_t) -> *const rosidl_type_hash_t {
    BYTES.get().map_or(std::ptr::null(), |bytes| &bytes.hash)
}

unsafe extern "C" fn description_of(
    _: *const rosidl_message_type_support_t,
) -> *const rosidl_runtime_c__type_description__TypeDescription {
    BYTES.get().map_or(std::ptr::null(), |bytes| &bytes.description)
}
