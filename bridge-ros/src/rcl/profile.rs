// SPDX-License-Identifier: MIT OR Apache-2.0
//! The profile of the bridge's participant in Fast DDS, whose properties rmw_fastrtps does not set.

use super::context::rmw_implementation;
use super::error::RclError;
use libloading::Library;
use std::ffi::{c_char, c_void};

/// The library that links Fast DDS, in every version, and for both of its RMWs.
const LIBRARY: &str = "librmw_fastrtps_shared_cpp.so";
/// `DomainParticipantFactory::get_instance()` and `load_XML_profiles_string(const char *, size_t)`, of Fast DDS 2 and 3.
const GET_INSTANCE: &[u8] = b"_ZN8eprosima7fastdds3dds24DomainParticipantFactory12get_instanceEv\0";
const LOAD: &[u8] = b"_ZN8eprosima7fastdds3dds24DomainParticipantFactory24load_XML_profiles_stringEPKcm\0";

/// Keeps Fast DDS's participants that this process creates later from matching their own publishers and subscriptions: on a topic with
/// subscriptions on both sides, the bridge would get back each message that it sends to ROS. Not for a process with other nodes of ROS,
/// whose publishers and subscriptions would not match, either. A user's default profile takes precedence; other RMWs need nothing.
///
/// # Errors
/// [`RclError`]: this Fast DDS does not have the functions for it, or refuses the profile.
pub fn ignore_own_endpoints() -> Result<(), RclError> {
    if !rmw_implementation().starts_with("rmw_fastrtps") {
        return Ok(());
    }
    let error =
        |code, reason| RclError { what: "setting Fast DDS's fastdds.ignore_local_endpoints", code, reason };
    let profile = include_str!("fast_dds.xml");
    // SAFETY: the RMW, which has been loaded above, has loaded the library. Both functions have these signatures, with `this` first, in all versions that
    // have the symbols: `ReturnCode_t` is an integer, or a class of one that is passed as such. The factory lives as long as the process.
    let code = unsafe {
        let missing = |missing: libloading::Error| error(0, missing.to_string());
        let library = Library::new(LIBRARY).map_err(missing)?;
        let get_instance = library.get::<unsafe extern "C" fn() -> *mut c_void>(GET_INSTANCE);
        let load = library.get::<unsafe extern "C" fn(*mut c_void, *const c_char, usize) -> i32>(LOAD);
        load.map_err(missing)?(get_instance.map_err(missing)?(), profile.as_ptr().cast(), profile.len())
    };
    if code == 0 { Ok(()) } else { Err(error(code, "it refused the profile".to_owned())) }
}
