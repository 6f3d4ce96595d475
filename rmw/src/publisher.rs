// SPDX-License-Identifier: MIT OR Apache-2.0
//! Publishers: ROS's struct is written into shared memory once, or loaned there from the start.

use crate::bindings::*;
use crate::cdr::{Callbacks, Length};
use crate::error::{Error, Result};
use crate::event::{Happened, Sources};
use crate::handle::{exported, gid_to_ros, handle};
use crate::node::NodeOfEndpoint;
use crate::on_new::Listeners;
use crate::qos::{self, EndpointRole};
use crate::serialization::little_body;
use crate::system::Timer;
use crate::topic::EndpointArgs;
use crate::types::MessageType;
use std::ffi::{c_char, c_void};
use std::sync::Arc;
use std::time::Duration;
use tautline_rt::clock::monotonic_ns;
use tautline_rt::{PiGuard, PiMutex};
use tautline_sampler::PublisherEvents;
use tautline_transport::{Gid, MatchedCount, PublishError, RawLoan, RawPublisher};

pub(crate) struct Publisher {
    pub(crate) events: Sources,
    happened: Arc<Happened>,
    node: NodeOfEndpoint,
    message_type: MessageType,
    qos: rmw_qos_profile_t,
    gid: Gid,
    matched: MatchedCount,
    /// Endpoints of this context whose callbacks are called after publishing.
    listeners: Arc<Listeners>,
    /// The timer of the system file whose runs are recognised by this publisher's messages.
    timer: Option<Timer>,
    /// Used by one thread at a time.
    side: PiMutex<Publishing>,
}

handle!(rmw_publisher_t, Publisher, "the publisher");

struct Publishing {
    /// Loans of `raw` that ROS writes in place; dropped before it, under the lock.
    loans: Vec<RawLoan<'static>>,
    /// Boxed, so that it does not move while loans exist.
    raw: Box<RawPublisher>,
}

// SAFETY: a loan is not Send, because it refers to its publisher, which one thread at a time may use. They move together.
unsafe impl Send for Publishing {}

impl Publishing {
    /// Takes back the loan at `message`.
    fn take_back(&mut self, message: *const c_void) -> Result<RawLoan<'static>> {
        let at = self.loans.iter().position(|loan| loan.as_ptr().cast() == message);
        let at = at.ok_or_else(|| Error::invalid("the message is not on loan from this publisher"))?;
        Ok(self.loans.swap_remove(at))
    }
}

/// How long a keep-all publisher waits for room, as with DDS.
const FULL_NS: u64 = 100_000_000;
/// Interval of retries.
const LOOK: Duration = Duration::from_micros(200);

impl Drop for Publisher {
    fn drop(&mut self) {
        self.happened.close();
    }
}

impl Publisher {
    pub(crate) fn listen(&self) -> Result {
        self.node.check_process()?;
        let helper = &self.node.context().helper;
        let events = || Ok(PublisherEvents::new(helper.events(), &self.side.lock().raw)?);
        self.happened.listen(helper, events)
    }

    /// Publishes a message of at most `len_bytes`, whose length `write` returns.
    ///
    /// # Real-time
    /// Like [`RawPublisher::loan`] of a publisher that claims memory on use, and [`RawLoan::publish`]: once the maximum of
    /// samples has been in flight, no allocation and no syscall except futex wakes. Waits for another thread in this publisher,
    /// which inherits this thread's priority. A keep-all publisher waits up to 100 ms for room; others may publish meanwhile. Then as
    /// [`Listeners::notify`].
    fn publish(&self, len_bytes: usize, write: impl FnOnce(&mut [u8]) -> Result<usize>) -> Result {
        self.node.check_process()?;
        let side = self.side.lock();
        let mut loan = side.raw.loan(len_bytes)?;
        let written = write(&mut loan)?;
        loan.truncate(written);
        // SAFETY: used under the lock of this publisher.
        let loan = unsafe { detached(loan) };
        self.publish_loan(side, loan)
    }

    /// Publishes a loan, and calls the callbacks for it.
    fn publish_loan<'p>(&'p self, side: PiGuard<'p, Publishing>, loan: RawLoan<'static>) -> Result {
        self.submit(side, loan)?;
        if let Some(timer) = &self.timer {
            timer.publish();
        }
        self.listeners.notify();
        Ok(())
    }

    /// Publishes a loan; a keep-all publisher waits for room. Others may use the publisher meanwhile.
    fn submit<'p>(&'p self, mut side: PiGuard<'p, Publishing>, loan: RawLoan<'static>) -> Result {
        let mut unpublished = match loan.publish() {
            Ok(()) => return Ok(()),
            Err(unpublished) => unpublished,
        };
        let give_up_ns = monotonic_ns().saturating_add(FULL_NS);
        while matches!(unpublished.error, PublishError::Full) && monotonic_ns() < give_up_ns {
            drop(side);
            std::thread::sleep(LOOK);
            side = self.side.lock();
            unpublished = match unpublished.loan.publish() {
                Ok(()) => return Ok(()),
                Err(unpublished) => unpublished,
            };
        }
        let code = if matches!(unpublished.error, PublishError::Full) { RET_TIMEOUT } else { RET_BAD_ALLOC };
        let error = Error::new(code, unpublished.to_string());
        // The loan is returned under the lock.
        drop(unpublished);
        drop(side);
        Err(error)
    }

    /// Lends ROS memory for a message to write in place.
    fn lend(&self) -> Result<*mut c_void> {
        let Length::Plain(len_bytes) = self.message_type.length else {
            return Err(Error::unsupported("this type cannot be loaned: its layout differs from CDR"));
        };
        self.node.check_process()?;
        let mut side = self.side.lock();
        // The memory holds zeros or an earlier message of this publisher, so a valid message of this type: clearing it would take
        // as long as a copy.
        let mut loan = side.raw.loan(len_bytes)?;
        let message = loan.as_mut_ptr().cast();
        // SAFETY: it is stored beside its publisher, under the lock.
        let loan = unsafe { detached(loan) };
        side.loans.push(loan);
        Ok(message)
    }
}

/// Detaches a loan from its publisher's lifetime.
///
/// # Safety
/// It is used and dropped under the lock of its publisher, which is boxed and outlives it: see [`Publishing`].
unsafe fn detached(loan: RawLoan<'_>) -> RawLoan<'static> {
    // SAFETY: the caller's contract.
    unsafe { std::mem::transmute::<RawLoan<'_>, RawLoan<'static>>(loan) }
}

/// Checks that a loan is requested with the topic's type.
///
/// # Safety
/// `support` is null or a type support.
unsafe fn check_support(support: *const rosidl_message_type_support_t, publisher: &Publisher) -> Result {
    // SAFETY: the caller's contract.
    match unsafe { Callbacks::find(support)? } == publisher.message_type.callbacks {
        true => Ok(()),
        false => Err(Error::invalid(format!(
            "the type is not {}, the topic's type",
            publisher.message_type.name()
        ))),
    }
}

exported! {
    fn rmw_borrow_loaned_message(
        publisher: *const rmw_publisher_t => behind,
        support: *const rosidl_message_type_support_t,
        message: *mut *mut c_void => place "the message",
    ) {
        if !message.is_null() {
            return Err(Error::invalid("the message is not null"));
        }
        // SAFETY: rmw's contract.
        unsafe { check_support(support, publisher)? };
        *message = publisher.lend()?;
        Ok(())
    }

    fn rmw_return_loaned_message_from_publisher(
        publisher: *const rmw_publisher_t => behind,
        message: *mut c_void => present "the message",
    ) {
        publisher.node.check_process()?;
        publisher.side.lock().take_back(message).map(drop)
    }

    fn rmw_publish_loaned_message(
        publisher: *const rmw_publisher_t => behind,
        message: *mut c_void => present "the message",
        _allocation: *mut rmw_publisher_allocation_t,
    ) {
        publisher.node.check_process()?;
        let mut side = publisher.side.lock();
        let mut loan = side.take_back(message)?;
        publisher.message_type.tidy(&mut loan);
        publisher.publish_loan(side, loan)
    }

    fn rmw_create_publisher(
        node: *const rmw_node_t,
        support: *const rosidl_message_type_support_t,
        topic: *const c_char,
        profile: *const rmw_qos_profile_t,
        options: *const rmw_publisher_options_t => given "the options",
    ) -> *mut rmw_publisher_t {
        let flows = options.require_unique_network_flow_endpoints;
        // SAFETY: rmw's contract.
        let asked = unsafe { EndpointArgs::new(node, support, topic, profile, flows)? };
        let wanted = asked.qos(EndpointRole::Publisher)?;
        let EndpointArgs { node, message_type, name, profile } = asked;
        let _node = tautline_trace::in_node(node.traced.id());
        let (of, limits) = (&message_type.topic_type, message_type.limits());
        let raw = node.participant.create_raw_publisher(name, of, wanted, limits)?;
        let happened = Arc::<Happened>::default();
        let publisher = Publisher {
            events: Sources::new(&happened, node.context()),
            happened,
            node: node.into(),
            message_type,
            qos: qos::to_ros(&wanted, profile.avoid_ros_namespace_conventions),
            gid: raw.gid(),
            matched: raw.matched(),
            listeners: node.context().listeners.of(name),
            timer: node.context().system.timer(&node.full_name, name)?,
            side: PiMutex::new(Publishing { loans: Vec::new(), raw: Box::new(raw) }),
        };
        let can_loan_messages = publisher.message_type.is_plain();
        node.hand_out(name, publisher, |handle: &mut rmw_publisher_t| {
            (handle.options, handle.can_loan_messages) = (*options, can_loan_messages);
        })
    }

    fn rmw_destroy_publisher(node: *mut rmw_node_t => behind, publisher: *mut rmw_publisher_t) {
        // SAFETY: rmw's contract.
        unsafe { node.destroy(publisher) }
    }

    fn rmw_publish(
        publisher: *const rmw_publisher_t => behind,
        message: *const c_void => present "the message",
        _allocation: *mut rmw_publisher_allocation_t,
    ) {
        let MessageType { callbacks, length, .. } = publisher.message_type;
        if let Length::Plain(len_bytes) = length {
            return publisher.publish(len_bytes, |body| {
                // SAFETY: rmw's contract: a message of this type, whose struct begins with its body.
                unsafe { body.as_mut_ptr().copy_from_nonoverlapping(message.cast(), body.len()) };
                publisher.message_type.tidy(body);
                Ok(body.len())
            });
        }
        // SAFETY: rmw's contract: a message of this type.
        let estimate = unsafe { callbacks.estimate(message)? };
        // SAFETY: as above.
        publisher.publish(estimate, |body| unsafe { callbacks.write(message, body) })
    }

    fn rmw_publish_serialized_message(
        publisher: *const rmw_publisher_t => behind,
        message: *const rmw_serialized_message_t => given "the serialized message",
        _allocation: *mut rmw_publisher_allocation_t,
    ) {
        // SAFETY: rmw's contract.
        let body = unsafe { little_body(message, &publisher.message_type)? };
        publisher.publish(body.len(), |loan| {
            tautline_rt::copy_to_shared(loan, &body);
            Ok(body.len())
        })
    }

    fn rmw_publisher_count_matched_subscriptions(
        publisher: *const rmw_publisher_t => behind,
        count: *mut usize => place "the count",
    ) {
        *count = publisher.matched.get();
        Ok(())
    }

    fn rmw_publisher_get_actual_qos(
        publisher: *const rmw_publisher_t => behind,
        profile: *mut rmw_qos_profile_t => place "the QoS profile",
    ) {
        *profile = publisher.qos;
        Ok(())
    }

    fn rmw_publisher_assert_liveliness(publisher: *const rmw_publisher_t => behind) {
        publisher.node.check_process()?;
        publisher.side.lock().raw.assert_liveliness();
        Ok(())
    }

    /// Messages are in the queues of subscriptions when `rmw_publish` returns.
    fn rmw_publisher_wait_for_all_acked(_publisher: *const rmw_publisher_t => behind, _timeout: rmw_time_t) {
        Ok(())
    }

    fn rmw_get_gid_for_publisher(
        publisher: *const rmw_publisher_t => behind,
        gid: *mut rmw_gid_t => place "the gid",
    ) {
        *gid = gid_to_ros(publisher.gid);
        Ok(())
    }
}
