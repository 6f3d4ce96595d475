// SPDX-License-Identifier: MIT OR Apache-2.0
//! Requests and responses as events, `package/srv/Name_Event`: what ROS 2's service introspection publishes, and rosbag2 records.
//!
//! An event is `service_msgs/ServiceEventInfo info`, `request[<=1]`, `response[<=1]`. The reader writes the fields in front of
//! a response and copies the response after them, at a multiple of 8, as it was encoded. A request begins 4 bytes before such an offset, so
//! the writer encodes it again.

use crate::definitions;
use std::sync::Arc;
use tautline_bag::{Definition, Topic};
use tautline_definitions::{find_schema, type_of};
use tautline_schema::{DynamicMessage, Endian, List, MessageError, Schema, Value};
use tautline_transport::{MessageInfo, Qos, ServiceEndpoint, TopicType};

/// The suffix of the topic of a service's events.
pub const EVENTS: &str = "/_service_event";
/// Bytes in front of a response: the information, no request, one response.
pub const FRONT_BYTES: usize = 48;

/// What a message becomes in the bag.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    Message,
    Request,
    Response,
}

tautline_rt::names!(Part: pub const fn name(self) -> &'static str {
    Message: "messages", Request: "requests", Response: "responses",
});

impl Part {
    /// The bytes in front of the message.
    ///
    /// # Real-time
    /// Constant; no allocation.
    pub fn front(self, info: &MessageInfo) -> ([u8; FRONT_BYTES], usize) {
        let mut front = [0; FRONT_BYTES];
        // REQUEST_SENT and RESPONSE_SENT, because the stamp is the sender's.
        let (event_type, responses) = match self {
            Part::Message => return (front, 0),
            Part::Request => (0, 0),
            Part::Response => (2, 1_u32),
        };
        let (seconds, rest) = (info.source_timestamp_ns.div_euclid(1_000_000_000), info.source_timestamp_ns);
        front[0] = event_type;
        front[4..8].copy_from_slice(&(seconds as i32).to_le_bytes());
        front[8..12].copy_from_slice(&(rest.rem_euclid(1_000_000_000) as u32).to_le_bytes());
        front[12..28].copy_from_slice(&info.publisher_gid.0);
        front[32..40].copy_from_slice(&info.sequence_number.to_le_bytes());
        front[44..48].copy_from_slice(&responses.to_le_bytes());
        (front, FRONT_BYTES)
    }
}

/// The definitions with which a service's events are written.
#[derive(Clone)]
pub struct Events {
    request: Arc<Schema>,
    event: Arc<Schema>,
}

impl Events {
    /// `None` if the definition is not known, or is not that of the service.
    pub fn of(service: &ServiceEndpoint) -> Option<Self> {
        let known = TopicType::new(service.type_name.clone());
        let known = match &service.type_hash {
            Some(hash) => known.with_hash(hash.clone()),
            None => known,
        };
        let whole = find_schema(&service.name, &service.type_name.parse().ok()?, Some(&known)).ok()?;
        if service.type_hash.as_ref().is_some_and(|hash| *hash != whole.hash().to_string()) {
            return None;
        }
        let part =
            |suffix: &str| whole.of_part(&format!("{}_{suffix}", service.type_name).parse().ok()?).ok();
        Some(Events { request: part("Request")?.into(), event: part("Event")?.into() })
    }

    /// The topic of a service's events.
    pub fn topic(&self, service: &str) -> Topic {
        Topic {
            name: format!("{service}{EVENTS}"),
            type_name: self.event.name().to_string(),
            type_hash: type_of(&self.event).hash.as_deref().unwrap_or_default().to_owned(),
            definition: Some(Definition::ros2msg(definitions::for_bag(&self.event))),
            qos: crate::offered_qos::write(&Qos::default()),
            ..Topic::default()
        }
    }

    /// The event of a request, with its encapsulation, from the bytes that the reader put into the ring.
    ///
    /// # Errors
    /// The bytes are not a request of the service.
    pub fn written(&self, cdr: &[u8]) -> Result<Vec<u8>, MessageError> {
        let body = cdr.get(tautline_msgs::HEADER.len()..).unwrap_or_default();
        let (front, request) = body.split_at(FRONT_BYTES.min(body.len()));
        let request = DynamicMessage::from_body(&self.request, request, Endian::Little)?;
        let event = DynamicMessage::from_body(&self.event, front, Endian::Little)?;
        let mut fields = event.fields().to_vec();
        if let Some(requests) = fields.get_mut(1) {
            *requests = Value::List(List::Struct(vec![request.fields().to_vec()]));
        }
        Ok(DynamicMessage::from_fields(&self.event, fields)?.to_cdr())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_transport::{Gid, Origin, ServiceKind};

    fn events(type_name: &str) -> Events {
        let service = ServiceEndpoint {
            kind: ServiceKind::Server,
            name: "/add".to_owned(),
            type_name: type_name.to_owned(),
            type_hash: None,
            gid: Gid([0; 16]),
            node: None,
            pid: None,
            is_remote: false,
            origin: Origin::default(),
            teller: None,
        };
        Events::of(&service).unwrap()
    }

    /// Field by field as the definition says, also where numbers of 8 bytes move.
    #[test]
    fn requests_and_responses_are_events_of_their_service() {
        let events = events("example_interfaces/srv/AddTwoInts");
        let gid = Gid(std::array::from_fn(|n| n as u8));
        let info = MessageInfo {
            sequence_number: 7,
            source_timestamp_ns: 1_500_000_002,
            publisher_gid: gid,
            ..MessageInfo::default()
        };
        let cdr = |part: Part, body: &[u8]| {
            let (front, len) = part.front(&info);
            [&tautline_msgs::HEADER, &front[..len], body].concat()
        };
        let request = [3_i64.to_le_bytes(), 4_i64.to_le_bytes()].concat();
        let request = events.written(&cdr(Part::Request, &request)).unwrap();
        let response = cdr(Part::Response, &7_i64.to_le_bytes());
        let decoded = [request, response].map(|cdr| DynamicMessage::from_cdr(&events.event, &cdr).unwrap());
        for (event, kind) in decoded.iter().zip([0_u8, 2]) {
            let is = |path: &str| event.get(path).unwrap().into_owned();
            assert_eq!(is("info.event_type"), Value::U8(kind));
            assert_eq!(
                (is("info.stamp.sec"), is("info.stamp.nanosec")),
                (Value::I32(1), Value::U32(500_000_002))
            );
            assert_eq!(is("info.client_gid"), Value::List(List::U8(gid.0.to_vec())));
            assert_eq!(is("info.sequence_number"), Value::I64(7));
        }
        assert_eq!(decoded[0].get("request[0].b").unwrap().into_owned(), Value::I64(4));
        assert_eq!(decoded[0].get("response").unwrap().into_owned(), Value::List(List::Struct(Vec::new())));
        assert_eq!(decoded[1].get("response[0].sum").unwrap().into_owned(), Value::I64(7));
        assert_eq!(decoded[1].get("request").unwrap().into_owned(), Value::List(List::Struct(Vec::new())));
        // What claims to be a request and is none.
        for wrong in [&[][..], &[1; 15]] {
            assert!(events.written(&cdr(Part::Request, wrong)).is_err());
        }
        assert!(events.written(&[0, 1, 0, 0]).is_err());
    }
}
