// SPDX-License-Identifier: MIT OR Apache-2.0
//! Guard conditions.

use crate::bindings::*;
use crate::error::{Error, Result};
use crate::handle::{IDENTIFIER, behind, exported, handle, take_back};
use crate::signal::Signal;
use std::sync::Arc;

/// A flag that any thread sets and wait sets wait for.
pub(crate) struct GuardCondition {
    pub(crate) signal: Arc<Signal>,
}

handle!(rmw_guard_condition_t, GuardCondition, "the guard condition");

/// Creates a guard condition for ROS.
pub(crate) fn create(context: *mut rmw_context_t, signal: Arc<Signal>) -> Result<*mut rmw_guard_condition_t> {
    // SAFETY: rmw's own memory, written before anyone can see it.
    unsafe {
        let handle = rmw_guard_condition_allocate();
        if handle.is_null() {
            return Err(Error::new(RET_BAD_ALLOC, "no memory for a guard condition"));
        }
        let data = Box::into_raw(Box::new(GuardCondition { signal })).cast();
        handle.write(rmw_guard_condition_t { implementation_identifier: IDENTIFIER.as_ptr(), data, context });
        Ok(handle)
    }
}

/// # Safety
/// Created by [`create`], and no longer used.
pub(crate) unsafe fn destroy(handle: *mut rmw_guard_condition_t) {
    // SAFETY: the caller's contract.
    unsafe {
        drop(take_back::<GuardCondition>((*handle).data));
        rmw_guard_condition_free(handle);
    }
}

exported! {
    fn rmw_create_guard_condition(context: *mut rmw_context_t) -> *mut rmw_guard_condition_t {
        // SAFETY: rmw's contract.
        unsafe { behind(context)? };
        create(context, Arc::default())
    }

    fn rmw_destroy_guard_condition(handle: *mut rmw_guard_condition_t) {
        // SAFETY: rmw's contract; checked to be ours.
        unsafe {
            behind(handle)?;
            destroy(handle);
        }
        Ok(())
    }

    /// May be called in a signal handler, unless it returns an error.
    fn rmw_trigger_guard_condition(guard: *const rmw_guard_condition_t => behind) {
        guard.signal.set();
        Ok(())
    }
}
