// SPDX-License-Identifier: MIT OR Apache-2.0
//! The options of a context.

use crate::bindings::*;
use crate::distro;
use crate::error::{Error, Result, answer, checked, without_text};
use crate::handle::{IDENTIFIER, check_identifier, place};
use tautline_transport::MAX_DOMAIN;

/// `RMW_DEFAULT_DOMAIN_ID`: rcl reads ROS_DOMAIN_ID before it calls this.
const DEFAULT_DOMAIN: usize = usize::MAX;

/// Checks whether the options can be met. Returns the domain.
pub(crate) fn check(options: &rmw_init_options_t) -> Result<u32> {
    if options.enclave.is_null() {
        return Err(Error::invalid("the options have no enclave"));
    }
    if options.security_options.enforce_security == RMW_SECURITY_ENFORCEMENT_ENFORCE {
        return Err(Error::unsupported(
            "ROS_SECURITY_STRATEGY=Enforce: rmw_tautline has no SROS 2. Files in /dev/shm are private to this user; between \
             hosts `taut gateway` has TLS. Unset ROS_SECURITY_ENABLE, or use another RMW",
        ));
    }
    distro::check_discovery(options)?;
    match options.domain_id {
        DEFAULT_DOMAIN => Ok(0),
        domain => u32::try_from(domain).ok().filter(|domain| *domain <= MAX_DOMAIN).ok_or_else(|| {
            Error::invalid(format!("domain {domain} does not exist: domains go from 0 to {MAX_DOMAIN}"))
        }),
    }
}

/// Checks the code of copying or finalising options, which set the error text.
pub(crate) fn copied(code: rmw_ret_t) -> Result {
    checked(code, "copying the options")
}

fn is_valid(allocator: &rcutils_allocator_t) -> bool {
    allocator.allocate.is_some()
        && allocator.deallocate.is_some()
        && allocator.reallocate.is_some()
        && allocator.zero_allocate.is_some()
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_init_options_init(
    options: *mut rmw_init_options_t,
    allocator: rcutils_allocator_t,
) -> rmw_ret_t {
    answer(|| {
        // rcl calls this first.
        distro::check()?;
        // SAFETY: rmw's contract.
        let options = unsafe { place(options, "the options")? };
        if !is_valid(&allocator) {
            return Err(Error::invalid("the allocator is not initialised"));
        }
        if !options.implementation_identifier.is_null() {
            return Err(Error::invalid("the options are initialised already"));
        }
        // SAFETY: no conditions.
        *options = unsafe { rmw_get_zero_initialized_init_options() };
        options.implementation_identifier = IDENTIFIER.as_ptr();
        options.domain_id = DEFAULT_DOMAIN;
        options.allocator = allocator;
        Ok(())
    })
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_init_options_copy(
    source: *const rmw_init_options_t,
    destination: *mut rmw_init_options_t,
) -> rmw_ret_t {
    answer(|| {
        // SAFETY: rmw's contract.
        let (source, destination) = unsafe {
            let source = source.as_ref().ok_or_else(|| Error::null("the source"))?;
            (source, place(destination, "the destination")?)
        };
        if source.implementation_identifier.is_null() {
            return Err(Error::invalid("the source is not initialised"));
        }
        check_identifier(source.implementation_identifier, "the source")?;
        if !destination.implementation_identifier.is_null() {
            return Err(Error::invalid("the destination is initialised already"));
        }
        let allocator = source.allocator;
        // SAFETY: the source is initialised; the destination is zero.
        unsafe {
            let mut copy = rmw_init_options_t {
                enclave: std::ptr::null_mut(),
                security_options: rmw_get_zero_initialized_security_options(),
                ..*source
            };
            let security =
                rmw_security_options_copy(&source.security_options, &allocator, &mut copy.security_options);
            let discovery = distro::copy_discovery(source, &mut copy);
            let copied = checked(security, "copying the security options").and(discovery).and_then(|()| {
                if source.enclave.is_null() {
                    return Ok(());
                }
                copy.enclave = rcutils_strdup(source.enclave, allocator);
                match copy.enclave.is_null() {
                    false => Ok(()),
                    true => Err(Error::new(RET_BAD_ALLOC, "no memory for the enclave")),
                }
            });
            if copied.is_err() {
                finish(&mut copy);
                return copied;
            }
            *destination = copy;
        }
        Ok(())
    })
}

/// Frees the memory of options.
///
/// # Safety
/// They are initialised.
unsafe fn finish(options: &mut rmw_init_options_t) {
    let allocator = options.allocator;
    // SAFETY: the caller's contract: each is initialised or zero.
    unsafe {
        if let Some(deallocate) = allocator.deallocate
            && !options.enclave.is_null()
        {
            deallocate(options.enclave.cast(), allocator.state);
        }
        without_text(|| {
            let _ = rmw_security_options_fini(&mut options.security_options, &allocator);
            distro::finish_discovery(options);
        });
        *options = rmw_get_zero_initialized_init_options();
    }
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_init_options_fini(options: *mut rmw_init_options_t) -> rmw_ret_t {
    answer(|| {
        // SAFETY: rmw's contract.
        let options = unsafe { place(options, "the options")? };
        if options.implementation_identifier.is_null() {
            return Err(Error::invalid("the options are not initialised"));
        }
        check_identifier(options.implementation_identifier, "the options")?;
        if !is_valid(&options.allocator) {
            return Err(Error::invalid("the allocator is not initialised"));
        }
        // SAFETY: initialised.
        unsafe { finish(options) };
        Ok(())
    })
}
