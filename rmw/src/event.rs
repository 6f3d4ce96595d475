// SPDX-License-Identifier: MIT OR Apache-2.0
//! QoS events: the helper receives an endpoint's events, adds them up, and wakes waits or calls callbacks.

use crate::bindings::*;
use crate::callback::{Call, EventCallback, Function};
use crate::context::{Context, Waiters};
use crate::distro::{self, *};
use crate::error::{Error, Result};
use crate::handle::{IDENTIFIER, check_identifier, check_zero, exported, given, present};
use crate::helper::Helper;
use crate::qos::policy_to_ros;
use crate::signal::Signal;
use futures::{Stream, StreamExt};
use std::ffi::c_void;
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use tautline_rt::PiMutex;
use tautline_sampler::{PublisherEvent, SubscriptionEvent};

/// Number of event kinds of publishers and subscriptions. Depending on the distribution, `RMW_EVENT_INVALID` comes after all or is 0.
const KINDS: usize = distro::LAST_EVENT as usize + 1;

/// The events of one endpoint, by kind.
#[derive(Default)]
pub(crate) struct Happened {
    kinds: [EventQueueSlot; KINDS],
    is_served: AtomicBool,
}

struct EventQueueSlot {
    /// Set while there is an event to take.
    signal: Signal,
    state: PiMutex<EventState>,
    callback: EventCallback,
}

impl Default for EventQueueSlot {
    fn default() -> Self {
        let (signal, callback) = Default::default();
        EventQueueSlot { signal, state: PiMutex::new(EventState::default()), callback }
    }
}

#[derive(Default)]
struct EventState {
    counts: Counts,
    /// Events since the last take for which no callback was called.
    untold: usize,
    /// Whether there was an event since the last take.
    is_untaken: bool,
}

/// Counts of an event of any kind: totals, and changes since the last take.
#[derive(Clone, Copy, Default)]
struct Counts {
    total: u64,
    total_change: u64,
    current: u64,
    current_change: i64,
    not_alive: u64,
    not_alive_change: i64,
    policy: rmw_qos_policy_kind_t,
}

/// The target of an `rmw_event_t`; its endpoint keeps it alive.
pub(crate) struct EventTarget {
    waiters: Arc<Waiters>,
    happened: Arc<Happened>,
    kind: usize,
}

impl EventTarget {
    fn slot(&self) -> Result<(rmw_event_type_t, &EventQueueSlot)> {
        let slot =
            self.happened.kinds.get(self.kind).ok_or_else(|| Error::invalid("unknown kind of event"))?;
        Ok((self.kind as rmw_event_type_t, slot))
    }
}

impl Happened {
    /// Makes the helper receive `events`, unless it does already. Without this an endpoint's events cost nothing.
    pub(crate) fn listen<S, E>(
        self: &Arc<Self>,
        helper: &Helper,
        events: impl FnOnce() -> Result<S>,
    ) -> Result
    where
        S: Stream<Item = E> + Send + 'static,
        E: Into<Event>,
    {
        if self.is_served.swap(true, Ordering::AcqRel) {
            return Ok(());
        }
        let events = events().inspect_err(|_| self.is_served.store(false, Ordering::Release))?;
        let happened = self.clone();
        helper.run(move || async move {
            let mut events = pin!(events);
            while let Some(event) = events.next().await {
                happened.add(event.into());
            }
        });
        Ok(())
    }

    /// Removes all callbacks: ROS destroys the endpoint.
    pub(crate) fn close(&self) {
        self.kinds.iter().for_each(|kind| kind.set_callback(None));
    }

    fn add(&self, Event { kind, counts }: Event) {
        let Some(kind) = self.kinds.get(kind as usize) else { return };
        let call = {
            let mut state = kind.state.lock();
            let before = state.counts;
            state.counts = Counts {
                total_change: before.total_change + counts.total_change,
                current_change: before.current_change + counts.current_change,
                not_alive_change: before.not_alive_change + counts.not_alive_change,
                ..counts
            };
            state.untold += 1;
            state.is_untaken = true;
            kind.begin(&mut state)
        };
        // The callback is called before the signal is set, so that a wait finds only events that were reported.
        if let Some((call, count)) = call {
            call.run(count);
        }
        let state = kind.state.lock();
        if state.is_untaken {
            kind.signal.set();
        }
    }
}

impl EventQueueSlot {
    /// Begins a call for unreported events, if a callback is set.
    fn begin(&self, state: &mut EventState) -> Option<(Call<'_>, usize)> {
        let call = self.callback.begin()?;
        Some((call, std::mem::take(&mut state.untold)))
    }

    /// Sets or removes the callback, and calls it for earlier events.
    fn set_callback(&self, function: Function) {
        self.callback.replace(function);
        self.callback.settle();
        let call = self.begin(&mut self.state.lock());
        if let Some((call, count)) = call {
            call.run(count);
        }
    }
}

/// An event of either kind of endpoint, with rmw's counts.
pub(crate) struct Event {
    kind: rmw_event_type_t,
    counts: Counts,
}

impl From<PublisherEvent> for Event {
    fn from(event: PublisherEvent) -> Self {
        match event {
            PublisherEvent::Matched(matched) => Event::matched(RMW_EVENT_PUBLICATION_MATCHED, matched),
            PublisherEvent::OfferedIncompatibleQos(qos) => {
                Event::incompatible(RMW_EVENT_OFFERED_QOS_INCOMPATIBLE, qos)
            }
            PublisherEvent::IncompatibleType(of) => {
                Event::total(RMW_EVENT_PUBLISHER_INCOMPATIBLE_TYPE, of.total_count, of.total_count_change)
            }
            PublisherEvent::OfferedDeadlineMissed(missed) => {
                Event::total(RMW_EVENT_OFFERED_DEADLINE_MISSED, missed.total_count, missed.total_count_change)
            }
            PublisherEvent::LivelinessLost(lost) => {
                Event::total(RMW_EVENT_LIVELINESS_LOST, lost.total_count, lost.total_count_change)
            }
            _ => Event { kind: RMW_EVENT_INVALID, counts: Counts::default() },
        }
    }
}

impl From<SubscriptionEvent> for Event {
    fn from(event: SubscriptionEvent) -> Self {
        match event {
            SubscriptionEvent::Matched(matched) => Event::matched(RMW_EVENT_SUBSCRIPTION_MATCHED, matched),
            SubscriptionEvent::RequestedIncompatibleQos(qos) => {
                Event::incompatible(RMW_EVENT_REQUESTED_QOS_INCOMPATIBLE, qos)
            }
            SubscriptionEvent::IncompatibleType(of) => {
                Event::total(RMW_EVENT_SUBSCRIPTION_INCOMPATIBLE_TYPE, of.total_count, of.total_count_change)
            }
            SubscriptionEvent::RequestedDeadlineMissed(missed) => Event::total(
                RMW_EVENT_REQUESTED_DEADLINE_MISSED,
                missed.total_count,
                missed.total_count_change,
            ),
            SubscriptionEvent::MessageLost(lost) => {
                Event::total(RMW_EVENT_MESSAGE_LOST, lost.total_count, lost.total_count_change)
            }
            SubscriptionEvent::LivelinessChanged(changed) => {
                let counts = Counts {
                    current: changed.alive_count,
                    current_change: changed.alive_count_change,
                    not_alive: changed.not_alive_count,
                    not_alive_change: changed.not_alive_count_change,
                    ..Counts::default()
                };
                Event { kind: RMW_EVENT_LIVELINESS_CHANGED, counts }
            }
            _ => Event { kind: RMW_EVENT_INVALID, counts: Counts::default() },
        }
    }
}

impl Event {
    fn total(kind: rmw_event_type_t, total: u64, total_change: u64) -> Self {
        Event { kind, counts: Counts { total, total_change, ..Counts::default() } }
    }

    fn matched(kind: rmw_event_type_t, matched: tautline_transport::Matched) -> Self {
        let counts = Counts {
            total: matched.total_count,
            total_change: matched.total_count_change,
            current: matched.current_count,
            current_change: matched.current_count_change,
            ..Counts::default()
        };
        Event { kind, counts }
    }

    fn incompatible(kind: rmw_event_type_t, qos: tautline_transport::IncompatibleQos) -> Self {
        let counts = Counts {
            total: qos.total_count,
            total_change: qos.total_count_change,
            policy: policy_to_ros(qos.last_policy_kind),
            ..Counts::default()
        };
        Event { kind, counts }
    }
}

/// The flag of an event in a wait set.
pub(crate) fn signal_of(event: &rmw_event_t) -> Option<&Signal> {
    // SAFETY: null, or set by `init`; the endpoint keeps the target alive.
    let target = unsafe { event.data.cast::<EventTarget>().as_ref() }?;
    target.slot().ok().map(|(_, slot)| &slot.signal)
}

/// The targets of an endpoint's events, one per kind: the endpoint owns them, because rmw does not free events.
pub(crate) struct Sources(Vec<EventTarget>);

impl Sources {
    pub(crate) fn new(happened: &Arc<Happened>, context: &Context) -> Self {
        let target =
            |kind| EventTarget { waiters: context.waiters.clone(), happened: happened.clone(), kind };
        Sources((0..KINDS).map(target).collect())
    }
}

/// Initialises `event` as one of an endpoint that supports `kinds`.
fn init(
    event: &mut rmw_event_t,
    sources: &Sources,
    kind: rmw_event_type_t,
    kinds: std::ops::RangeInclusive<rmw_event_type_t>,
) -> Result {
    check_zero(event.implementation_identifier, "the event")?;
    let source = sources.0.get(kind as usize).filter(|_| kinds.contains(&kind));
    let source = source.ok_or_else(|| {
        Error::unsupported(format!("event type {kind} is not supported by this kind of endpoint"))
    })?;
    *event = rmw_event_t {
        implementation_identifier: IDENTIFIER.as_ptr(),
        data: std::ptr::from_ref(source).cast_mut().cast(),
        event_type: kind,
    };
    Ok(())
}

/// # Safety
/// `info` is valid for the struct of `kind`.
unsafe fn write(kind: rmw_event_type_t, counts: &Counts, info: *mut c_void) {
    let number = |count: u64| i32::try_from(count).unwrap_or(i32::MAX);
    let change = |change: i64| i32::try_from(change).unwrap_or(i32::MAX);
    let (total_count, total_count_change) = (number(counts.total), number(counts.total_change));
    // SAFETY: the caller's contract.
    unsafe {
        match kind {
            RMW_EVENT_LIVELINESS_CHANGED => {
                info.cast::<rmw_liveliness_changed_status_t>().write(rmw_liveliness_changed_status_t {
                    alive_count: number(counts.current),
                    not_alive_count: number(counts.not_alive),
                    alive_count_change: change(counts.current_change),
                    not_alive_count_change: change(counts.not_alive_change),
                })
            }
            RMW_EVENT_REQUESTED_QOS_INCOMPATIBLE | RMW_EVENT_OFFERED_QOS_INCOMPATIBLE => {
                info.cast::<rmw_qos_incompatible_event_status_t>().write(
                    rmw_qos_incompatible_event_status_t {
                        total_count,
                        total_count_change,
                        last_policy_kind: counts.policy.max(RMW_QOS_POLICY_INVALID),
                    },
                );
            }
            RMW_EVENT_SUBSCRIPTION_MATCHED | RMW_EVENT_PUBLICATION_MATCHED => {
                info.cast::<rmw_matched_status_t>().write(rmw_matched_status_t {
                    total_count: counts.total as usize,
                    total_count_change: counts.total_change as usize,
                    current_count: counts.current as usize,
                    current_count_change: change(counts.current_change),
                });
            }
            RMW_EVENT_MESSAGE_LOST => {
                info.cast::<rmw_message_lost_status_t>().write(rmw_message_lost_status_t {
                    total_count: counts.total as usize,
                    total_count_change: counts.total_change as usize,
                })
            }
            // The remaining structs have equal fields.
            _ => info
                .cast::<rmw_liveliness_lost_status_t>()
                .write(rmw_liveliness_lost_status_t { total_count, total_count_change }),
        }
    }
}

/// The target of an event.
///
/// # Safety
/// As documented by rmw.
unsafe fn target_of<'s>(event: *const rmw_event_t) -> Result<&'s EventTarget> {
    // SAFETY: the caller's contract; what is ours has our data.
    unsafe {
        let event = given(event, "the event")?;
        check_identifier(event.implementation_identifier, "the event")?;
        given(event.data.cast(), "the event's data")
    }
}

/// Whether this kind of event is supported.
#[unsafe(no_mangle)]
pub extern "C" fn rmw_event_type_is_supported(kind: rmw_event_type_t) -> bool {
    kind != RMW_EVENT_INVALID && (kind as usize) < KINDS
}

exported! {
    fn rmw_publisher_event_init(
        event: *mut rmw_event_t => place "the event",
        publisher: *const rmw_publisher_t => behind,
        kind: rmw_event_type_t,
    ) {
        publisher.listen()?;
        init(event, &publisher.events, kind, RMW_EVENT_LIVELINESS_LOST..=LAST_EVENT)
    }

    fn rmw_subscription_event_init(
        event: *mut rmw_event_t => place "the event",
        subscription: *const rmw_subscription_t => behind,
        kind: rmw_event_type_t,
    ) {
        subscription.listen()?;
        init(event, &subscription.events, kind, RMW_EVENT_LIVELINESS_CHANGED..=LAST_SUBSCRIPTION_EVENT)
    }

    fn rmw_take_event(
        event: *const rmw_event_t,
        info: *mut c_void,
        taken: *mut bool => place "taken",
    ) {
        *taken = false;
        let info = present(info, "the event's information")?;
        // SAFETY: rmw's contract.
        let target = unsafe { target_of(event)? };
        target.waiters.check_process()?;
        let (kind, slot) = target.slot()?;
        let mut state = slot.state.lock();
        slot.signal.take();
        let counts = state.counts;
        (state.counts.total_change, state.counts.current_change, state.counts.not_alive_change) = (0, 0, 0);
        (state.untold, state.is_untaken) = (0, false);
        drop(state);
        // SAFETY: rmw's contract: the struct of this kind of event.
        unsafe { write(kind, &counts, info) };
        *taken = true;
        Ok(())
    }

    fn rmw_event_set_callback(event: *mut rmw_event_t, callback: rmw_event_callback_t, data: *const c_void) {
        // SAFETY: rmw's contract.
        let target = unsafe { target_of(event)? };
        match target.waiters.check_process() {
            // In a forked child nothing calls it.
            Err(_) if callback.is_none() => return Ok(()),
            checked => checked?,
        }
        let (_, slot) = target.slot()?;
        slot.set_callback(callback.map(|function| (function, data)));
        Ok(())
    }
}
