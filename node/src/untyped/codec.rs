// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::error::{Error, Result};
use std::ops::DerefMut;
use std::sync::Arc;
use tautline_msgs::cdr::{DecodeError, Endian};
use tautline_msgs::{Body, HEADER, split_header};
use tautline_schema::{self as schema, DynamicMessage, MessageError, Schema};
use tautline_transport::{Codec, Decode, Publisher, ServiceCodec};

/// A message, request or response of a type that is known by its definition: an object of its fields. Omitted fields have their defaults.
/// A value that is not valid for the type is not sent; [`Error::Message`] names the field and the reason. Received messages are copied; a
/// message that is not valid for the type is an error.
///
/// Not for real-time threads: each message allocates.
#[derive(Clone, Debug, PartialEq)]
pub struct Json(pub serde_json::Value);

impl Decode for Json {
    type Definition = Arc<Schema>;
    /// The body of its CDR.
    type View<'a> = &'a [u8];
    type Owned = Result<serde_json::Value>;

    fn view(body: Body<'_>) -> Result<&[u8], DecodeError> {
        Ok(body.bytes())
    }

    fn shorten<'short, 'long: 'short>(view: &'long [u8]) -> &'short [u8] {
        view
    }

    fn owned(definition: &Arc<Schema>, body: &[u8]) -> Self::Owned {
        Ok(DynamicMessage::from_body(definition, body, schema::Endian::Little)?.to_json_value())
    }
}

impl Codec for Json {
    type Invalid = MessageError;
    type Error = Error;
    type CdrError = Error;

    fn encode_into<L: DerefMut<Target = [u8]>, E>(
        &self,
        definition: &Arc<Schema>,
        loan: impl FnOnce(usize) -> Result<L, E>,
        invalid: impl FnOnce(MessageError) -> E,
    ) -> Result<L, E> {
        let body = DynamicMessage::from_json_value(definition, &self.0).map_err(invalid)?.to_body();
        let mut loan = loan(body.len())?;
        loan.copy_from_slice(&body);
        Ok(loan)
    }

    /// Publishes CDR, decoded once to check it. Little-endian bytes are then copied as they are, without what other middleware appended.
    fn publish_cdr(publisher: &Publisher<Json>, cdr: &[u8]) -> Result<()> {
        let message = DynamicMessage::from_cdr(publisher.definition(), cdr)?;
        let published = match split_header(cdr) {
            Ok((Endian::Little, body)) => {
                let len = body.len().saturating_sub(message.trailing_bytes());
                publisher.as_ref().publish(body.get(..len).unwrap_or_default())
            }
            _ => publisher.as_ref().publish(&message.to_body()),
        };
        Ok(published?)
    }
}

impl ServiceCodec for Json {
    type Request = Json;
    type Response = Json;
    type Error = Error;

    fn invalid(_: &Arc<str>, invalid: MessageError) -> Error {
        invalid.into()
    }
}

/// Messages of any type as CDR. It is not checked whether they are valid for the type. Read the body in shared memory, or a copy of it
/// after the 4 bytes of the encapsulation header.
#[derive(Clone, Copy, Debug)]
pub enum Cdr {}

impl Decode for Cdr {
    type Definition = ();
    /// The body.
    type View<'a> = &'a [u8];
    type Owned = Vec<u8>;

    fn view(body: Body<'_>) -> Result<&[u8], DecodeError> {
        Ok(body.bytes())
    }

    fn shorten<'short, 'long: 'short>(view: &'long [u8]) -> &'short [u8] {
        view
    }

    fn owned((): &(), body: &[u8]) -> Vec<u8> {
        [&HEADER[..], body].concat()
    }
}
