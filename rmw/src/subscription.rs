// SPDX-License-Identifier: MIT OR Apache-2.0
//! Subscriptions: messages are read from shared memory into ROS's struct, once.

use crate::bindings::*;
use crate::cdr::Length;
use crate::end::ReceivingEndpoint;
use crate::error::{Error, Result};
use crate::event::{Happened, Sources};
use crate::handle::{exported, gid_to_ros, handle, present};
use crate::lend::{LentCount, lend};
use crate::node::NodeOfEndpoint;
use crate::qos::{self, EndpointRole};
use crate::serialization::write_serialized;
use crate::topic::EndpointArgs;
use crate::types::{HELD, MessageType};
use std::ffi::{c_char, c_void};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use tautline_rt::PiMutex;
use tautline_sampler::SubscriptionEvents;
use tautline_schema::{DynamicMessage, Endian};
use tautline_transport::{MatchedCount, MessageInfo, RawSample, RawSubscription, TakeError};

pub(crate) struct Subscription {
    pub(crate) events: Sources,
    happened: Arc<Happened>,
    node: NodeOfEndpoint,
    message_type: MessageType,
    qos: rmw_qos_profile_t,
    /// The participant whose publications are ignored.
    ignored_participant: Option<u64>,
    matched: MatchedCount,
    /// Counts taken messages.
    received: AtomicU64,
    /// Loans that ROS reads in place.
    loans: PiMutex<Vec<RawSample>>,
    /// Whether `loans` has reached its limit; written together with it.
    is_full: AtomicBool,
    /// Serialized messages that are samples.
    lent: LentCount,
    end: Arc<ReceivingEndpoint<RawSubscription>>,
}

handle!(rmw_subscription_t, Subscription, "the subscription");

/// Maximum of invalid or ignored samples that one take skips; the subscription stays ready for the rest.
const PASSED_OVER: usize = 16;

impl Drop for Subscription {
    fn drop(&mut self) {
        self.end.close();
        self.happened.close();
    }
}

impl Subscription {
    /// The endpoint, whose messages wake wait sets.
    pub(crate) fn end(&self) -> &ReceivingEndpoint<RawSubscription> {
        &self.end
    }

    /// Whether there is a message to take, and room to hold it.
    pub(crate) fn has_data(&self) -> bool {
        !self.is_full.load(Ordering::Relaxed) && self.end.has_data()
    }

    pub(crate) fn listen(&self) -> Result {
        self.node.check_process()?;
        let helper = &self.node.context().helper;
        let events = || Ok(self.end.with(|raw| SubscriptionEvents::new(helper.events(), raw))?);
        self.happened.listen(helper, events)
    }

    /// Takes the next sample, and its message with `read`. Invalid messages are skipped and logged.
    fn take(&self, mut read: impl FnMut(RawSample) -> Result) -> Result<Option<rmw_message_info_t>> {
        self.node.check_process()?;
        for _ in 0..PASSED_OVER {
            let taken = self.end.take(RawSubscription::try_take);
            let sample = match taken {
                Ok(Some(sample)) => sample,
                // At the limit of held samples, the threads in a take will release some.
                Ok(None) | Err(TakeError::TooManyHeld) => return Ok(None),
                Err(TakeError::Invalid(error)) => {
                    self.warn(&error.to_string());
                    continue;
                }
            };
            if self.ignored_participant == Some(sample.port_gid().participant()) {
                continue;
            }
            let info = sample.info();
            match read(sample) {
                Ok(()) => {
                    let received_ns = self.end.begin(&info);
                    return Ok(Some(self.info(info, received_ns)));
                }
                // Not an error for the caller: executors would end, and any process can publish.
                Err(error) if error.code == RET_ERROR => self.warn(&format!("{error:?}")),
                Err(error) => return Err(error),
            }
        }
        Ok(None)
    }

    fn warn(&self, reason: &str) {
        let name = self.message_type.name();
        tracing::warn!("a message was dropped, because it is not a valid {name}: {reason}");
    }

    fn info(&self, info: MessageInfo, received_ns: i64) -> rmw_message_info_t {
        rmw_message_info_t {
            source_timestamp: info.source_timestamp_ns,
            received_timestamp: received_ns,
            publication_sequence_number: info.sequence_number,
            reception_sequence_number: self.received.fetch_add(1, Ordering::Relaxed) + 1,
            publisher_gid: gid_to_ros(info.publisher_gid),
            from_intra_process: false,
        }
    }

    /// # Safety
    /// `message` is null or a message of this type, initialised.
    unsafe fn take_message(&self, message: *mut c_void) -> Result<Option<rmw_message_info_t>> {
        let message = present(message, "the message")?;
        let MessageType { callbacks, length, .. } = self.message_type;
        self.take(|sample| {
            let body = sample.body();
            let Length::Plain(len_bytes) = length else {
                // SAFETY: the caller's contract.
                return unsafe { callbacks.read(body, true, message) };
            };
            self.check_plain(body, len_bytes)?;
            // SAFETY: the caller's contract: a struct of this type, which begins with this many bytes of the body.
            unsafe { message.cast::<u8>().copy_from_nonoverlapping(body.as_ptr(), len_bytes) };
            Ok(())
        })
    }

    /// Checks that a body is a valid struct in memory: long enough, and with valid bools.
    fn check_plain(&self, body: &[u8], len_bytes: usize) -> Result {
        if body.len() < len_bytes {
            return Err(Error::other(format!("it has {} bytes, not {len_bytes}", body.len())));
        }
        if !self.message_type.is_tidy(body) {
            // The error of `validate` names the field.
            DynamicMessage::validate(&self.message_type.schema, body, Endian::Little)
                .map_err(Error::other)?;
        }
        Ok(())
    }

    /// Takes a message that ROS reads in shared memory.
    fn take_loan(&self, message: &mut *mut c_void) -> Result<Option<rmw_message_info_t>> {
        if !message.is_null() {
            return Err(Error::invalid("the message is not null"));
        }
        let Length::Plain(len_bytes) = self.message_type.length else {
            return Err(Error::unsupported("this type cannot be loaned: its layout differs from CDR"));
        };
        self.take(|sample| {
            let body = sample.body();
            self.check_plain(body, len_bytes)?;
            *message = body.as_ptr().cast_mut().cast();
            let mut loans = self.loans.lock();
            loans.push(sample);
            self.is_full.store(loans.len() >= HELD, Ordering::Relaxed);
            Ok(())
        })
    }

    /// Takes a message as bytes.
    ///
    /// # Safety
    /// `message` is initialised.
    unsafe fn take_serialized(
        &self,
        message: &mut rmw_serialized_message_t,
    ) -> Result<Option<rmw_message_info_t>> {
        let own = self.node.participant.id();
        self.take(|sample| {
            // Samples of this participant's publishers are mapped for writing here, so they are copied.
            let is_own = sample.port_gid().participant() == own;
            // SAFETY: the caller's contract.
            match if is_own { Err(sample) } else { unsafe { lend(sample, message, &self.lent) } } {
                Ok(()) => Ok(()),
                Err(sample) => write_serialized(sample.body(), message),
            }
        })
    }
}

/// Writes whether a message was taken, and its information.
fn report_take(found: Option<rmw_message_info_t>, taken: &mut bool, info: Option<&mut rmw_message_info_t>) {
    *taken = found.is_some();
    if let (Some(found), Some(info)) = (found, info) {
        *info = found;
    }
}

exported! {
    fn rmw_take_loaned_message(
        subscription: *const rmw_subscription_t => behind,
        message: *mut *mut c_void => place "the message",
        taken: *mut bool => place "taken",
        _allocation: *mut rmw_subscription_allocation_t,
    ) {
        report_take(subscription.take_loan(message)?, taken, None);
        Ok(())
    }

    fn rmw_take_loaned_message_with_info(
        subscription: *const rmw_subscription_t => behind,
        message: *mut *mut c_void => place "the message",
        taken: *mut bool => place "taken",
        info: *mut rmw_message_info_t => place "the information",
        _allocation: *mut rmw_subscription_allocation_t,
    ) {
        report_take(subscription.take_loan(message)?, taken, Some(info));
        Ok(())
    }

    fn rmw_return_loaned_message_from_subscription(
        subscription: *const rmw_subscription_t => behind,
        message: *mut c_void => present "the message",
    ) {
        subscription.node.check_process()?;
        let mut loans = subscription.loans.lock();
        let at = loans.iter().position(|sample| sample.body().as_ptr().cast() == message.cast_const());
        let at = at.ok_or_else(|| Error::other("the message is not on loan from this subscription"))?;
        drop(loans.swap_remove(at));
        let is_room = subscription.is_full.swap(false, Ordering::Relaxed);
        drop(loans);
        if is_room {
            subscription.end.wake();
        }
        Ok(())
    }

    fn rmw_create_subscription(
        node: *const rmw_node_t,
        support: *const rosidl_message_type_support_t,
        topic: *const c_char,
        profile: *const rmw_qos_profile_t,
        options: *const rmw_subscription_options_t => given "the options",
    ) -> *mut rmw_subscription_t {
        let flows = options.require_unique_network_flow_endpoints;
        // SAFETY: rmw's contract.
        let asked = unsafe { EndpointArgs::new(node, support, topic, profile, flows)? };
        let mut wanted = asked.qos(EndpointRole::Subscription)?;
        let EndpointArgs { node, message_type, name, profile } = asked;
        node.context().system.set_depth(&node.full_name, name, &mut wanted);
        let _node = tautline_trace::in_node(node.traced.id());
        let (of, limits) = (&message_type.topic_type, message_type.limits());
        let raw = node.participant.create_raw_subscription(name, of, wanted, limits)?;
        let (happened, matched, can_loan_messages) =
            (Arc::<Happened>::default(), raw.matched(), message_type.is_plain());
        let subscription = Subscription {
            events: Sources::new(&happened, node.context()),
            happened,
            node: node.into(),
            message_type,
            qos: qos::to_ros(&wanted, profile.avoid_ros_namespace_conventions),
            ignored_participant: options.ignore_local_publications.then(|| node.participant.id()),
            matched,
            received: AtomicU64::new(0),
            loans: PiMutex::new(Vec::new()),
            is_full: AtomicBool::new(false),
            lent: LentCount::default(),
            end: ReceivingEndpoint::new(node, raw, node.context().listeners.of(name))?,
        };
        // The fields for content filters stay false.
        node.hand_out(name, subscription, |handle: &mut rmw_subscription_t| {
            (handle.options, handle.can_loan_messages) = (*options, can_loan_messages);
        })
    }

    fn rmw_destroy_subscription(node: *mut rmw_node_t => behind, subscription: *mut rmw_subscription_t) {
        // SAFETY: rmw's contract.
        unsafe { node.destroy(subscription) }
    }

    fn rmw_subscription_count_matched_publishers(
        subscription: *const rmw_subscription_t => behind,
        count: *mut usize => place "the count",
    ) {
        *count = subscription.matched.get();
        Ok(())
    }

    fn rmw_subscription_get_actual_qos(
        subscription: *const rmw_subscription_t => behind,
        profile: *mut rmw_qos_profile_t => place "the QoS profile",
    ) {
        *profile = subscription.qos;
        Ok(())
    }

    fn rmw_take(
        subscription: *const rmw_subscription_t => behind,
        message: *mut c_void,
        taken: *mut bool => place "taken",
        _allocation: *mut rmw_subscription_allocation_t,
    ) {
        // SAFETY: rmw's contract.
        report_take(unsafe { subscription.take_message(message)? }, taken, None);
        Ok(())
    }

    fn rmw_take_with_info(
        subscription: *const rmw_subscription_t => behind,
        message: *mut c_void,
        taken: *mut bool => place "taken",
        info: *mut rmw_message_info_t => place "the information",
        _allocation: *mut rmw_subscription_allocation_t,
    ) {
        // SAFETY: rmw's contract.
        report_take(unsafe { subscription.take_message(message)? }, taken, Some(info));
        Ok(())
    }

    fn rmw_take_sequence(
        subscription: *const rmw_subscription_t => behind,
        count: usize,
        messages: *mut rmw_message_sequence_t => place "the messages",
        infos: *mut rmw_message_info_sequence_t => place "the information",
        taken: *mut usize => place "taken",
        _allocation: *mut rmw_subscription_allocation_t,
    ) {
        if count == 0 || count > messages.capacity || count > infos.capacity {
            return Err(Error::invalid(format!(
                "{count} messages requested, room for {} messages and {} infos: request at least 1, at most the room",
                messages.capacity, infos.capacity
            )));
        }
        *taken = 0;
        while *taken < count {
            // SAFETY: rmw's contract: it has this capacity, and messages of this type.
            let found = unsafe { subscription.take_message(*messages.data.add(*taken)) };
            let info = match found {
                Ok(Some(info)) => info,
                Ok(None) => break,
                // Earlier messages of this call are kept.
                Err(_) if *taken > 0 => break,
                Err(error) => return Err(error),
            };
            // SAFETY: as above.
            unsafe { infos.data.add(*taken).write(info) };
            *taken += 1;
        }
        (messages.size, infos.size) = (*taken, *taken);
        Ok(())
    }

    fn rmw_take_serialized_message(
        subscription: *const rmw_subscription_t => behind,
        message: *mut rmw_serialized_message_t => place "the message",
        taken: *mut bool => place "taken",
        _allocation: *mut rmw_subscription_allocation_t,
    ) {
        // SAFETY: rmw's contract.
        report_take(unsafe { subscription.take_serialized(message)? }, taken, None);
        Ok(())
    }

    fn rmw_take_serialized_message_with_info(
        subscription: *const rmw_subscription_t => behind,
        message: *mut rmw_serialized_message_t => place "the message",
        taken: *mut bool => place "taken",
        info: *mut rmw_message_info_t => place "the information",
        _allocation: *mut rmw_subscription_allocation_t,
    ) {
        // SAFETY: rmw's contract.
        report_take(unsafe { subscription.take_serialized(message)? }, taken, Some(info));
        Ok(())
    }

    fn rmw_subscription_set_on_new_message_callback(
        subscription: *mut rmw_subscription_t => behind,
        callback: rmw_event_callback_t,
        data: *const c_void,
    ) {
        subscription.end.set_on_new(subscription.node.context(), callback, data)
    }
}
