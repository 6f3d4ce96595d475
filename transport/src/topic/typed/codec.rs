// SPDX-License-Identifier: MIT OR Apache-2.0
//! How messages are written and read. A Rust type is its own codec, in place in shared memory; the layer above has other codecs, for
//! types that are known only at run time.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use super::Publisher;
use crate::error::{PublishCdrError, PublishError};
use std::ops::DerefMut;
use tautline_msgs::cdr::{DecodeError, DecodeFault, EncodeError, Endian, FieldPath};
use tautline_msgs::{Body, Message, split_header};

/// How the samples of a topic are read. Every [`Message`] is read in place, as its own [`view`](Message::view) does.
///
/// # Real-time
/// For a Rust type wait-free, without allocation except in [`owned`](Decode::owned). Other codecs check nothing before a message
/// is copied, and allocate for each copy.
pub trait Decode: Sized + 'static {
    /// What must be known of the type at run time: nothing of a Rust type. It is cloned for each sample, without allocation.
    type Definition: Clone + Send + Sync + Unpin + 'static;
    /// What reads a sample in place.
    type View<'a>: Copy + Send + Sync;
    /// What is copied out of a sample.
    type Owned;

    /// Checks a body as far as it is checked when it is taken, and gives what reads it in place.
    ///
    /// # Errors
    /// [`DecodeError`]: it is no message.
    fn view(body: Body<'_>) -> Result<Self::View<'_>, DecodeError>;

    /// The same view for a shorter time.
    #[doc(hidden)]
    fn shorten<'short, 'long: 'short>(view: Self::View<'long>) -> Self::View<'short>;

    /// Copies what a view reads.
    fn owned(definition: &Self::Definition, view: Self::View<'_>) -> Self::Owned;
}

/// How the messages of a topic are written, in addition to how they are read.
///
/// # Real-time
/// For a Rust type wait-free, without allocation; other codecs allocate for each message.
pub trait Codec: Decode {
    /// Why a value is no message.
    type Invalid;
    /// Why a value was not published.
    type Error: From<PublishError> + From<Self::Invalid>;
    /// Why the CDR of a message was not published.
    type CdrError;

    /// Writes the message into what `loan` gives for its length in bytes.
    ///
    /// # Errors
    /// Those of `loan`; what `invalid` makes of [`Invalid`](Self::Invalid).
    fn encode_into<L: DerefMut<Target = [u8]>, E>(
        &self,
        definition: &Self::Definition,
        loan: impl FnOnce(usize) -> Result<L, E>,
        invalid: impl FnOnce(Self::Invalid) -> E,
    ) -> Result<L, E>;

    /// [`Publisher::publish_raw`].
    ///
    /// # Errors
    /// As there.
    fn publish_cdr(publisher: &Publisher<Self>, cdr: &[u8]) -> Result<(), Self::CdrError>;
}

impl<T: Message> Decode for T {
    type Definition = ();
    type View<'a> = <T as Message>::View<'a>;
    type Owned = T;

    fn view(body: Body<'_>) -> Result<Self::View<'_>, DecodeError> {
        <T as Message>::view(body)
    }

    fn shorten<'short, 'long: 'short>(view: Self::View<'long>) -> Self::View<'short> {
        <T as Message>::shorten(view)
    }

    fn owned((): &(), view: Self::View<'_>) -> T {
        <T as Message>::owned(view)
    }
}

impl<T: Message> Codec for T {
    type Invalid = EncodeError;
    type Error = PublishError;
    type CdrError = PublishCdrError;

    fn encode_into<L: DerefMut<Target = [u8]>, E>(
        &self,
        (): &(),
        loan: impl FnOnce(usize) -> Result<L, E>,
        invalid: impl FnOnce(EncodeError) -> E,
    ) -> Result<L, E> {
        let mut loan = loan(self.cdr_len())?;
        self.encode(&mut loan).map_err(invalid)?;
        Ok(loan)
    }

    /// The bytes are copied into a loan once and checked there as any sample is when it is taken. Big-endian ones are decoded and
    /// written anew.
    fn publish_cdr(publisher: &Publisher<T>, cdr: &[u8]) -> Result<(), PublishCdrError> {
        let (endian, body) = split_header(cdr).map_err(whole::<T>)?;
        if endian == Endian::Big {
            return Ok(publisher.publish(&T::decode(body, endian)?)?);
        }
        // Others may pad what has a fixed size.
        let padding = T::FIXED_LEN.map_or(0, |len| body.len().saturating_sub(len));
        if padding > MAX_PADDING {
            return Err(whole::<T>(DecodeFault::Trailing { len: padding, most: MAX_PADDING }).into());
        }
        let body = body.get(..body.len() - padding).unwrap_or_default();
        let mut loan = publisher.raw().loan(body.len())?;
        loan.copy_from_slice(body);
        let memory = Body::new(loan.payload(), body.len()).map_err(whole::<T>)?;
        <T as Message>::view(memory)?;
        Ok(loan.publish().map_err(PublishError::from)?)
    }
}

/// What other middleware appends at most to a message of a fixed size.
const MAX_PADDING: usize = 8;

fn whole<T: Message>(fault: DecodeFault) -> DecodeError {
    DecodeError { type_name: T::TYPE_NAME, path: FieldPath::EMPTY, offset: 0, fault }
}
