// SPDX-License-Identifier: MIT OR Apache-2.0
//! Types of services, found at run time. rmw carries services as C structs, not as bytes. The package's own functions create the
//! structs, and rmw converts between them and CDR. No type is compiled in.

use super::error::{RclError, check};
use super::serialized::SerializedMessage;
use super::type_support::{InstalledType, TypeSupportError, find, load_library, message_handle};
use libloading::Library;
use r2r_rcl::*;
use std::ffi::c_void;
use std::sync::Arc;

/// The type support of a service. Clones share it.
#[derive(Clone)]
pub struct ServiceSupport {
    raw: *const rosidl_service_type_support_t,
    request: StructSupport,
    response: StructSupport,
    hash: Option<String>,
    _libraries: [Arc<Library>; 2],
}

/// Support of the request or the response.
#[derive(Clone, Copy)]
struct StructSupport {
    raw: *const rosidl_message_type_support_t,
    create: unsafe extern "C" fn() -> *mut c_void,
    destroy: unsafe extern "C" fn(*mut c_void),
}

// SAFETY: constant data and functions of libraries that stay loaded.
unsafe impl Send for ServiceSupport {}
// SAFETY: as above.
unsafe impl Sync for ServiceSupport {}

impl ServiceSupport {
    /// Finds the service `name`, such as `std_srvs/srv/SetBool` or `test_msgs/action/Fibonacci_SendGoal`, in `AMENT_PREFIX_PATH`.
    ///
    /// # Errors
    /// [`TypeSupportError`].
    pub fn load(name: &str) -> Result<Self, TypeSupportError> {
        let InstalledType { package, full, library: support, unknown } = find(name, "srv")?;
        let (structs, _) = load_library(package, "rosidl_generator_c")?;
        type Get = unsafe extern "C" fn() -> *const rosidl_service_type_support_t;
        let symbol = format!("rosidl_typesupport_c__get_service_type_support_handle__{full}");
        // SAFETY: rosidl generates functions of this name and type; they return constant data of the library.
        let raw = unsafe { support.get::<Get>(symbol.as_bytes()).map_err(|_| unknown.clone())?() };
        let part = |part: &str| {
            let full = format!("{full}_{part}");
            // SAFETY: as above, for each of the three names.
            unsafe { StructSupport::load(&full, &support, &structs) }.ok_or_else(|| unknown.clone())
        };
        let (request, response) = (part("Request")?, part("Response")?);
        // SAFETY: as above; the library's function takes the handle itself.
        let hash = unsafe {
            let raw = raw.as_ref().ok_or(unknown)?;
            let hash = raw.get_type_hash_func.and_then(|get| get(raw).as_ref());
            hash.and_then(|hash| super::graph::hash_text(hash.version, &hash.value))
        };
        Ok(ServiceSupport { raw, request, response, hash, _libraries: [support, structs] })
    }

    /// `RIHS01_...`, of the installed definition.
    pub fn hash(&self) -> Option<&str> {
        self.hash.as_deref()
    }

    /// A request, to be filled in.
    ///
    /// # Errors
    /// [`RclError`]: out of memory.
    pub fn new_request(&self) -> Result<RosStruct, RclError> {
        RosStruct::new(self.request, self)
    }

    /// A response, to be filled in.
    ///
    /// # Errors
    /// [`RclError`]: out of memory.
    pub fn new_response(&self) -> Result<RosStruct, RclError> {
        RosStruct::new(self.response, self)
    }

    pub(crate) fn raw(&self) -> *const rosidl_service_type_support_t {
        self.raw
    }
}

impl StructSupport {
    /// # Safety
    /// rosidl generated both libraries for the type `full`.
    unsafe fn load(full: &str, support: &Library, structs: &Library) -> Option<Self> {
        // SAFETY: the caller guarantees that functions of these names have these types.
        unsafe {
            let raw = message_handle(support, full)?;
            let create = *structs.get(format!("{full}__create").as_bytes()).ok()?;
            let destroy = *structs.get(format!("{full}__destroy").as_bytes()).ok()?;
            Some(StructSupport { raw, create, destroy })
        }
    }
}

/// A request or response as a C struct.
pub struct RosStruct {
    raw: *mut c_void,
    support: StructSupport,
    _service: ServiceSupport,
}

// SAFETY: it owns its memory, from the default allocator.
unsafe impl Send for RosStruct {}

impl RosStruct {
    fn new(support: StructSupport, service: &ServiceSupport) -> Result<Self, RclError> {
        // SAFETY: returns an initialised struct, or null.
        let raw = unsafe { (support.create)() };
        if raw.is_null() {
            let (what, reason) = ("making a struct", "out of memory".to_owned());
            return Err(RclError { what, code: RCL_RET_BAD_ALLOC as i32, reason });
        }
        Ok(RosStruct { raw, support, _service: service.clone() })
    }

    /// Reads the struct from CDR with encapsulation.
    ///
    /// # Errors
    /// [`RclError`]: the bytes are not valid for the type. The struct is valid nevertheless.
    pub fn deserialize(&mut self, bytes: &SerializedMessage) -> Result<(), RclError> {
        // SAFETY: the struct has the type of the support; rmw reads the bytes.
        check("reading a message", unsafe { rmw_deserialize(bytes.raw(), self.support.raw, self.raw) })
    }

    /// Writes the struct as CDR with encapsulation.
    ///
    /// # Errors
    /// [`RclError`]: out of memory.
    pub fn serialize(&self, bytes: &mut SerializedMessage) -> Result<(), RclError> {
        // SAFETY: as above; rmw grows the buffer with its own allocator.
        check("writing a message", unsafe { rmw_serialize(self.raw, self.support.raw, bytes.raw_mut()) })
    }

    pub(crate) fn raw(&self) -> *const c_void {
        self.raw
    }

    pub(crate) fn raw_mut(&mut self) -> *mut c_void {
        self.raw
    }
}

impl Drop for RosStruct {
    fn drop(&mut self) {
        // SAFETY: created by `create`, and exclusive.
        unsafe { (self.support.destroy)(self.raw) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(name: &str) -> String {
        ServiceSupport::load(name).err().unwrap().to_string()
    }

    #[test]
    fn what_is_missing_is_named_with_its_fix() {
        for name in ["", "SetBool", "std_srvs/SetBool", "std_srvs/msg/SetBool", "std_srvs/srv/"] {
            assert!(message(name).contains("write package/srv/Name"), "{name}");
        }
        assert!(message("no_such_srvs/srv/A").contains("ros-$ROS_DISTRO-no-such-srvs"));
        let unknown = message("std_srvs/srv/SetBoole");
        assert!(unknown.contains("no srv 'SetBoole'"), "{unknown}");
    }

    #[test]
    fn hashes_are_those_of_the_definitions() {
        let mut packages = tautline_schema::Packages::from_env();
        for name in
            ["std_srvs/srv/SetBool", "test_msgs/srv/BasicTypes", "test_msgs/action/Fibonacci_GetResult"]
        {
            let schema = packages.schema(&name.parse().unwrap()).unwrap();
            let support = ServiceSupport::load(name).unwrap();
            assert_eq!(support.hash(), Some(&*schema.hash().to_string()), "{name}");
        }
    }

    #[test]
    fn bytes_go_through_the_struct() {
        let support = ServiceSupport::load("std_srvs/srv/SetBool").unwrap();
        let mut response = support.new_response().unwrap();
        let mut bytes = SerializedMessage::new().unwrap();
        // success, padding, a string of 3 with its NUL
        let body = [1, 0, 0, 0, 4, 0, 0, 0, b'y', b'e', b's', 0];
        bytes.assign(&[0, 1, 0, 0], &body).unwrap();
        response.deserialize(&bytes).unwrap();
        let mut again = SerializedMessage::new().unwrap();
        response.serialize(&mut again).unwrap();
        let again = &again.bytes()[4..];
        assert_eq!((again[0], &again[4..12]), (1, &body[4..]));
        // Truncated, and with a false length.
        for body in [&body[..9], &[1, 0, 0, 0, 255, 255, 255, 127, b'y']] {
            bytes.assign(&[0, 1, 0, 0], body).unwrap();
            assert!(response.deserialize(&bytes).is_err());
        }
        response.serialize(&mut bytes).unwrap();
    }
}
