// SPDX-License-Identifier: MIT OR Apache-2.0
//! Topics of types with which the program was not built: messages as JSON, or as the CDR of the ROS 2 wire.

mod codec;

pub use codec::{Cdr, Json};

use crate::error::Result;
use crate::node::Node;
use crate::subscription::Subscription;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tautline_definitions::{DefinitionError, find_schema, type_of};
use tautline_schema::{Schema, TypeName};
use tautline_transport::{EndpointKind, Publisher, Qos, SchemaStore, TopicEndpoint, TopicType};

/// Time-out for the gateway to learn a type, and the interval of the checks whether it has.
const PATIENCE: Duration = Duration::from_secs(5);
const LOOK_PERIOD: Duration = Duration::from_millis(20);

/// Definitions are searched in this order: the stored definition for the hash of the topic, if it exists (every process
/// stores the definitions of its types in `/tmp/tautline_<uid>/schemas`); the packages of `AMENT_PREFIX_PATH`; the bundled
/// packages; the nodes of other hosts that publish the topic, through this host's gateway.
impl Node {
    /// Subscribes to a topic of a type that is known by name: a stream of samples, each of which can be copied as JSON by the type's
    /// definition; the copy is an error if the sample is not valid for the type. [`Subscription::owned`] converts it into a stream of these
    /// copies.
    ///
    /// ```
    /// # use futures::{StreamExt, executor::block_on};
    /// # use tautline::{Context, Json, Node, Qos, Realtime};
    /// # let ctx = Context::builder().domain(196).realtime(Realtime::Off).build()?;
    /// # let mut node = Node::create(ctx, "example", "")?;
    /// let qos = Qos::default();
    /// let mut points = node.subscribe_untyped("/point", "geometry_msgs/msg/Point", qos)?.owned();
    /// let publisher = node.create_publisher_untyped("/point", "geometry_msgs/msg/Point", qos)?;
    /// publisher.publish(&Json(serde_json::json!({ "x": 1.5 })))?; // what is left out has its default
    /// let point = block_on(points.next()).expect("it never ends")?;
    /// assert_eq!(point, serde_json::json!({ "x": 1.5, "y": 0.0, "z": 0.0 }));
    /// # Ok::<(), tautline::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::UnknownType`](crate::Error::UnknownType) if the type's definition is not found, [`Error::Schema`](crate::Error::Schema) and [`Error::StoredDefinition`](crate::Error::StoredDefinition) if it
    /// is wrong; as [`create_publisher`](Self::create_publisher).
    pub fn subscribe_untyped(
        &mut self,
        topic: &str,
        topic_type: &str,
        qos: Qos,
    ) -> Result<Subscription<Json>> {
        let schema = self.find_schema(topic, topic_type)?;
        self.subscribe_of(topic, &type_of(&schema), schema, qos)
    }

    /// Subscribes to a topic of a type that is known by name: a stream of samples whose view is the body of the message's CDR;
    /// [`Subscription::owned`] converts it into a stream of copies, each with the 4 bytes of the encapsulation header. It is not checked
    /// whether they are messages of the type. The type's definition need not be known; if it is, the topic's hash must agree with it.
    ///
    /// # Errors
    /// [`Error::Schema`](crate::Error::Schema) and [`Error::StoredDefinition`](crate::Error::StoredDefinition) if there is a definition but it is wrong; as
    /// [`create_publisher`](Self::create_publisher).
    pub fn subscribe_raw(&mut self, topic: &str, topic_type: &str, qos: Qos) -> Result<Subscription<Cdr>> {
        let full = self.resolve_topic_name(topic)?;
        let existing = self.participant.topic_type(&full)?.filter(|existing| existing.name == topic_type);
        let topic_type = match find_schema(&full, &topic_type.parse()?, existing.as_ref()) {
            Ok(schema) => type_of(&schema),
            Err(DefinitionError::Unknown { type_name, .. }) => existing.unwrap_or(TopicType::new(type_name)),
            Err(error) => return Err(error.into()),
        };
        self.subscribe_of(topic, &topic_type, (), qos)
    }

    /// Creates a publisher of messages as JSON or CDR, checked with the type's definition.
    ///
    /// # Errors
    /// As [`subscribe_untyped`](Self::subscribe_untyped).
    pub fn create_publisher_untyped(
        &mut self,
        topic: &str,
        topic_type: &str,
        qos: Qos,
    ) -> Result<Publisher<Json>> {
        let schema = self.find_schema(topic, topic_type)?;
        self.create_publisher_of(topic, &type_of(&schema), schema, qos)
    }

    /// The definition of the type `topic_type` for `topic`, searched as in [`find_schema`]. If only nodes of other hosts
    /// know it, this host's gateway is made to request it from them; this function waits for that for a few seconds.
    fn find_schema(&self, topic: &str, topic_type: &str) -> Result<Arc<Schema>> {
        let topic = self.resolve_topic_name(topic)?;
        let name: TypeName = topic_type.parse()?;
        let existing = self.participant.topic_type(&topic)?.filter(|existing| existing.name == name.as_str());
        match (find_schema(&topic, &name, existing.as_ref()), existing) {
            (Err(DefinitionError::Unknown { .. }), Some(existing))
                if self.is_published_elsewhere(&topic)? =>
            {
                self.wait_for_definition(&topic, &existing)?;
                Ok(find_schema(&topic, &name, Some(&existing))?)
            }
            (found, _) => Ok(found?),
        }
    }

    fn is_published_elsewhere(&self, topic: &str) -> Result<bool> {
        let is_it = |end: &Arc<TopicEndpoint>| {
            end.is_remote && end.topic == topic && end.kind == EndpointKind::Publisher
        };
        Ok(self.graph()?.endpoints.iter().any(is_it))
    }

    /// Subscribes to the topic and waits: the gateway requests the types of the topics that it forwards, which need a subscription.
    fn wait_for_definition(&self, topic: &str, topic_type: &TopicType) -> Result<()> {
        let Some(hash) = &topic_type.hash else { return Ok(()) };
        let limits = self.limits_of(topic);
        let _wanted = self.participant.create_raw_subscription(topic, topic_type, Qos::default(), limits)?;
        let (store, end) = (SchemaStore::of_user(), Instant::now() + PATIENCE);
        while Instant::now() < end && !matches!(store.read(hash), Ok(Some(_))) {
            std::thread::sleep(LOOK_PERIOD);
        }
        Ok(())
    }
}
