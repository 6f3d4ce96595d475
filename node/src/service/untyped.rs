// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services of types with which the program was not built: requests and responses as JSON.

use super::{Client, Server};
use crate::error::Result;
use crate::node::Node;
use crate::untyped::Json;
use std::sync::Arc;
use tautline_definitions::{find_schema, type_of};
use tautline_schema::{Schema, TypeName};
use tautline_transport::{Qos, ServiceType, TopicType};

impl Node {
    /// Creates a client of a service of a type that is known by name, `std_srvs/srv/SetBool`: requests and responses are
    /// JSON, and a response that is not valid for the type is an error.
    ///
    /// # Errors
    /// [`Error::UnknownType`](crate::Error::UnknownType), [`Error::Schema`](crate::Error::Schema) and
    /// [`Error::StoredDefinition`](crate::Error::StoredDefinition) for the type's definition; as [`create_client`](Self::create_client).
    pub fn create_client_untyped(&mut self, service_name: &str, service_type: &str) -> Result<Client<Json>> {
        let (name, limits) = self.resolve_service(service_name)?;
        let (service_type, request, response) = self.service_definitions(&name, service_type)?;
        let _node = tautline_trace::in_node(self.trace.id());
        let raw = self.participant.create_raw_client(&name, &service_type, limits)?;
        let client = tautline_transport::Client::new(raw, request, response);
        Ok(Client::new(client, self.context.events()))
    }

    /// Creates a service of a type that is known by name: requests and responses are JSON. A request that is not valid for the type is an
    /// error.
    ///
    /// # Errors
    /// As [`create_client_untyped`](Self::create_client_untyped).
    pub fn create_service_untyped(
        &mut self,
        service_name: &str,
        service_type: &str,
        qos: Qos,
    ) -> Result<Server<Json>> {
        let (name, limits) = self.resolve_service(service_name)?;
        let (service_type, request, response) = self.service_definitions(&name, service_type)?;
        let _node = tautline_trace::in_node(self.trace.id());
        let raw = self.participant.create_raw_server(&name, &service_type, qos.depth, limits)?;
        Ok(Server::new(tautline_transport::Server::new(raw, request, response)))
    }

    /// The type of a service, and the definitions of its requests and responses.
    fn service_definitions(
        &self,
        service: &str,
        type_name: &str,
    ) -> Result<(ServiceType, Arc<Schema>, Arc<Schema>)> {
        let name: TypeName = type_name.parse()?;
        let existing = self.participant.service_type(service)?;
        let schema = find_schema(service, &name, existing.as_ref())?;
        let part = |suffix: &str| -> Result<Arc<Schema>> {
            Ok(schema.of_part(&format!("{type_name}_{suffix}").parse()?)?.into())
        };
        let (request, response) = (part("Request")?, part("Response")?);
        // Found by the service's hash, which covers both.
        let TopicType { body_bytes, .. } = type_of(&request);
        let service_type = ServiceType {
            request: TopicType { body_bytes, ..type_of(&schema) },
            response: type_of(&response),
        };
        Ok((service_type, request, response))
    }
}
