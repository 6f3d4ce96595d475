// SPDX-License-Identifier: MIT OR Apache-2.0
//! Loans and samples of a type, written and read in shared memory.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::error::{BurstError, LoanError, PublishError, SendError, TakeError};
use crate::memory::header::MessageInfo;
use crate::topic::publisher::RawPublisher;
use crate::topic::publisher::hot::RawLoan;
use crate::topic::subscription::RawSubscription;
use crate::topic::subscription::hot::{PollBudget, RawSample};
use crate::topic::typed::{Codec, Decode, Publisher, Subscription};
use core::fmt;
use core::marker::PhantomData;
use core::mem::MaybeUninit;
use core::ops::{Deref, DerefMut};
use core::pin::Pin;
use core::task::{Context, Poll};
use futures::Stream;
use tautline_msgs::cdr::{DecodeError, FieldPath, Fill, WriteError, WriteFault, fill, sized_len};
use tautline_msgs::{Body, Message, Plain};

impl<T: Message> Publisher<T> {
    /// Loans a sample to write in place, as `&mut T`. Its content is a valid `T` but otherwise unspecified: zeros, or an
    /// earlier message of this publisher; write what the message needs.
    ///
    /// A loan must stay in its thread: a future that holds one across an `.await` is not `Send`, even if the loan was published
    /// before. Loan and publish in a separate block or function, or run the future with `Node::spawn_local`.
    ///
    /// # Real-time
    /// Like [`RawPublisher::loan`]: wait-free, O(subscriptions), and O(samples + returned samples) if the list of free samples is empty; no
    /// allocation; no syscall. For a type with bool, char or enum fields, O(number of these) to check that the memory holds a valid `T`.
    ///
    /// # Errors
    /// [`LoanError::Exhausted`]: `Limits::loans` loans are already in use.
    pub fn loan(&self) -> Result<Loan<'_, T>, LoanError>
    where
        T: Plain,
    {
        Loan::of_plain(&self.raw)
    }

    /// Loans a sample for a message of these lengths, to be [written](Unwritten::write) in place.
    ///
    /// # Real-time
    /// Like [`RawPublisher::loan`]: wait-free, O(subscriptions), and O(samples + returned samples) if the list of free samples is empty; no
    /// allocation; no syscall; linear in the number of fields and of elements with their own sizes. A message that is longer than
    /// `Limits::message_bytes` and than all messages before needs a larger segment: allocates, maps memory.
    ///
    /// # Errors
    /// [`LoanError`]: see [`RawPublisher::loan`](crate::RawPublisher::loan).
    pub fn loan_with<'s>(&self, sizes: T::Sizes<'s>) -> Result<Unwritten<'_, 's, T>, LoanError>
    where
        T: Fill,
    {
        Unwritten::of_sizes(&self.raw, sizes)
    }
}

impl<T: Codec> Publisher<T> {
    /// Writes `message` into a loan and publishes it.
    ///
    /// # Real-time
    /// As [`RawPublisher::loan`](crate::RawPublisher::loan) and [`Loan::publish`], and one copy of the message. Codecs other than Rust
    /// types have additional costs, which they document.
    ///
    /// # Errors
    /// [`PublishError`], or those of a codec other than a Rust type; nothing was sent.
    pub fn publish(&self, message: &T) -> Result<(), T::Error> {
        let loan = |len_bytes| self.raw.loan(len_bytes).map_err(|error| PublishError::from(error).into());
        let raw = message.encode_into(&self.definition, loan, T::Error::from)?;
        Ok(raw.publish().map_err(PublishError::from)?)
    }

    /// Writes each message into a loan and publishes it, in this order, and wakes each subscription once, when all are queued or one was not
    /// published. Returns how many there were. Messages for a keep-last subscription beyond its depth overwrite the oldest, which the
    /// subscription counts as lost; a keep-all publisher stops at the first one for which a queue has no room.
    ///
    /// ```
    /// # use tautline_transport::{Limits, Participant, Qos};
    /// # use tautline_ros_msgs::geometry_msgs::msg::Point;
    /// # let participant = Participant::new(123)?;
    /// # let (qos, limits) = (Qos::keep_last(10), Limits::default());
    /// # let subscription = participant.create_subscription::<Point>("/path", qos, limits)?;
    /// let publisher = participant.create_publisher::<Point>("/path", qos, limits)?;
    /// let path = [0.0, 0.5, 1.0].map(|x| Point { x, y: 0.0, z: 0.0 });
    /// assert_eq!(publisher.publish_many(&path)?, 3);
    /// # assert_eq!(subscription.try_take()?.unwrap().x, 0.0);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Real-time
    /// As [`publish`](Self::publish) for each message, but with one fence and one ring for all.
    ///
    /// # Errors
    /// [`BurstError`](crate::BurstError), with [`PublishError`] or what a codec other than a Rust type fails with: the messages before that
    /// one were published.
    pub fn publish_many<'m>(
        &self,
        messages: impl IntoIterator<Item = &'m T>,
    ) -> Result<usize, BurstError<T::Error>> {
        let loan = |len_bytes| self.raw.loan(len_bytes).map_err(|error| PublishError::from(error).into());
        self.raw.publish_each(messages, |message| message.encode_into(&self.definition, loan, T::Error::from))
    }

    /// Publishes a message in the form of the ROS 2 wire and of bags: the encapsulation header of 4 bytes, then the body. The bytes are
    /// checked to be a message of the type; padding appended by other middleware is removed. Big-endian messages are decoded and encoded
    /// again.
    ///
    /// # Real-time
    /// As [`publish`](Publisher::publish), and [`Message::view`]. Big-endian messages allocate their strings and
    /// sequences, and codecs other than Rust types for each message.
    ///
    /// # Errors
    /// [`PublishCdrError`](crate::PublishCdrError), or those of a codec other than a Rust type: with field and byte if the bytes are not a
    /// message of the type.
    pub fn publish_raw(&self, cdr: &[u8]) -> Result<(), T::CdrError> {
        T::publish_cdr(self, cdr)
    }
}

/// A sample for a message of stated lengths, not written yet. Dropping it returns the memory.
///
/// ```
/// # use tautline_transport::{Limits, Participant, Qos};
/// use tautline_ros_msgs::sensor_msgs::msg::{Image, ImageSizes};
///
/// # let participant = Participant::new(122)?;
/// # let (qos, limits) = (Qos::default(), Limits::default());
/// let subscription = participant.create_subscription::<Image>("/image", qos, limits)?;
/// let publisher = participant.create_publisher::<Image>("/image", qos, limits)?;
///
/// let sizes = ImageSizes { encoding: "mono8".len(), data: 640 * 480, ..ImageSizes::default() };
/// let loan = publisher.loan_with(sizes)?.write(|image| {
///     (image.height.set(480), image.width.set(640), image.step.set(640));
///     image.encoding.set("mono8")?;
///     image.data.slice_mut().fill(200); // in shared memory
///     image.default_rest();
///     Ok(())
/// })?;
/// loan.publish().expect("keep-last never refuses");
///
/// let sample = subscription.try_take()?.expect("it was just published");
/// let image = sample.view();
/// assert_eq!((image.encoding(), image.data().len()), ("mono8", 307_200)); // from shared memory
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// It cannot be published before it is written:
///
/// ```compile_fail,E0599
/// # use tautline_transport::Publisher;
/// # use tautline_ros_msgs::sensor_msgs::msg::{Image, ImageSizes};
/// fn send(publisher: Publisher<Image>) {
///     publisher.loan_with(ImageSizes::default()).unwrap().publish().unwrap();
/// }
/// ```
#[must_use = "nothing is sent before it is written and published"]
pub struct Unwritten<'p, 's, T: Message + Fill> {
    raw: RawLoan<'p>,
    sizes: T::Sizes<'s>,
}

impl<'p, 's, T: Message + Fill> Unwritten<'p, 's, T> {
    pub(crate) fn of_sizes(publisher: &'p RawPublisher, sizes: T::Sizes<'s>) -> Result<Self, LoanError> {
        let raw = publisher.loan(sized_len::<T>(sizes))?;
        Ok(Unwritten { raw, sizes })
    }

    /// Lets `write` set each field in place, and checks that no field was omitted. Parts of a sequence's `slice_mut`
    /// that it does not write contain zeros, or an earlier message of this publisher.
    ///
    /// # Real-time
    /// Wait-free but for `write`; no allocation; no syscall. Linear in the number of fields, and of bools in sequences and
    /// arrays.
    ///
    /// # Errors
    /// [`WriteError`]: a length over its bound, a field that was not set, an error of `write`. The loan is returned.
    pub fn write(
        mut self,
        write: impl for<'a> FnOnce(&mut T::Writer<'a, 's>) -> Result<(), WriteError>,
    ) -> Result<Loan<'p, T>, WriteError> {
        fill::<T>(self.sizes, &mut self.raw, write)?;
        // A `&mut T` will be given out, and safe code can have replaced a writer by one that writes elsewhere.
        let is_whole = |body: Body<'_>| T::view(body).is_ok();
        if T::PLAIN.is_some() && !Body::new(self.raw.payload(), self.raw.len()).is_ok_and(is_whole) {
            return Err(WriteError { type_name: T::TYPE_NAME, field: "", fault: WriteFault::Elsewhere });
        }
        Ok(Loan { raw: self.raw, _message: PhantomData })
    }
}

tautline_rt::debug_fields!([T: Message + Fill] Unwritten<'_, '_, T>, |this| body_bytes = this.raw.len());

/// A message in a loan, ready to be published; for a plain type it is a `&mut T` in shared memory. Dropping it returns
/// the memory without sending.
#[must_use = "nothing is sent before it is published"]
pub struct Loan<'p, T: Message> {
    /// If `T` is plain, its payload starts with a valid `T`.
    raw: RawLoan<'p>,
    _message: PhantomData<fn(T)>,
}

impl<'p, T: Message + Plain> Loan<'p, T> {
    pub(crate) fn of_plain(publisher: &'p RawPublisher) -> Result<Self, LoanError> {
        let mut raw = publisher.loan(T::CDR_SIZE)?;
        let memory = raw.payload_mut();
        if memory.len() < size_of::<T>() || memory.as_ptr().align_offset(align_of::<T>()) != 0 {
            return Err(LoanError::TooLarge);
        }
        // Only this publisher writes here, and only whole messages; zeros are a valid `T` too. Another process that broke
        // the rules must still not make an invalid `T`.
        if !T::ALWAYS_VALID && T::validate(memory).is_err() {
            memory.fill(0);
        }
        Ok(Loan { raw, _message: PhantomData })
    }
}

impl<'p, T: Message> Loan<'p, T> {
    /// Publishes the sample to every subscription. It never waits: a slow keep-last subscription loses its oldest
    /// sample and counts it; with a full keep-all subscription, and if this publisher keeps all, nothing is sent and the
    /// loan comes back.
    ///
    /// # Real-time
    /// As [`RawLoan::publish`]: wait-free, O(subscriptions); no allocation; at most one futex wake per sampler that sleeps, and per
    /// callback thread that sleeps and is woken directly; no other syscall.
    /// When subscriptions have appeared or disappeared since the last call: in addition O(subscriptions x samples / 64). For a
    /// plain type with padding between its fields, O(number of these) to zero it.
    ///
    /// # Errors
    /// [`SendError`], with the loan: nothing was sent.
    pub fn publish(self) -> Result<(), SendError<Loan<'p, T>>> {
        let published = self.into_raw().publish();
        published.map_err(|unpublished| unpublished.map(Loan::from_raw))
    }

    /// Publishes with a release time set by the caller, in `CLOCK_MONOTONIC` nanoseconds. Response times are
    /// measured from the release time, for example the time at which a periodic publisher should have woken.
    ///
    /// # Real-time and errors
    /// As [`publish`](Self::publish).
    pub fn publish_released_at(self, released_ns: u64) -> Result<(), SendError<Loan<'p, T>>> {
        let published = self.into_raw().publish_released_at(released_ns);
        published.map_err(|unpublished| unpublished.map(Loan::from_raw))
    }

    /// Publishes as soon as every keep-all subscription has room. Only one loan of a publisher may wait at a time: a second
    /// one replaces the first, which then waits until it is polled for another reason.
    ///
    /// # Real-time
    /// Each poll as [`publish`](Self::publish); woken through this process's sampler when a subscription has taken.
    ///
    /// # Errors
    /// As [`RawLoan::publish_when_ready`].
    pub async fn publish_when_ready(self) -> Result<(), PublishError> {
        self.into_raw().publish_when_ready().await
    }

    /// The message as bytes to send. A plain value's padding is zeroed, so that its former content is not sent.
    pub(crate) fn into_raw(mut self) -> RawLoan<'p> {
        let body_bytes = self.raw.len();
        let memory = self.raw.payload_mut();
        T::clear_gaps(memory);
        memory.get_mut(body_bytes..).unwrap_or_default().fill(0);
        self.raw
    }

    /// Converts the bytes of a message that was not sent back into a loan.
    pub(crate) fn from_raw(raw: RawLoan<'p>) -> Self {
        Loan { raw, _message: PhantomData }
    }
}

impl<T: Message + Plain> Deref for Loan<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        const { assert!(T::PLAIN.is_some(), "a plain type becomes a message by the derive") }
        // SAFETY: the payload starts with a valid T, at a multiple of 8: `loan` and `write` checked it, the latter through
        // `T::view`, of which `PLAIN` is the proof. Only whole `T`s were written there since.
        unsafe { &*self.raw.payload().as_ptr().cast() }
    }
}

impl<T: Message + Plain> DerefMut for Loan<'_, T> {
    fn deref_mut(&mut self) -> &mut T {
        const { assert!(T::PLAIN.is_some(), "a plain type becomes a message by the derive") }
        // SAFETY: as in deref; the loan is borrowed mutably and no subscription has it yet.
        unsafe { &mut *self.raw.payload_mut().as_mut_ptr().cast() }
    }
}

tautline_rt::debug_fields!([T: Message] Loan<'_, T>, |this| body_bytes = this.raw.len());

/// A message in shared memory, checked when it was taken: read in place through its [`view`](Sample::view); a sample of a
/// plain type derefs to `T`. A subscription lends at most `Limits::held` samples at once; they may be dropped in any
/// thread.
pub struct Sample<T: Decode> {
    /// Borrows from `raw`, whatever its lifetime says; given out only for as long as that is borrowed. `MaybeUninit`, though
    /// always set: passing a reference to a function promises that its memory stays as it is until that returns, but the
    /// memory goes back to its publisher when `raw` is dropped, maybe within.
    view: MaybeUninit<T::View<'static>>,
    raw: RawSample,
    definition: T::Definition,
}

impl<T: Decode> Sample<T> {
    /// Checks the bytes once.
    pub(crate) fn new(raw: RawSample, definition: &T::Definition) -> Result<Self, DecodeError> {
        let payload: *const [u8] = raw.payload();
        // SAFETY: the payload is mapped and unchanged as long as `raw` lives, wherever that moves. What borrows it is kept
        // beside `raw` and is not used after it.
        let payload: &'static [u8] = unsafe { &*payload };
        let (type_name, path) = (core::any::type_name::<T>(), FieldPath::EMPTY);
        let body = Body::new(payload, raw.body().len());
        let body = body.map_err(|fault| DecodeError { type_name, path, offset: 0, fault })?;
        let view = MaybeUninit::new(T::view(body)?);
        Ok(Sample { view, raw, definition: definition.clone() })
    }

    /// Reads the message in place: `&T` for a plain type, otherwise a view with getters. This costs nothing, because the
    /// message was checked when it was taken.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn view(&self) -> T::View<'_> {
        // SAFETY: set in `new`, and a view is Copy. It is given out for as long as `self`, and with it `raw`, is borrowed.
        T::shorten(unsafe { self.view.assume_init() })
    }

    /// The message as an owned value: allocates its strings and sequences.
    pub fn to_owned(&self) -> T::Owned {
        T::owned(&self.definition, self.view())
    }

    /// Sequence number, time stamps, publisher.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn info(&self) -> MessageInfo {
        self.raw.info()
    }
}

/// The sample's bytes.
impl<T: Decode> AsRef<RawSample> for Sample<T> {
    fn as_ref(&self) -> &RawSample {
        &self.raw
    }
}

/// Requires that the type's own derive, or generated code, made it a message: bytes that another [`Message::view`] accepts need not be a
/// `T`.
///
/// ```compile_fail,E0080
/// # use tautline_msgs::{Body, Definition, Message, cdr::DecodeError};
/// #[derive(Message, Clone, Copy)]
/// #[message(nested, crate = "tautline_msgs")]
/// #[repr(C)]
/// struct Flag {
///     raised: bool,
/// }
///
/// impl Message for Flag {
///     type View<'a> = ();
///     const TYPE_NAME: &'static str = "demo_msgs/msg/Flag";
///     const TYPE_HASH: Option<&'static str> = None;
///     const DEFINITION: Option<&'static Definition> = None;
///     const FIXED_LEN: Option<usize> = Some(1);
///     fn view(_: Body<'_>) -> Result<(), DecodeError> {
///         Ok(())
///     }
///     fn shorten<'short, 'long: 'short>((): ()) {}
///     fn owned((): ()) -> Self {
///         Flag { raised: false }
///     }
/// }
///
/// fn main() {
///     let read: fn(&tautline_transport::Sample<Flag>) -> bool = |sample| sample.raised;
///     std::hint::black_box(read);
/// }
/// ```
impl<T: Message + Plain> Deref for Sample<T> {
    type Target = T;

    fn deref(&self) -> &T {
        const { assert!(T::PLAIN.is_some(), "a plain type becomes a message by the derive") }
        // SAFETY: `T::view`, a message's own, accepted the payload in `new`, so that it starts with a valid `T`: `PLAIN` is the
        // proof. It stays where and as it is as long as `raw` lives.
        unsafe { &*self.raw.payload().as_ptr().cast() }
    }
}

/// Formats the message through its view.
impl<T: Decode> fmt::Debug for Sample<T>
where
    for<'a> T::View<'a>: fmt::Debug,
{
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.view().fmt(f)
    }
}

impl<T: Decode> Subscription<T> {
    /// Takes the oldest sample of a publisher, if there is one. Skips the same samples as [`RawSubscription::try_take`].
    ///
    /// # Real-time
    /// As [`RawSubscription::try_take`]. The message is checked: see [`Message::view`].
    ///
    /// # Errors
    /// [`TakeError`]. An invalid sample is consumed.
    ///
    /// [`RawSubscription::try_take`]: crate::RawSubscription::try_take
    pub fn try_take(&self) -> Result<Option<Sample<T>>, TakeError> {
        let Some(raw) = self.raw.try_take()? else { return Ok(None) };
        check(&self.raw, &self.definition, raw).map(Some).map_err(TakeError::Invalid)
    }

    /// Takes the oldest valid sample, if there is one. Invalid samples are counted and skipped, like those that
    /// [`try_take`](Self::try_take) skips: at most 16 of all kinds in one call. Refusals are counted.
    ///
    /// # Real-time
    /// Like [`try_take`](Self::try_take): the messages of at most 16 samples are checked.
    ///
    /// # Errors
    /// [`TakeError`], but not [`TakeError::Invalid`].
    pub fn try_take_valid(&self) -> Result<Option<Sample<T>>, TakeError> {
        take_valid(&self.raw, &self.definition, |_| ())
    }

    /// Polls for a sample. Registers the task before the check, so that a ring after the check wakes it.
    ///
    /// # Real-time
    /// Like [`try_take_valid`](Self::try_take_valid), but the task itself is woken: after 16 skipped samples other tasks of the
    /// thread get a turn.
    pub fn poll_take(&self, context: &mut Context<'_>) -> Poll<Option<Sample<T>>> {
        poll_take(&self.raw, &self.definition, context, |_| ())
    }
}

/// As [`Subscription::try_take_valid`]; calls `invalid` for each invalid sample.
pub(crate) fn take_valid<T: Decode>(
    raw: &RawSubscription,
    definition: &T::Definition,
    invalid: impl Fn(MessageInfo),
) -> Result<Option<Sample<T>>, TakeError> {
    let mut budget = PollBudget::new();
    while let Some(taken) = raw.take_valid(&mut budget)? {
        let info = taken.info();
        match check(raw, definition, taken) {
            Ok(sample) => return Ok(Some(sample)),
            Err(_) => invalid(info),
        }
    }
    raw.ring_if_spent(&budget);
    Ok(None)
}

/// As [`Subscription::poll_take`]; calls `invalid` for each invalid sample.
pub(crate) fn poll_take<T: Decode>(
    raw: &RawSubscription,
    definition: &T::Definition,
    context: &mut Context<'_>,
    invalid: impl Fn(MessageInfo),
) -> Poll<Option<Sample<T>>> {
    let mut budget = PollBudget::new();
    while let Some(taken) = std::task::ready!(raw.poll_within(context, &mut budget)) {
        let info = taken.info();
        match check(raw, definition, taken) {
            Ok(sample) => return Poll::Ready(Some(sample)),
            Err(_) => invalid(info),
        }
    }
    Poll::Ready(None)
}

fn check<T: Decode>(
    raw: &RawSubscription,
    definition: &T::Definition,
    taken: RawSample,
) -> Result<Sample<T>, DecodeError> {
    let checked = Sample::new(taken, definition);
    if checked.is_err() {
        raw.note_invalid();
    }
    checked
}

impl<T: Decode> Stream for Subscription<T> {
    type Item = Sample<T>;

    /// # Real-time
    /// As [`Subscription::try_take`]. Ends with its node, if it has one.
    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Sample<T>>> {
        (*self).poll_take(context)
    }
}
