// SPDX-License-Identifier: MIT OR Apache-2.0
//! Serialized messages: a CDR body behind four bytes of encapsulation.

use crate::bindings::*;
use crate::cdr::Callbacks;
use crate::error::{Error, Result};
use crate::handle::exported;
use crate::lend::give_back;
use crate::types::MessageType;
use std::borrow::Cow;
use std::ffi::c_void;
use tautline_schema::{DynamicMessage, Endian};

/// Plain CDR, little-endian.
const LITTLE: [u8; 4] = [0, 1, 0, 0];
/// Length of the encapsulation.
const HEADER_BYTES: usize = LITTLE.len();

/// The bytes of a serialized message.
///
/// # Safety
/// It is initialised.
unsafe fn bytes(message: &rmw_serialized_message_t) -> &[u8] {
    match message.buffer.is_null() {
        true => &[],
        // SAFETY: the caller's contract.
        false => unsafe { std::slice::from_raw_parts(message.buffer, message.buffer_length) },
    }
}

/// The body, and whether it is little-endian.
fn body<'b>(bytes: &'b [u8]) -> Result<(&'b [u8], bool)> {
    // Some writers put the length of trailing padding into the last bits of the header.
    let cut = |body: &'b [u8], added: u8| &body[..body.len().saturating_sub((added & 3).into())];
    match bytes {
        [0, 1, _, added, body @ ..] => Ok((cut(body, *added), true)),
        [0, 0, _, added, body @ ..] => Ok((cut(body, *added), false)),
        _ => Err(Error::other(
            "the serialized message is not plain CDR: it must begin with 00 00 or 00 01, and two bytes",
        )),
    }
}

/// The little-endian body of a serialized message of this type.
///
/// # Safety
/// It is initialised.
pub(crate) unsafe fn little_body<'m>(
    message: &'m rmw_serialized_message_t,
    of: &MessageType,
) -> Result<Cow<'m, [u8]>> {
    // SAFETY: the caller's contract.
    let (body, is_little) = body(unsafe { bytes(message) })?;
    if is_little {
        return Ok(Cow::Borrowed(body));
    }
    let message = DynamicMessage::from_body(&of.schema, body, Endian::Big).map_err(Error::other)?;
    Ok(Cow::Owned(message.to_body()))
}

/// Makes room for `len_bytes`, including the header, in memory that may be written to.
fn resize(message: &mut rmw_serialized_message_t, len_bytes: usize) -> Result {
    give_back(message);
    if message.buffer_capacity < len_bytes {
        // SAFETY: rmw's contract: initialised.
        if unsafe { rcutils_uint8_array_resize(message, len_bytes) } != RET_OK {
            return Err(Error::new(
                RET_BAD_ALLOC,
                format!("no memory for a serialized message of {len_bytes} bytes"),
            ));
        }
    }
    Ok(())
}

/// Writes a body behind its header.
pub(crate) fn write_serialized(body: &[u8], message: &mut rmw_serialized_message_t) -> Result {
    resize(message, HEADER_BYTES + body.len())?;
    // SAFETY: there is room.
    unsafe {
        message.buffer.copy_from_nonoverlapping(LITTLE.as_ptr(), HEADER_BYTES);
        message.buffer.add(HEADER_BYTES).copy_from_nonoverlapping(body.as_ptr(), body.len());
    }
    message.buffer_length = HEADER_BYTES + body.len();
    Ok(())
}

exported! {
    fn rmw_serialize(
        message: *const c_void => present "the message",
        support: *const rosidl_message_type_support_t,
        serialized: *mut rmw_serialized_message_t => place "the serialized message",
    ) {
        // SAFETY: rmw's contract.
        unsafe {
            let callbacks = Callbacks::find(support)?;
            let estimate = callbacks.estimate(message)?;
            resize(serialized, HEADER_BYTES + estimate)?;
            // Uninitialised memory must not become a slice.
            serialized.buffer.write_bytes(0, HEADER_BYTES + estimate);
            let all = std::slice::from_raw_parts_mut(serialized.buffer, HEADER_BYTES + estimate);
            let (header, body) = all.split_at_mut(HEADER_BYTES);
            header.copy_from_slice(&LITTLE);
            serialized.buffer_length = HEADER_BYTES + callbacks.write(message, body)?;
        }
        Ok(())
    }

    fn rmw_deserialize(
        serialized: *const rmw_serialized_message_t => given "the serialized message",
        support: *const rosidl_message_type_support_t,
        message: *mut c_void => present "the message",
    ) {
        // SAFETY: rmw's contract.
        unsafe {
            let (body, is_little) = body(bytes(serialized))?;
            Callbacks::find(support)?.read(body, is_little, message)
        }
    }
}
