// SPDX-License-Identifier: MIT OR Apache-2.0
//! Servers and clients in ROS.

use super::context::{Node, text};
use super::end::RclEntity;
use super::error::{RclError, check, taken};
use super::service_support::{RosStruct, ServiceSupport};
use r2r_rcl::*;
use std::sync::Arc;

/// A server in ROS.
pub struct RosServer {
    end: RclEntity<rcl_service_t>,
    _support: ServiceSupport,
}

/// A client in ROS.
pub struct RosClient {
    end: RclEntity<rcl_client_t>,
    _support: ServiceSupport,
}

/// Identifies a request at its server.
#[derive(Clone, Copy)]
pub struct RosRequestId(rmw_request_id_t);

impl RosServer {
    /// A server of `service`, a fully qualified name.
    ///
    /// # Errors
    /// [`RclError`]: an invalid name.
    pub fn new(node: &Arc<Node>, service: &str, support: &ServiceSupport) -> Result<Self, RclError> {
        let name = text(service)?;
        // SAFETY: rcl's protocol; the type support lives as long as the service.
        unsafe {
            let mut options = rcl_service_get_default_options();
            options.qos.depth = DEPTH;
            let init = |raw| rcl_service_init(raw, node.raw(), support.raw(), name.as_ptr(), &options);
            let zero = rcl_get_zero_initialized_service();
            let end = RclEntity::make("making a service", node, zero, init, rcl_service_fini)?;
            Ok(RosServer { end, _support: support.clone() })
        }
    }

    /// Takes a request into `request`, a request struct of this service; `None` if there is none.
    pub fn take(&mut self, request: &mut RosStruct) -> Result<Option<RosRequestId>, RclError> {
        let mut id = rmw_request_id_t { writer_guid: [0; 16], sequence_number: 0 };
        // SAFETY: the service is initialised; the struct is a request.
        let code = unsafe { rcl_take_request(self.end.raw(), &mut id, request.raw_mut()) };
        let is_taken = taken("taking a request", code, RCL_RET_SERVICE_TAKE_FAILED)?;
        Ok(is_taken.then_some(RosRequestId(id)))
    }

    /// Sends `response`, a response struct of this service.
    ///
    /// # Errors
    /// [`RclError`]: for example, the client has ended.
    pub fn respond(&self, id: RosRequestId, response: &mut RosStruct) -> Result<(), RclError> {
        let RosRequestId(mut id) = id;
        // SAFETY: as in `take`; rcl does not change the struct.
        check("answering", unsafe { rcl_send_response(self.end.raw(), &mut id, response.raw_mut()) })
    }

    pub(crate) fn raw(&self) -> *const rcl_service_t {
        self.end.raw()
    }
}

/// Queue depth of requests, and of responses, in the RMW.
const DEPTH: usize = 100;

impl RosClient {
    /// A client of `service`, a fully qualified name.
    ///
    /// # Errors
    /// [`RclError`]: an invalid name.
    pub fn new(node: &Arc<Node>, service: &str, support: &ServiceSupport) -> Result<Self, RclError> {
        let name = text(service)?;
        // SAFETY: as for a server.
        unsafe {
            let mut options = rcl_client_get_default_options();
            options.qos.depth = DEPTH;
            let init = |raw| rcl_client_init(raw, node.raw(), support.raw(), name.as_ptr(), &options);
            let zero = rcl_get_zero_initialized_client();
            let end = RclEntity::make("making a client", node, zero, init, rcl_client_fini)?;
            Ok(RosClient { end, _support: support.clone() })
        }
    }

    /// Whether a server is matched.
    pub fn is_available(&self) -> Result<bool, RclError> {
        let mut is_available = false;
        // SAFETY: both are initialised.
        let code = unsafe {
            rcl_service_server_is_available(self.end.node().raw(), self.end.raw(), &mut is_available)
        };
        check("looking for a server", code).map(|()| is_available)
    }

    /// Sends a request struct of this service. Returns its sequence number, which the response repeats.
    pub fn send(&self, request: &RosStruct) -> Result<i64, RclError> {
        let mut number = 0;
        // SAFETY: the client is initialised; the struct is a request.
        check("asking", unsafe { rcl_send_request(self.end.raw(), request.raw(), &mut number) })
            .map(|()| number)
    }

    /// Takes a response into `response`, a response struct of this service. Returns the request's sequence number; `None` if
    /// there is no response.
    pub fn take(&mut self, response: &mut RosStruct) -> Result<Option<i64>, RclError> {
        let mut id = rmw_request_id_t { writer_guid: [0; 16], sequence_number: 0 };
        // SAFETY: the client is initialised; the struct is a response.
        let code = unsafe { rcl_take_response(self.end.raw(), &mut id, response.raw_mut()) };
        let is_taken = taken("taking a response", code, RCL_RET_CLIENT_TAKE_FAILED)?;
        Ok(is_taken.then_some(id.sequence_number))
    }

    pub(crate) fn raw(&self) -> *const rcl_client_t {
        self.end.raw()
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Context, Node};
    use super::*;
    use std::time::{Duration, Instant};

    #[test]
    fn a_server_that_replaces_another_has_another_identifier() {
        let context = Context::new(Some(5)).unwrap();
        let node = Node::new(&context, "servers", "/").unwrap();
        let support = ServiceSupport::load("std_srvs/srv/SetBool").unwrap();
        let name = format!("/of_{}", std::process::id());
        let server = || RosServer::new(&node, &name, &support).unwrap();
        let gids = |count| {
            let end = Instant::now() + Duration::from_secs(60);
            loop {
                let found = node.servers(&name).unwrap();
                if found.len() == count && found.iter().all(|end| end.node.is_some()) {
                    assert!(found.iter().all(|end| end.node.as_ref().unwrap().name == "servers"));
                    return found.into_iter().map(|end| end.gid).collect::<Vec<_>>();
                }
                assert!(Instant::now() < end, "{found:?}");
                std::thread::yield_now();
            }
        };
        let first = server();
        let before = gids(1);
        let second = server();
        let both = gids(2);
        drop(first);
        let after = gids(1);
        assert!(before != after && both.contains(&before[0]) && both.contains(&after[0]));
        drop(second);
        gids(0);
    }
}
