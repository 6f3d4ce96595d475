// SPDX-License-Identifier: MIT OR Apache-2.0
//! The options of a context.

use crate::bindings::*;
use crate::distro;
use crate::error::{Error, Result, checked, without_text};
use crate::handle::{IDENTIFIER, check_allocator, check_initialised, check_zero, exported};
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
    let domain = match options.domain_id {
        DEFAULT_DOMAIN => 0,
        domain => u32::try_from(domain).ok().filter(|domain| *domain <= MAX_DOMAIN).ok_or_else(|| {
            Error::invalid(format!("domain {domain} does not exist: domains go from 0 to {MAX_DOMAIN}"))
        })?,
    };
    let of_others =
        std::env::var("TAUT_DOMAIN").ok().filter(|of| !of.is_empty() && *of != domain.to_string());
    if let Some(of_others) = of_others {
        tracing::warn!(
            "this context is in domain {domain}: ROS 2 reads ROS_DOMAIN_ID, not TAUT_DOMAIN, which is {of_others} here; set both to one number"
        );
    }
    Ok(domain)
}

/// Checks the code of copying or finalising options, which set the error text.
pub(crate) fn copied(code: rmw_ret_t) -> Result {
    checked(code, "copying the options")
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

exported! {
    fn rmw_init_options_init(
        options: *mut rmw_init_options_t => place "the options",
        allocator: rcutils_allocator_t,
    ) {
        // rcl calls this first.
        distro::check()?;
        check_allocator(&allocator)?;
        check_zero(options.implementation_identifier, "the options")?;
        // SAFETY: no conditions.
        *options = unsafe { rmw_get_zero_initialized_init_options() };
        options.implementation_identifier = IDENTIFIER.as_ptr();
        options.domain_id = DEFAULT_DOMAIN;
        options.allocator = allocator;
        Ok(())
    }

    fn rmw_init_options_copy(
        source: *const rmw_init_options_t => given "the source",
        destination: *mut rmw_init_options_t => place "the destination",
    ) {
        check_initialised(source.implementation_identifier, "the source")?;
        check_zero(destination.implementation_identifier, "the destination")?;
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
    }

    fn rmw_init_options_fini(options: *mut rmw_init_options_t => place "the options") {
        check_initialised(options.implementation_identifier, "the options")?;
        check_allocator(&options.allocator)?;
        // SAFETY: initialised.
        unsafe { finish(options) };
        Ok(())
    }
}
