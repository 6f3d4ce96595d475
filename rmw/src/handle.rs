// SPDX-License-Identifier: MIT OR Apache-2.0
//! The handles that ROS holds: structs of librmw with a pointer to our data.

use crate::bindings::*;
use crate::error::{Error, Result, checked};
use std::ffi::{CStr, c_char, c_int, c_void};
use tautline_transport::Gid;

/// `rmw_get_implementation_identifier`.
pub(crate) const IDENTIFIER: &CStr = c"rmw_tautline";

/// Checks that this implementation created `what`, which has this identifier.
pub(crate) fn check_identifier(identifier: *const c_char, what: &str) -> Result {
    if identifier == IDENTIFIER.as_ptr() {
        return Ok(());
    }
    // SAFETY: null, or a text of its implementation.
    let found = (!identifier.is_null()).then(|| unsafe { CStr::from_ptr(identifier) });
    if found == Some(IDENTIFIER) {
        return Ok(());
    }
    let found = found.map_or("none".into(), CStr::to_string_lossy);
    let text = format!("{what} was made by {found}, not by rmw_tautline");
    Err(Error::new(RET_INCORRECT_RMW_IMPLEMENTATION, text))
}

/// Like [`check_identifier`], for a struct that may be zero, as librmw's initialisers leave it.
pub(crate) fn check_initialised(identifier: *const c_char, what: &str) -> Result {
    if identifier.is_null() {
        return Err(Error::invalid(format!("{what}: not initialised")));
    }
    check_identifier(identifier, what)
}

/// Checks that a struct with this identifier is zero.
pub(crate) fn check_zero(identifier: *const c_char, what: &str) -> Result {
    let is_zero = identifier.is_null();
    if is_zero { Ok(()) } else { Err(Error::invalid(format!("{what}: initialised already"))) }
}

pub(crate) fn check_allocator(allocator: &rcutils_allocator_t) -> Result {
    let rcutils_allocator_t { allocate, deallocate, reallocate, zero_allocate, .. } = allocator;
    match (allocate, deallocate, reallocate, zero_allocate) {
        (Some(_), Some(_), Some(_), Some(_)) => Ok(()),
        _ => Err(Error::invalid("the allocator is not initialised")),
    }
}

/// A struct of librmw whose `data` points to a `Data`.
pub(crate) trait Handle {
    type Data: 'static;
    const WHAT: &'static str;
    fn identifier(&self) -> *const c_char;
    fn data(&self) -> *mut c_void;

    /// Checks that this implementation created it.
    fn check(&self) -> Result {
        check_identifier(self.identifier(), Self::WHAT)
    }
}

/// A publisher, subscription, service or client.
pub(crate) trait EndpointHandle: Handle + Default {
    /// Memory of librmw for a handle, or null.
    fn allocate() -> *mut Self;

    /// Writes the fields that all handles have.
    fn set(&mut self, data: *mut c_void, name: *const c_char);

    /// Takes the data out of the handle, which then belongs to no entity.
    fn take_data(&mut self) -> *mut c_void;

    /// Frees the handle and its text.
    ///
    /// # Safety
    /// The handle was allocated by librmw's function for its type, has its text from [`copy_text`], and is no longer used.
    unsafe fn free(handle: *mut Self);
}

macro_rules! endpoints {
    ($($handle:ty, $name:ident, $allocate:ident, $free:ident;)*) => {$(
        impl EndpointHandle for $handle {
            fn allocate() -> *mut Self {
                // SAFETY: no conditions.
                unsafe { $allocate() }
            }

            fn set(&mut self, data: *mut c_void, name: *const c_char) {
                (self.implementation_identifier, self.data, self.$name) = (IDENTIFIER.as_ptr(), data, name);
            }

            fn take_data(&mut self) -> *mut c_void {
                std::mem::replace(&mut self.data, std::ptr::null_mut())
            }

            unsafe fn free(handle: *mut Self) {
                // SAFETY: the caller's contract.
                unsafe {
                    free_text((*handle).$name);
                    $free(handle);
                }
            }
        }
    )*};
}

endpoints! {
    rmw_publisher_t, topic_name, rmw_publisher_allocate, rmw_publisher_free;
    rmw_subscription_t, topic_name, rmw_subscription_allocate, rmw_subscription_free;
    rmw_service_t, service_name, rmw_service_allocate, rmw_service_free;
    rmw_client_t, service_name, rmw_client_allocate, rmw_client_free;
}

/// Says which data a struct of librmw points to, and what it is called in errors.
macro_rules! handle {
    ($handle:ty, $data:ty, $what:literal) => {
        impl $crate::handle::Handle for $handle {
            type Data = $data;
            const WHAT: &'static str = $what;
            fn identifier(&self) -> *const std::ffi::c_char {
                self.implementation_identifier
            }
            fn data(&self) -> *mut std::ffi::c_void {
                self.data.cast()
            }
        }
    };
}
pub(crate) use handle;

/// The data of a handle.
///
/// # Safety
/// `handle` is null, or points to an entity that an RMW created and has not destroyed, or to a context that may be zero.
pub(crate) unsafe fn behind<'h, H: Handle>(handle: *const H) -> Result<&'h H::Data> {
    // SAFETY: the caller's contract.
    let handle = unsafe { given(handle, H::WHAT)? };
    handle.check()?;
    // SAFETY: it is ours, so the data has our type.
    unsafe { given(handle.data().cast(), H::WHAT) }
}

/// Takes back the data of our handle.
///
/// # Safety
/// It was created with `Box::into_raw`, and is no longer used.
pub(crate) unsafe fn take_back<T>(data: *mut c_void) -> Box<T> {
    // SAFETY: the caller's contract.
    unsafe { Box::from_raw(data.cast()) }
}

/// A pointer argument as a reference; an error if it is null.
///
/// # Safety
/// `value` is null or valid for reads.
pub(crate) unsafe fn given<'v, T>(value: *const T, what: &str) -> Result<&'v T> {
    // SAFETY: the caller's contract.
    unsafe { value.as_ref() }.ok_or_else(|| Error::null(what))
}

/// The address of a message; an error if it is null.
pub(crate) fn present<P: Copy + Default + PartialEq>(pointer: P, what: &str) -> Result<P> {
    if pointer == P::default() { Err(Error::null(what)) } else { Ok(pointer) }
}

/// A pointer to the place of a result, as a reference; an error if it is null.
///
/// # Safety
/// `place` is null or valid for writes.
pub(crate) unsafe fn place<'p, T>(place: *mut T, what: &str) -> Result<&'p mut T> {
    // SAFETY: the caller's contract.
    unsafe { place.as_mut() }.ok_or_else(|| Error::null(what))
}

/// A text argument.
///
/// # Safety
/// `text` is null, or NUL-terminated and lives as long as it is used.
pub(crate) unsafe fn text<'t>(text: *const c_char, what: &str) -> Result<&'t str> {
    if text.is_null() {
        return Err(Error::null(what));
    }
    // SAFETY: the caller's contract.
    let text = unsafe { CStr::from_ptr(text) };
    text.to_str().map_err(|_| Error::invalid(format!("{what} is not UTF-8")))
}

type Validate = unsafe extern "C" fn(*const c_char, *mut c_int, *mut usize) -> rmw_ret_t;
type Explain = unsafe extern "C" fn(c_int) -> *const c_char;

/// A name argument, checked by `validate`.
///
/// # Safety
/// As [`text`]. The same holds for the functions below.
unsafe fn valid_name<'t>(
    name: *const c_char,
    what: &str,
    validate: Validate,
    explain: Explain,
) -> Result<&'t str> {
    let (mut found, mut at) = (0, 0);
    // SAFETY: the caller's contract; the pointers are valid; the explanation is a constant, or null.
    let (read, explained) = unsafe {
        let read = text(name, what)?;
        checked(validate(name, &mut found, &mut at), "checking a name")?;
        let explained = explain(found);
        (read, (!explained.is_null()).then(|| CStr::from_ptr(explained).to_string_lossy()))
    };
    match explained {
        // Zero means valid.
        Some(reason) if found != 0 => Err(Error::invalid(format!("{what}: {reason} (at byte {at})"))),
        _ => Ok(read),
    }
}

pub(crate) unsafe fn node_name<'t>(name: *const c_char) -> Result<&'t str> {
    let (validate, explain) = (rmw_validate_node_name, rmw_node_name_validation_result_string);
    // SAFETY: the caller's contract.
    unsafe { valid_name(name, "the node's name", validate, explain) }
}

pub(crate) unsafe fn namespace<'t>(name: *const c_char) -> Result<&'t str> {
    let (validate, explain) = (rmw_validate_namespace, rmw_namespace_validation_result_string);
    // SAFETY: the caller's contract.
    unsafe { valid_name(name, "the namespace", validate, explain) }
}

/// The name of a topic or service.
pub(crate) unsafe fn full_name<'t>(name: *const c_char, what: &str) -> Result<&'t str> {
    let (validate, explain) = (rmw_validate_full_topic_name, rmw_full_topic_name_validation_result_string);
    // SAFETY: the caller's contract.
    unsafe { valid_name(name, what, validate, explain) }
}

/// Like [`full_name`], without ROS's rules if the profile disables them.
pub(crate) unsafe fn endpoint_name<'t>(
    name: *const c_char,
    what: &str,
    profile: &rmw_qos_profile_t,
) -> Result<&'t str> {
    // SAFETY: the caller's contract.
    match unsafe { text(name, what)? } {
        "" => Err(Error::invalid(format!("{what} is empty"))),
        name if profile.avoid_ros_namespace_conventions => Ok(name),
        // SAFETY: the caller's contract.
        _ => unsafe { full_name(name, what) },
    }
}

/// rmw's functions, as C calls them. `argument: type => check "what"` calls this module's `check`, whose result has the argument's name in the
/// body; "what" names it in the error. A body returns a result: nothing, or the entity that it creates.
macro_rules! exported {
    (@returned) => { rmw_ret_t };
    (@returned $made:ty) => { $made };
    (@run) => { $crate::error::answer };
    (@run $made:ty) => { $crate::error::made };
    ($($(#[$doc:meta])* fn $name:ident(
        $($argument:ident: $type:ty $(=> $check:ident $($what:literal)?)?),* $(,)?
    ) $(-> $made:ty)? $body:block)*) => {$(
        $(#[$doc])*
        /// # Safety
        /// As documented by rmw.
        #[unsafe(no_mangle)]
        pub unsafe extern "C" fn $name($($argument: $type),*) -> $crate::handle::exported!(@returned $($made)?) {
            $crate::handle::exported!(@run $($made)?)(|| {
                $($(
                    // SAFETY: rmw's contract: the argument is null or as its header says, until the function returns.
                    #[allow(unused_unsafe, reason = "some checks are safe")]
                    let $argument = unsafe { $crate::handle::$check($argument $(, $what)?)? };
                )?)*
                $body
            })
        }
    )*};
}
pub(crate) use exported;

/// A GID in ROS's struct, which is longer in some distributions.
pub(crate) fn gid_to_ros(Gid(bytes): Gid) -> rmw_gid_t {
    let mut gid = rmw_gid_t { implementation_identifier: IDENTIFIER.as_ptr(), ..rmw_gid_t::default() };
    gid.data[..bytes.len()].copy_from_slice(&bytes);
    gid
}

/// A copy of a text in rmw's memory, to be freed with [`free_text`].
pub(crate) fn copy_text(text: &str) -> Result<*const c_char> {
    let bytes = text.len();
    // SAFETY: room for the bytes below; `text` has no NUL, because it was NUL-terminated.
    unsafe {
        let copy = rmw_allocate(bytes + 1).cast::<u8>();
        if copy.is_null() {
            return Err(Error::new(RET_BAD_ALLOC, "no memory for a name"));
        }
        copy.copy_from_nonoverlapping(text.as_ptr(), bytes);
        copy.add(bytes).write(0);
        Ok(copy.cast())
    }
}

/// # Safety
/// Created by [`copy_text`], and no longer used.
pub(crate) unsafe fn free_text(text: *const c_char) {
    // SAFETY: the caller's contract.
    unsafe { rmw_free(text.cast_mut().cast()) };
}
