// SPDX-License-Identifier: MIT OR Apache-2.0
//! Publishing a message that somebody else has encoded.

use super::Publisher;
use crate::error::{PublishCdrError, PublishError};
use tautline_msgs::cdr::{DecodeError, DecodeFault, Endian, FieldPath};
use tautline_msgs::{Body, Message, split_header};

impl<T: Message> Publisher<T> {
    /// Publishes what is on the ROS 2 wire and in bags: the encapsulation header of 4 bytes, then the body. The bytes are
    /// copied into a loan once and checked there as any sample is when it is taken. Big-endian ones are decoded and written
    /// anew.
    ///
    /// # Real-time
    /// As [`publish`](Publisher::publish), and [`Message::view`]. Big-endian messages allocate their strings and sequences.
    ///
    /// # Errors
    /// [`PublishCdrError`]: with field and byte if these are no message of type `T`.
    pub fn publish_raw(&self, cdr: &[u8]) -> Result<(), PublishCdrError> {
        let (endian, body) = split_header(cdr).map_err(whole::<T>)?;
        if endian == Endian::Big {
            return Ok(self.publish(&T::decode(body, endian)?)?);
        }
        // Others may pad what has a fixed size.
        let padding = T::FIXED_LEN.map_or(0, |len| body.len().saturating_sub(len));
        if padding > MAX_PADDING {
            return Err(whole::<T>(DecodeFault::Trailing { len: padding, most: MAX_PADDING }).into());
        }
        let body = body.get(..body.len() - padding).unwrap_or_default();
        let mut loan = self.raw().loan(body.len())?;
        loan.copy_from_slice(body);
        let memory = Body::new(loan.payload(), body.len()).map_err(whole::<T>)?;
        T::view(memory)?;
        Ok(loan.publish().map_err(PublishError::from)?)
    }
}

/// What other middleware appends at most to a message of a fixed size.
const MAX_PADDING: usize = 8;

fn whole<T: Message>(fault: DecodeFault) -> DecodeError {
    DecodeError { type_name: T::TYPE_NAME, path: FieldPath::EMPTY, offset: 0, fault }
}
