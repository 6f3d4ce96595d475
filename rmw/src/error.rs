// SPDX-License-Identifier: MIT OR Apache-2.0
//! Results of an RMW's functions: a code, and a text that rcutils stores.

use crate::bindings::*;
use std::any::Any;
use std::ffi::CString;
use std::panic::{AssertUnwindSafe, catch_unwind};
use tautline_system::SystemError;
use tautline_transport::{DoorbellError, LoanError, ServiceError, TransportError};

/// Why a call failed.
#[derive(Debug)]
pub(crate) struct Error {
    pub(crate) code: rmw_ret_t,
    text: String,
}

pub(crate) type Result<T = ()> = std::result::Result<T, Error>;

impl Error {
    pub(crate) fn new(code: rmw_ret_t, text: impl Into<String>) -> Self {
        Error { code, text: text.into() }
    }

    pub(crate) fn other(text: impl ToString) -> Self {
        Self::new(RET_ERROR, text.to_string())
    }

    pub(crate) fn invalid(text: impl Into<String>) -> Self {
        Self::new(RET_INVALID_ARGUMENT, text)
    }

    pub(crate) fn null(what: &str) -> Self {
        Self::invalid(format!("{what} is null"))
    }

    pub(crate) fn unsupported(text: impl Into<String>) -> Self {
        Self::new(RET_UNSUPPORTED, text)
    }

    fn set(&self) {
        let text = CString::new(self.text.replace('\0', " ")).unwrap_or_default();
        // SAFETY: NUL-terminated texts that outlive the call, which copies them.
        unsafe {
            rcutils_reset_error();
            rcutils_set_error_state(text.as_ptr(), c"rmw_tautline".as_ptr(), 0);
        }
    }
}

impl From<TransportError> for Error {
    fn from(error: TransportError) -> Self {
        let code = match &error {
            TransportError::Memory { .. } | TransportError::Doorbell(DoorbellError::Memory { .. }) => {
                RET_BAD_ALLOC
            }
            TransportError::TopicName { .. }
            | TransportError::ServiceName { .. }
            | TransportError::NodeName { .. }
            | TransportError::ZeroDuration { .. }
            | TransportError::LimitRange { .. } => RET_INVALID_ARGUMENT,
            _ => RET_ERROR,
        };
        Error::new(code, error.to_string())
    }
}

impl From<SystemError> for Error {
    fn from(error: SystemError) -> Self {
        Error::other(error)
    }
}

impl From<LoanError> for Error {
    fn from(error: LoanError) -> Self {
        let code = if error == LoanError::OutOfMemory { RET_BAD_ALLOC } else { RET_ERROR };
        Error::new(code, error.to_string())
    }
}

impl From<ServiceError> for Error {
    fn from(error: ServiceError) -> Self {
        match error {
            ServiceError::Loan { source, .. } => source.into(),
            error => Error::other(error),
        }
    }
}

/// Runs a function's body. A panic becomes an error.
fn guarded<T>(body: impl FnOnce() -> Result<T>) -> Result<T> {
    catch_unwind(AssertUnwindSafe(body)).unwrap_or_else(|panic| Err(Error::other(panic_text(&*panic))))
}

/// The text for a panic.
pub(crate) fn panic_text(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().copied();
    let text =
        text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("no reason given");
    format!("rmw_tautline has a defect, please report it: {text}")
}

/// Runs a function that returns a code.
pub(crate) fn answer(body: impl FnOnce() -> Result) -> rmw_ret_t {
    match guarded(body) {
        Ok(()) => RET_OK,
        Err(error) => {
            error.set();
            error.code
        }
    }
}

/// Runs a function that creates something; null if that failed.
pub(crate) fn made<T>(body: impl FnOnce() -> Result<*mut T>) -> *mut T {
    guarded(body).unwrap_or_else(|error| {
        error.set();
        std::ptr::null_mut()
    })
}

/// Runs code whose errors do not fail the call: resets their texts, but keeps an earlier one.
pub(crate) fn without_text<T>(body: impl FnOnce() -> T) -> T {
    // SAFETY: no conditions.
    let was_set = unsafe { rcutils_error_is_set() };
    let done = body();
    if !was_set {
        // SAFETY: no conditions.
        unsafe { rcutils_reset_error() };
    }
    done
}

/// Checks a code of librmw or librcutils, which set the text themselves.
pub(crate) fn checked(code: rmw_ret_t, what: &str) -> Result {
    if code == RET_OK { Ok(()) } else { Err(Error::new(code, format!("{what} failed"))) }
}
