// SPDX-License-Identifier: MIT OR Apache-2.0
//! The services of a managed node: their responses, and the tasks that serve them.

use super::node::{LifecycleNode, Transitioned, described};
use crate::error;
use crate::service::ServiceRequest;
use crate::state_machine::{CallbackReturn, LifecycleError, State, Transition};
use futures::{FutureExt, StreamExt};
use std::future::{Future, Ready, ready};
use tautline_msgs::Service;
use tautline_ros_msgs::lifecycle_msgs::{msg, srv};
use tautline_transport::Qos;

impl LifecycleNode {
    /// Offers the node's services, as in ROS 2: `~/change_state`, `~/get_state`, `~/get_available_states`,
    /// `~/get_available_transitions` and `~/get_transition_graph`. They respond as long as the future is polled. It never ends, and keeps the
    /// node: give it its own callback, and stop that to end the node. Callbacks of transitions that are requested by service run there. If
    /// they create topics, this callback needs a stack as large as a program's own
    /// ([`CallbackOptions::stack_bytes`](crate::CallbackOptions::stack_bytes)). While one of them runs, the other services do not respond,
    /// unless [`serve_changes`](Self::serve_changes) and [`serve_states`](Self::serve_states) are on two callbacks.
    ///
    /// # Errors
    /// [`LifecycleError::Busy`]; [`Error::Transport`](crate::Error::Transport) if a service cannot be
    /// created.
    pub fn serve(&self) -> error::Result<impl Future<Output = ()> + Send + use<>> {
        let (changes, states) = (self.serve_changes()?, self.serve_states()?);
        Ok(futures::future::join(changes, states).map(drop))
    }

    /// The part of [`serve`](Self::serve) in which callbacks of transitions run: `~/change_state`.
    ///
    /// # Errors
    /// As [`serve`](Self::serve).
    pub fn serve_changes(&self) -> error::Result<impl Future<Output = ()> + Send + use<>> {
        let qos = Qos::services_default();
        let changes =
            self.with_node(|node| node.create_service::<srv::ChangeState::Service>("~/change_state", qos))??;
        let node = self.clone();
        Ok(changes.owned().for_each(move |request| {
            let done = change_state(&node, &request.message);
            if let Err(error) = &done {
                tracing::warn!("{error}");
            }
            respond(request, changed(&done))
        }))
    }

    /// The part of [`serve`](Self::serve) that reports the node's state and its possible transitions: all services except
    /// `~/change_state`. On its own callback it also responds during transitions.
    ///
    /// # Errors
    /// As [`serve`](Self::serve).
    pub fn serve_states(&self) -> error::Result<impl Future<Output = ()> + Send + use<>> {
        let qos = Qos::services_default();
        let services = self.with_node(|node| -> error::Result<_> {
            Ok((
                node.create_service::<srv::GetState::Service>("~/get_state", qos)?.owned(),
                node.create_service::<srv::GetAvailableStates::Service>("~/get_available_states", qos)?
                    .owned(),
                node.create_service::<srv::GetAvailableTransitions::Service>(
                    "~/get_available_transitions",
                    qos,
                )?
                .owned(),
                node.create_service::<srv::GetAvailableTransitions::Service>("~/get_transition_graph", qos)?
                    .owned(),
            ))
        })??;
        let node = self.clone();
        Ok(async move {
            let (states, all_states, available, graphs) = services;
            let states = states.for_each(|request| respond(request, state(node.state())));
            let all_states = all_states.for_each(|request| respond(request, available_states()));
            let available =
                available.for_each(|request| respond(request, transitions(node.available_transitions())));
            let graphs = graphs.for_each(|request| respond(request, transitions(Transition::ALL)));
            futures::join!(states, all_states, available, graphs);
        })
    }
}

fn respond<T: Service>(request: ServiceRequest<T>, response: T::Response) -> Ready<()> {
    if let Err(error) = request.respond(response) {
        tracing::warn!("a lifecycle service did not answer: {error}");
    }
    ready(())
}

/// Responds to `change_state`. As in rclcpp, a requested transition with a name is found by the name, whatever its number.
pub(super) fn change_state(
    node: &LifecycleNode,
    request: &srv::ChangeState::Request,
) -> Result<Transitioned, LifecycleError> {
    let msg::Transition { id, label } = &request.transition;
    if label.is_empty() { node.change_state(*id) } else { node.change_state_by_label(label) }
}

pub(super) fn changed(done: &Result<Transitioned, LifecycleError>) -> srv::ChangeState::Response {
    let success = done.as_ref().is_ok_and(|done| done.result == CallbackReturn::Success);
    srv::ChangeState::Response { success }
}

pub(super) fn state(state: State) -> srv::GetState::Response {
    srv::GetState::Response { current_state: described(state) }
}

pub(super) fn available_states() -> srv::GetAvailableStates::Response {
    let unknown = msg::State { id: msg::State::PRIMARY_STATE_UNKNOWN, label: "unknown".into() };
    let known = State::ALL.into_iter().map(described);
    srv::GetAvailableStates::Response { available_states: [unknown].into_iter().chain(known).collect() }
}

/// The response for the transitions that begin in the node's state, and for all of them.
pub(super) fn transitions(
    transitions: impl IntoIterator<Item = Transition>,
) -> srv::GetAvailableTransitions::Response {
    let described = |Transition { id, label, start, goal }| msg::TransitionDescription {
        transition: msg::Transition { id, label: String::from(label) },
        start_state: described(start),
        goal_state: described(goal),
    };
    let available_transitions = transitions.into_iter().map(described).collect();
    srv::GetAvailableTransitions::Response { available_transitions }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_and_transitions_are_described() {
        let states = available_states().available_states;
        assert_eq!(states.len(), 11);
        assert_eq!((states[1].id, states[1].label.as_str()), (1, "unconfigured"));
        let of_inactive = transitions(Transition::from(State::Inactive)).available_transitions;
        let labels: Vec<_> = of_inactive.iter().map(|found| found.transition.label.as_str()).collect();
        assert_eq!(labels, ["cleanup", "activate", "shutdown"]);
        assert_eq!(of_inactive[1].goal_state, described(State::Activating));
        assert_eq!(transitions(Transition::ALL).available_transitions.len(), 25);
        assert!(!changed(&Err(LifecycleError::Busy { state: State::Configuring })).success);
    }
}
