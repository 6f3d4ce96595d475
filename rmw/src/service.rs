// SPDX-License-Identifier: MIT OR Apache-2.0
//! Servers of services.

use crate::bindings::*;
use crate::end::{End, Port};
use crate::error::{Error, Result, answer, made};
use crate::handle::{IDENTIFIER, behind, copy_text, free_text, place, take_back, text};
use crate::node::{Node, check_full_name};
use crate::qos::{self, Role};
use crate::subscription::received_ns;
use crate::types::ServiceSupport;
use std::ffi::{c_char, c_void};
use std::sync::Arc;
use tautline_transport::{
    Gid, History, MessageInfo, Qos, RawSample, RawServer, RawSubscription, RequestId, ServiceError, TakeError,
};

pub(crate) struct Service {
    node: *const Node,
    of: ServiceSupport,
    qos: rmw_qos_profile_t,
    depth: Depth,
    end: Arc<End<RawServer>>,
}

impl Port for RawServer {
    const IS_TOPIC: bool = false;

    fn subscription(&self) -> &RawSubscription {
        self.requests()
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        self.end.close();
    }
}

impl Service {
    fn node(&self) -> &Node {
        // SAFETY: rmw's word: a node lives longer than what is its.
        unsafe { &*self.node }
    }

    /// The end, whose requests wake who waits.
    pub(crate) fn end(&self) -> &End<RawServer> {
        &self.end
    }

    /// Tells the client that there is no answer. One of rmw_tautline's has nothing to do with it.
    fn refuse(&self, raw: &RawServer, request: &RawSample, reason: &str) {
        let refused = raw.refuse(RequestId::of(request.info()));
        let failure = refused.map_or_else(|error| format!("; {error}"), |()| String::new());
        tracing::warn!("a request to service '{}' was refused, for {reason}{failure}", raw.service());
    }
}

/// What services and clients agree on.
pub(crate) fn profile_of(profile: *const rmw_qos_profile_t) -> Result<Qos> {
    // SAFETY: rmw's word.
    let profile = unsafe { profile.as_ref() }.ok_or_else(|| Error::null("the QoS profile"))?;
    qos::from_ros(profile, Role::Service, std::iter::empty())
}

/// A service's name, which keeps the rules unless the profile says that it need not.
///
/// # Safety
/// As rmw says.
pub(crate) unsafe fn name_of<'n>(name: *const c_char, profile: *const rmw_qos_profile_t) -> Result<&'n str> {
    // SAFETY: the caller's word.
    let (read, profile) = unsafe { (text(name, "the service's name")?, profile.as_ref()) };
    if read.is_empty() {
        return Err(Error::invalid("the service's name is empty"));
    }
    if !profile.is_some_and(|profile| profile.avoid_ros_namespace_conventions) {
        // SAFETY: the caller's word.
        unsafe { check_full_name(name, "the service's name")? };
    }
    Ok(read)
}

/// What is kept of requests or responses that come faster than they are taken.
#[derive(Clone, Copy)]
pub(crate) struct Depth {
    /// How many can be in the queue, from each client or server.
    pub(crate) room: usize,
    /// How many of all are still there for who takes, if the profile says so.
    kept: u64,
}

impl Depth {
    /// Room for a burst, which costs nothing before it is used.
    pub(crate) const ROOM: usize = 1_000;
    /// What services and clients ask for whose programmer did not say: of the clients of a service, that many would lose requests.
    const DEFAULT: usize = 10;

    /// Of an end with this profile, which has been checked, and what was made of it. Fewer than by default is a wish; as many, or more,
    /// is the least that are kept.
    ///
    /// # Safety
    /// As rmw says.
    pub(crate) unsafe fn of(profile: *const rmw_qos_profile_t, qos: &Qos) -> Self {
        // SAFETY: the caller's word.
        let is_wish =
            unsafe { profile.as_ref() }.is_some_and(|asked| (1..Self::DEFAULT).contains(&asked.depth));
        let kept = if is_wish && qos.history == History::KeepLast { qos.depth as u64 } else { u64::MAX };
        Depth { room: qos.depth.max(Self::ROOM), kept }
    }

    /// Takes the oldest that is kept. `lose` gets those before it.
    ///
    /// # Real-time
    /// As `take`, at most as often as something waited.
    pub(crate) fn take(
        self,
        queue: &RawSubscription,
        take: impl Fn() -> std::result::Result<Option<RawSample>, TakeError>,
        lose: impl Fn(RawSample),
    ) -> std::result::Result<Option<RawSample>, TakeError> {
        let mut oldest = take()?;
        for _ in self.kept..queue.waiting().saturating_add(1) {
            if queue.waiting() < self.kept {
                break;
            }
            let Ok(Some(next)) = take() else { break };
            oldest.replace(next).into_iter().for_each(&lose);
        }
        Ok(oldest)
    }
}

/// What tells a request or a response apart.
pub(crate) fn info_of(info: MessageInfo) -> rmw_service_info_t {
    rmw_service_info_t {
        source_timestamp: info.source_timestamp_ns,
        received_timestamp: received_ns(&info),
        request_id: rmw_request_id_t {
            writer_guid: info.publisher_gid.0,
            sequence_number: i64::try_from(info.sequence_number).unwrap_or(i64::MAX),
        },
    }
}

/// # Safety
/// As rmw says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_create_service(
    node: *const rmw_node_t,
    support: *const rosidl_service_type_support_t,
    name: *const c_char,
    profile: *const rmw_qos_profile_t,
) -> *mut rmw_service_t {
    made(|| {
        // SAFETY: rmw's word.
        let (node, of, name) = unsafe {
            let node = behind(node)?;
            (node, ServiceSupport::of(support)?, name_of(name, profile)?)
        };
        let wanted = profile_of(profile)?;
        // SAFETY: rmw's word.
        let depth = unsafe { Depth::of(profile, &wanted) };
        let raw =
            node.participant.create_raw_server(name, &of.service_type, depth.room, of.response.limits())?;
        let service =
            Service { node, of, qos: qos::to_ros(&wanted, false), depth, end: End::new(node, raw)? };
        let service_name = copy_text(name)?;
        // SAFETY: rmw's own memory, written before anybody sees it.
        unsafe {
            let handle = rmw_service_allocate();
            if handle.is_null() {
                free_text(service_name);
                return Err(Error::new(RET_BAD_ALLOC, "no memory for a service"));
            }
            handle.write(rmw_service_t {
                implementation_identifier: IDENTIFIER.as_ptr(),
                data: Box::into_raw(Box::new(service)).cast(),
                service_name,
            });
            Ok(handle)
        }
    })
}

/// # Safety
/// As rmw says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_destroy_service(node: *mut rmw_node_t, handle: *mut rmw_service_t) -> rmw_ret_t {
    answer(|| {
        // SAFETY: rmw's word; checked to be ours, so made above.
        unsafe {
            behind(node)?;
            behind(handle)?;
            drop(take_back::<Service>((*handle).data));
            free_text((*handle).service_name);
            rmw_service_free(handle);
        }
        Ok(())
    })
}

/// # Safety
/// As rmw says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_take_request(
    handle: *const rmw_service_t,
    header: *mut rmw_service_info_t,
    request: *mut c_void,
    taken: *mut bool,
) -> rmw_ret_t {
    answer(|| {
        // SAFETY: rmw's word.
        let (service, header, taken) =
            unsafe { (behind(handle)?, place(header, "the header")?, place(taken, "taken")?) };
        if request.is_null() {
            return Err(Error::null("the request"));
        }
        *taken = false;
        // Too many held: the threads that are in a take make room.
        let oldest = service.end.take(|raw| {
            let late = |request: RawSample| {
                service.refuse(raw, &request, "newer ones wait than its depth has room for")
            };
            service.depth.take(raw.requests(), || raw.try_take(), late)
        });
        let Ok(Some(sample)) = oldest else { return Ok(()) };
        // SAFETY: rmw's word: a request of this type.
        if let Err(error) = unsafe { service.of.request.callbacks.read(sample.body(), true, request) } {
            let reason = format!("it is none of {}: {error:?}", service.of.service_type.request.name);
            service.end.with(|raw| service.refuse(raw, &sample, &reason));
            return Ok(());
        }
        *header = info_of(sample.info());
        service.end.begin(&sample.info());
        *taken = true;
        Ok(())
    })
}

/// # Safety
/// As rmw says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_send_response(
    handle: *const rmw_service_t,
    header: *mut rmw_request_id_t,
    response: *mut c_void,
) -> rmw_ret_t {
    answer(|| {
        // SAFETY: rmw's word.
        let (service, header) = unsafe { (behind(handle)?, place(header, "the header")?) };
        if response.is_null() {
            return Err(Error::null("the response"));
        }
        let sequence_number = u64::try_from(header.sequence_number)
            .map_err(|_| Error::invalid("the request's number is below zero"))?;
        let id = RequestId { client: Gid(header.writer_guid), sequence_number };
        let callbacks = service.of.response.callbacks;
        // SAFETY: rmw's word: a response of this type.
        let estimate = unsafe { callbacks.estimate(response)? };
        let sent = service.end.with(|raw| {
            let mut loan = raw.loan(id, estimate)?;
            // SAFETY: as above.
            let written = unsafe { callbacks.write(response, &mut loan) }.map_err(Failed::Write)?;
            loan.truncate(written);
            loan.send().map_err(|unsent| Failed::from(unsent.error))
        });
        match sent {
            // Who asked has gone: that is no error of the server's.
            Ok(()) | Err(Failed::Send(ServiceError::ClientGone { .. })) => Ok(()),
            Err(Failed::Send(
                error @ (ServiceError::ClientUnreachable { .. } | ServiceError::ResponsesFull { .. }),
            )) => Err(Error::new(RET_TIMEOUT, error.to_string())),
            Err(Failed::Send(error)) => Err(error.into()),
            Err(Failed::Write(error)) => Err(error),
        }
    })
}

/// Why a response was not sent.
enum Failed {
    Write(Error),
    Send(ServiceError),
}

impl From<ServiceError> for Failed {
    fn from(error: ServiceError) -> Self {
        Failed::Send(error)
    }
}

/// # Safety
/// As rmw says.
unsafe fn actual_qos(handle: *const rmw_service_t, profile: *mut rmw_qos_profile_t) -> rmw_ret_t {
    answer(|| {
        // SAFETY: rmw's word.
        let (service, profile) = unsafe { (behind(handle)?, place(profile, "the QoS profile")?) };
        *profile = service.qos;
        Ok(())
    })
}

/// # Safety
/// As rmw says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_service_request_subscription_get_actual_qos(
    handle: *const rmw_service_t,
    profile: *mut rmw_qos_profile_t,
) -> rmw_ret_t {
    // SAFETY: rmw's word.
    unsafe { actual_qos(handle, profile) }
}

/// # Safety
/// As rmw says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_service_response_publisher_get_actual_qos(
    handle: *const rmw_service_t,
    profile: *mut rmw_qos_profile_t,
) -> rmw_ret_t {
    // SAFETY: rmw's word.
    unsafe { actual_qos(handle, profile) }
}

/// # Safety
/// As rmw says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_service_set_on_new_request_callback(
    handle: *mut rmw_service_t,
    callback: rmw_event_callback_t,
    data: *const c_void,
) -> rmw_ret_t {
    answer(|| {
        // SAFETY: rmw's word.
        let service = unsafe { behind(handle)? };
        let helper = &service.node().context().helper;
        service.end.set_on_new(helper, callback.map(|function| (function, data)));
        Ok(())
    })
}
