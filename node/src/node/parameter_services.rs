// SPDX-License-Identifier: MIT OR Apache-2.0
//! The six parameter services of a node, as in r2r.

use super::Node;
use crate::error::Result;
use crate::parameters::services::{self, Changed};
use crate::values::ParameterValue;
use futures::channel::mpsc;
use futures::future::{BoxFuture, join_all, ready};
use futures::{FutureExt, Stream, StreamExt};
use std::future::Future;
use tautline_msgs::Service;
use tautline_ros_msgs::rcl_interfaces::srv::{
    DescribeParameters, GetParameterTypes, GetParameters, ListParameters, SetParameters,
    SetParametersAtomically,
};
use tautline_transport::{Claim, Limits, Qos};

/// Capacity of the stream of changes; if it is full, further changes are dropped, and a warning is logged.
const CHANGES: usize = 1000;

impl Node {
    /// Serves the node's parameters to other nodes: `get_parameters`, `set_parameters` and the others below its name. The
    /// future responds, on whatever executor it is spawned; the stream yields the changes by other nodes, with name and
    /// value. Call it once per node.
    ///
    /// # Errors
    /// [`Error::Transport`](crate::Error::Transport) if a service cannot be created.
    pub fn make_parameter_handler(
        &mut self,
    ) -> Result<(
        impl Future<Output = ()> + Send + use<>,
        impl Stream<Item = (String, ParameterValue)> + Send + Unpin + use<>,
    )> {
        let (changes, changed) = mpsc::channel(CHANGES);
        let parameters = self.parameters.clone();
        let get = parameters.clone();
        let get = self.answer::<GetParameters::Service>("get_parameters", move |request| {
            services::get(&get, &request)
        })?;
        let types = parameters.clone();
        let types = self.answer::<GetParameterTypes::Service>("get_parameter_types", move |request| {
            services::get_types(&types, &request)
        })?;
        let describe = parameters.clone();
        let describe = self.answer::<DescribeParameters::Service>("describe_parameters", move |request| {
            services::describe(&describe, &request)
        })?;
        let list = parameters.clone();
        let list = self.answer::<ListParameters::Service>("list_parameters", move |request| {
            services::list(&list, &request)
        })?;
        let (set, mut to_stream) = (parameters.clone(), changes.clone());
        let set = self.answer::<SetParameters::Service>("set_parameters", move |request| {
            let (response, changed) = services::set(&set, request);
            notify(&mut to_stream, changed);
            response
        })?;
        let mut to_stream = changes;
        let atomically =
            self.answer::<SetParametersAtomically::Service>("set_parameters_atomically", move |request| {
                let (response, changed) = services::set_atomically(&parameters, request);
                notify(&mut to_stream, changed);
                response
            })?;
        let answers = join_all([get, types, describe, list, set, atomically]);
        Ok((answers.map(drop), changed))
    }

    /// Creates a service below the node's name that is seldom called. Returns the future that responds.
    pub(crate) fn answer<S: Service>(
        &mut self,
        name: &str,
        mut answer: impl FnMut(S::Request) -> S::Response + Send + 'static,
    ) -> Result<BoxFuture<'static, ()>>
    where
        S::Request: Clone,
    {
        let name = format!("~/{name}");
        // No real-time thread calls it: memory for responses is claimed on use, unless limits were set.
        let limits = Limits { claim: Claim::OnUse, ..Limits::default() };
        self.service_limits.entry(self.resolve_service_name(&name)?).or_insert(limits);
        let requests = self.create_service::<S>(&name, Qos::parameters())?.owned();
        let answers = requests.for_each(move |request| {
            let response = answer(request.message.clone());
            if let Err(error) = request.respond(response) {
                tracing::warn!("a request is not answered: {error}");
            }
            ready(())
        });
        Ok(answers.boxed())
    }
}

fn notify(stream: &mut mpsc::Sender<(String, ParameterValue)>, changed: Changed) {
    for change in changed {
        // The stream may have been dropped.
        if stream.try_send(change).is_err_and(|error| error.is_full()) {
            tracing::warn!(
                "{CHANGES} parameter changes are queued in the stream: a further change is dropped from it"
            );
        }
    }
}
