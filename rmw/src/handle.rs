// SPDX-License-Identifier: MIT OR Apache-2.0
//! Handles in ROS's hands: structs of librmw with a pointer to our data.

use crate::bindings::*;
use crate::client::Client;
use crate::context::Context;
use crate::error::{Error, Result};
use crate::guard::GuardCondition;
use crate::node::Node;
use crate::publisher::Publisher;
use crate::service::Service;
use crate::subscription::Subscription;
use crate::wait::WaitSet;
use std::ffi::{CStr, c_char, c_void};
use tautline_transport::Gid;

/// `rmw_get_implementation_identifier`.
pub(crate) const IDENTIFIER: &CStr = c"rmw_tautline";

/// Checks that this implementation created something.
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

/// A struct of librmw whose `data` points to a `Data`.
pub(crate) trait Handle {
    type Data: 'static;
    const WHAT: &'static str;
    fn identifier(&self) -> *const c_char;
    fn data(&self) -> *mut c_void;
}

/// A publisher, subscription, service or client.
pub(crate) trait EndpointHandle: Handle {
    /// Takes the data out: the handle is then of no entity.
    fn take_data(&mut self) -> *mut c_void;

    /// Frees the handle and its text.
    ///
    /// # Safety
    /// It was allocated by librmw's function for it and has its text from [`copy_text`], and is no longer used.
    unsafe fn free(handle: *mut Self);
}

macro_rules! endpoints {
    ($($handle:ty, $name:ident, $free:ident;)*) => {$(
        impl EndpointHandle for $handle {
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
    rmw_publisher_t, topic_name, rmw_publisher_free;
    rmw_subscription_t, topic_name, rmw_subscription_free;
    rmw_service_t, service_name, rmw_service_free;
    rmw_client_t, service_name, rmw_client_free;
}

macro_rules! handles {
    ($($handle:ty, $data:ty, $what:literal;)*) => {$(
        impl Handle for $handle {
            type Data = $data;
            const WHAT: &'static str = $what;
            fn identifier(&self) -> *const c_char {
                self.implementation_identifier
            }
            fn data(&self) -> *mut c_void {
                self.data.cast()
            }
        }
    )*};
}

handles! {
    rmw_node_t, Node, "the node";
    rmw_publisher_t, Publisher, "the publisher";
    rmw_subscription_t, Subscription, "the subscription";
    rmw_service_t, Service, "the service";
    rmw_client_t, Client, "the client";
    rmw_guard_condition_t, GuardCondition, "the guard condition";
    rmw_wait_set_t, WaitSet, "the wait set";
}

/// The data of a handle.
///
/// # Safety
/// `handle` is null, or points to an entity that an RMW created and has not destroyed.
pub(crate) unsafe fn behind<'h, H: Handle>(handle: *const H) -> Result<&'h H::Data> {
    // SAFETY: the caller's contract.
    let handle = unsafe { handle.as_ref() }.ok_or_else(|| Error::null(H::WHAT))?;
    check_identifier(handle.identifier(), H::WHAT)?;
    // SAFETY: it is ours, so the data has our type.
    unsafe { handle.data().cast::<H::Data>().as_ref() }.ok_or_else(|| Error::null(H::WHAT))
}

/// The data of a context.
///
/// # Safety
/// As [`behind`].
pub(crate) unsafe fn behind_context<'h>(context: *const rmw_context_t) -> Result<&'h Context> {
    let what = "the context";
    // SAFETY: the caller's contract.
    let context = unsafe { context.as_ref() }.ok_or_else(|| Error::null(what))?;
    let is_none = || Error::invalid("the context has not been initialised, or was finalised");
    if context.implementation_identifier.is_null() {
        return Err(is_none());
    }
    check_identifier(context.implementation_identifier, what)?;
    // SAFETY: it is ours, so the data has our type.
    unsafe { context.impl_.cast::<Context>().as_ref() }.ok_or_else(is_none)
}

/// Takes back the data of our handle.
///
/// # Safety
/// It was created with `Box::into_raw`, and is no longer used.
pub(crate) unsafe fn take_back<T>(data: *mut c_void) -> Box<T> {
    // SAFETY: the caller's contract.
    unsafe { Box::from_raw(data.cast()) }
}

/// A pointer for a result.
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
