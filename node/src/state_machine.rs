// SPDX-License-Identifier: MIT OR Apache-2.0
//! The states of a managed node and the transitions between them: <https://design.ros2.org/articles/node_lifecycle.html>,
//! with the numbers and names of `lifecycle_msgs`.
//!
//! ```text
//!                    configure              activate
//!  unconfigured  ----------------> inactive ----------> active      shutdown: from each of the three to finalized
//!       ^ ^      <----------------          <----------             through a state of its own goes every arrow:
//!       | |          cleanup               deactivate               configuring, cleaningup, activating, deactivating,
//!       | +-- success -- errorprocessing <--- error of any of them  shuttingdown; a callback runs there, and its
//!                             |                                     success, failure or error leads on
//!                             +--- failure or error ---> finalized
//! ```

use std::fmt;

/// A state, with its number in `lifecycle_msgs/msg/State`. The last six are transition states: they last as
/// long as a callback.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
#[allow(missing_docs, reason = "the names are ROS 2's")]
pub enum State {
    Unconfigured = 1,
    Inactive = 2,
    Active = 3,
    Finalized = 4,
    Configuring = 10,
    CleaningUp = 11,
    ShuttingDown = 12,
    Activating = 13,
    Deactivating = 14,
    ErrorProcessing = 15,
}

tautline_rt::names!(State: pub const ALL: [State; 10]; pub const fn label(self) -> &'static str {
    Unconfigured: "unconfigured", Inactive: "inactive", Active: "active", Finalized: "finalized",
    Configuring: "configuring", CleaningUp: "cleaningup", ShuttingDown: "shuttingdown",
    Activating: "activating", Deactivating: "deactivating", ErrorProcessing: "errorprocessing",
});

impl State {
    /// The number in `lifecycle_msgs/msg/State`.
    pub fn id(self) -> u8 {
        self as u8
    }

    /// The state with this number.
    pub fn from_id(id: u8) -> Option<State> {
        State::ALL.into_iter().find(|state| state.id() == id)
    }
}

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.label())
    }
}

/// The result of a transition's callback.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum CallbackReturn {
    /// The node enters the transition's goal state.
    Success,
    /// It returns to its previous state; from shutting down and error processing it goes to finalized.
    Failure,
    /// It enters error processing, with `on_error`.
    Error,
}

/// A transition from one state to another.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Transition {
    /// The number in `lifecycle_msgs/msg/Transition`.
    pub id: u8,
    /// ROS 2's name; several transitions may have the same one.
    pub label: &'static str,
    /// Its start state.
    pub start: State,
    /// Its goal state.
    pub goal: State,
}

const fn transition(id: u8, label: &'static str, start: State, goal: State) -> Transition {
    Transition { id, label, start, goal }
}

const SUCCESS: &str = "transition_success";
const FAILURE: &str = "transition_failure";
const ERROR: &str = "transition_error";

impl Transition {
    /// To inactive.
    pub const CONFIGURE: Transition = transition(1, "configure", State::Unconfigured, State::Configuring);
    /// To unconfigured.
    pub const CLEANUP: Transition = transition(2, "cleanup", State::Inactive, State::CleaningUp);
    /// To active.
    pub const ACTIVATE: Transition = transition(3, "activate", State::Inactive, State::Activating);
    /// To inactive.
    pub const DEACTIVATE: Transition = transition(4, "deactivate", State::Active, State::Deactivating);

    /// All transitions, in the order of their numbers.
    pub const ALL: [Transition; 25] = [
        Transition::CONFIGURE,
        Transition::CLEANUP,
        Transition::ACTIVATE,
        Transition::DEACTIVATE,
        transition(5, "shutdown", State::Unconfigured, State::ShuttingDown),
        transition(6, "shutdown", State::Inactive, State::ShuttingDown),
        transition(7, "shutdown", State::Active, State::ShuttingDown),
        transition(10, SUCCESS, State::Configuring, State::Inactive),
        transition(11, FAILURE, State::Configuring, State::Unconfigured),
        transition(12, ERROR, State::Configuring, State::ErrorProcessing),
        transition(20, SUCCESS, State::CleaningUp, State::Unconfigured),
        transition(21, FAILURE, State::CleaningUp, State::Inactive),
        transition(22, ERROR, State::CleaningUp, State::ErrorProcessing),
        transition(30, SUCCESS, State::Activating, State::Active),
        transition(31, FAILURE, State::Activating, State::Inactive),
        transition(32, ERROR, State::Activating, State::ErrorProcessing),
        transition(40, SUCCESS, State::Deactivating, State::Inactive),
        transition(41, FAILURE, State::Deactivating, State::Active),
        transition(42, ERROR, State::Deactivating, State::ErrorProcessing),
        transition(50, SUCCESS, State::ShuttingDown, State::Finalized),
        transition(51, FAILURE, State::ShuttingDown, State::Finalized),
        transition(52, ERROR, State::ShuttingDown, State::ErrorProcessing),
        transition(60, SUCCESS, State::ErrorProcessing, State::Unconfigured),
        transition(61, FAILURE, State::ErrorProcessing, State::Finalized),
        transition(62, ERROR, State::ErrorProcessing, State::Finalized),
    ];

    /// The transitions that begin in `state`.
    pub fn from(state: State) -> impl Iterator<Item = Transition> {
        Transition::ALL.into_iter().filter(move |transition| transition.start == state)
    }

    /// Whether a user requests it; the others result from callbacks.
    pub fn is_requested(self) -> bool {
        self.id < 10
    }
}

/// A transition that does not start in the node's state.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{wanted}' is not possible in state '{state}'; possible is: {}", possible(*.state))]
pub struct InvalidTransition {
    /// The node's state.
    pub state: State,
    /// The requested transition: a name, or a number.
    pub wanted: String,
}

fn possible(state: State) -> String {
    let labels: Vec<_> = requested(state).map(|transition| transition.label).collect();
    if labels.is_empty() { "nothing".into() } else { labels.join(", ") }
}

fn requested(state: State) -> impl Iterator<Item = Transition> {
    Transition::from(state).filter(|transition| transition.is_requested())
}

/// The state machine of a node: its state changes only by transitions.
#[derive(Clone, Debug)]
pub struct StateMachine {
    state: State,
}

impl StateMachine {
    /// Unconfigured.
    pub const fn new() -> Self {
        StateMachine { state: State::Unconfigured }
    }

    /// The node's state.
    pub fn state(&self) -> State {
        self.state
    }

    /// Starts the transition with the number `id`: the caller then runs a callback and passes its result to
    /// [`finish`](Self::finish).
    ///
    /// # Errors
    /// [`InvalidTransition`]; the state does not change.
    pub fn begin(&mut self, id: u8) -> Result<Transition, InvalidTransition> {
        self.begin_where(|transition| transition.id == id, || id.to_string())
    }

    /// Starts the transition called `label`.
    ///
    /// # Errors
    /// As [`begin`](Self::begin).
    pub fn begin_by_label(&mut self, label: &str) -> Result<Transition, InvalidTransition> {
        self.begin_where(|transition| transition.label == label, || label.to_owned())
    }

    fn begin_where(
        &mut self,
        is_wanted: impl Fn(&Transition) -> bool,
        wanted: impl Fn() -> String,
    ) -> Result<Transition, InvalidTransition> {
        let found = requested(self.state).find(is_wanted);
        let transition = found.ok_or_else(|| {
            let named = |transition: &Transition| transition.label.to_owned();
            let known = Transition::ALL.iter().find(|t| t.is_requested() && t.id.to_string() == wanted());
            InvalidTransition { state: self.state, wanted: known.map_or_else(wanted, named) }
        })?;
        self.state = transition.goal;
        Ok(transition)
    }

    /// Ends the transition with the result of its callback. `None` if no transition was started.
    pub fn finish(&mut self, result: CallbackReturn) -> Option<Transition> {
        let label = match result {
            CallbackReturn::Success => SUCCESS,
            CallbackReturn::Failure => FAILURE,
            CallbackReturn::Error => ERROR,
        };
        let transition = Transition::from(self.state).find(|transition| transition.label == label)?;
        self.state = transition.goal;
        Some(transition)
    }
}

impl Default for StateMachine {
    fn default() -> Self {
        StateMachine::new()
    }
}

/// Why a managed node did not start a transition.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LifecycleError {
    /// The transition does not start in the node's state.
    #[error(transparent)]
    InvalidTransition(#[from] InvalidTransition),
    /// The callback of another transition is running.
    #[error("the node is in state '{state}', a transition state: try again when its callback has returned")]
    Busy {
        /// The transition state, which lasts as long as the callback.
        state: State,
    },
}

#[cfg(test)]
mod tests {
    use super::*;
    use State::*;

    /// The design's picture: what is asked where, and where each result leads.
    const DESIGN: [(State, &str, State, [State; 3]); 7] = [
        (Unconfigured, "configure", Configuring, [Inactive, Unconfigured, ErrorProcessing]),
        (Inactive, "cleanup", CleaningUp, [Unconfigured, Inactive, ErrorProcessing]),
        (Inactive, "activate", Activating, [Active, Inactive, ErrorProcessing]),
        (Active, "deactivate", Deactivating, [Inactive, Active, ErrorProcessing]),
        (Unconfigured, "shutdown", ShuttingDown, [Finalized, Finalized, ErrorProcessing]),
        (Inactive, "shutdown", ShuttingDown, [Finalized, Finalized, ErrorProcessing]),
        (Active, "shutdown", ShuttingDown, [Finalized, Finalized, ErrorProcessing]),
    ];
    const RESULTS: [CallbackReturn; 3] =
        [CallbackReturn::Success, CallbackReturn::Failure, CallbackReturn::Error];

    #[test]
    fn every_state_with_every_request() {
        for state in State::ALL {
            for label in ["configure", "cleanup", "activate", "deactivate", "shutdown"] {
                let mut machine = StateMachine { state };
                let designed = DESIGN.iter().find(|row| (row.0, row.1) == (state, label));
                match (machine.begin_by_label(label), designed) {
                    (Ok(transition), Some((.., through, _))) => {
                        assert_eq!((machine.state(), transition.goal), (*through, *through));
                        let mut by_id = StateMachine { state };
                        assert_eq!(by_id.begin(transition.id), Ok(transition));
                    }
                    (Err(error), None) => {
                        assert_eq!((machine.state(), error.state), (state, state), "it stays");
                        let text = error.to_string();
                        assert!(text.contains(label) && text.contains(state.label()), "{text}");
                    }
                    other => panic!("{state}, {label}: {other:?}"),
                }
            }
        }
    }

    #[test]
    fn every_result_of_every_callback() {
        for (start, label, through, goals) in DESIGN {
            for (result, goal) in RESULTS.into_iter().zip(goals) {
                let mut machine = StateMachine { state: start };
                machine.begin_by_label(label).unwrap();
                let finished = machine.finish(result).unwrap();
                assert_eq!(
                    (finished.start, finished.goal, machine.state()),
                    (through, goal, goal),
                    "{label} {result:?}"
                );
            }
        }
        for (result, goal) in RESULTS.into_iter().zip([Unconfigured, Finalized, Finalized]) {
            let mut machine = StateMachine { state: ErrorProcessing };
            assert_eq!(machine.finish(result).unwrap().goal, goal);
        }
        for state in [Unconfigured, Inactive, Active, Finalized] {
            for result in RESULTS {
                let mut machine = StateMachine { state };
                assert_eq!((machine.finish(result), machine.state()), (None, state), "nothing runs there");
            }
        }
    }

    #[test]
    fn every_number_in_every_state() {
        for state in State::ALL {
            for id in 0..=u8::MAX {
                let mut machine = StateMachine { state };
                let begun = machine.begin(id);
                let known = Transition::ALL.iter().find(|t| t.id == id && t.start == state && id < 10);
                assert_eq!(begun.as_ref().ok(), known, "{state} {id}");
                assert_eq!(machine.state(), known.map_or(state, |known| known.goal));
            }
        }
        let results = Transition::ALL.iter().filter(|transition| !transition.is_requested()).count();
        assert_eq!(results, 6 * RESULTS.len(), "three of each callback");
        let error = StateMachine::new().begin(3).unwrap_err().to_string();
        assert_eq!(
            error,
            "'activate' is not possible in state 'unconfigured'; possible is: configure, shutdown"
        );
    }

    #[test]
    fn numbers_are_those_of_the_messages() {
        assert_eq!(State::ALL.map(State::id), [1, 2, 3, 4, 10, 11, 12, 13, 14, 15]);
        assert!(State::ALL.into_iter().all(|state| State::from_id(state.id()) == Some(state)));
        assert_eq!(State::from_id(0), None);
        assert!(Transition::ALL.is_sorted_by_key(|transition| transition.id));
    }
}
