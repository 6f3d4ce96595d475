// SPDX-License-Identifier: MIT OR Apache-2.0
//! Managed nodes: which callbacks run, when publishers speak, what the world is told.
#![cfg(feature = "lifecycle_msgs")]

mod common;

use common::{Gate, Log, Number, context, eventually, spin};
use futures::FutureExt;
use futures::executor::block_on;
use std::sync::{Arc, Mutex};
use tautline::lifecycle::{
    CallbackReturn, LifecycleCallbacks, LifecycleError, LifecycleNode, ManagedNode, State, Transitioned,
};
use tautline::lifecycle_msgs::msg::TransitionEvent;
use tautline::lifecycle_msgs::srv::{ChangeState, GetAvailableStates, GetAvailableTransitions, GetState};
use tautline::{CallbackOptions, Node, Publisher, Qos};

const DOMAIN: u32 = 217;

/// Notes what is called, and returns what it was told to.
#[derive(Clone, Default)]
struct Script {
    calls: Arc<Mutex<Vec<&'static str>>>,
    results: Arc<Mutex<Vec<(&'static str, CallbackReturn)>>>,
    publisher: Arc<Mutex<Option<Publisher<Number>>>>,
}

impl Script {
    fn call(&self, name: &'static str, default: CallbackReturn) -> CallbackReturn {
        self.calls.lock().unwrap().push(name);
        let results = self.results.lock().unwrap();
        results.iter().find(|(of, _)| *of == name).map_or(default, |(_, result)| *result)
    }

    fn returns(&self, name: &'static str, result: CallbackReturn) {
        self.results.lock().unwrap().insert(0, (name, result));
    }

    fn calls(&self) -> Vec<&'static str> {
        std::mem::take(&mut *self.calls.lock().unwrap())
    }

    fn publish(&self, value: u64) {
        if let Some(publisher) = &*self.publisher.lock().unwrap() {
            publisher.publish(&Number { value }).unwrap();
        }
    }
}

impl LifecycleCallbacks for Script {
    fn on_configure(&mut self, node: &mut ManagedNode) -> CallbackReturn {
        *self.publisher.lock().unwrap() = Some(node.create_publisher("~/number", Qos::default()).unwrap());
        self.call("configure", CallbackReturn::Success)
    }

    fn on_activate(&mut self, _: &mut ManagedNode) -> CallbackReturn {
        self.publish(100);
        self.call("activate", CallbackReturn::Success)
    }

    fn on_deactivate(&mut self, _: &mut ManagedNode) -> CallbackReturn {
        self.publish(200);
        self.call("deactivate", CallbackReturn::Success)
    }

    fn on_cleanup(&mut self, _: &mut ManagedNode) -> CallbackReturn {
        self.publisher.lock().unwrap().take();
        self.call("cleanup", CallbackReturn::Success)
    }

    fn on_shutdown(&mut self, _: &mut ManagedNode, previous: State) -> CallbackReturn {
        assert!([State::Unconfigured, State::Inactive, State::Active].contains(&previous));
        self.call("shutdown", CallbackReturn::Success)
    }

    fn on_error(&mut self, _: &mut ManagedNode, _: State) -> CallbackReturn {
        self.call("error", CallbackReturn::Failure)
    }
}

fn managed(name: &str) -> (LifecycleNode, Script) {
    let script = Script::default();
    (LifecycleNode::create(context(DOMAIN), name, "", script.clone()).unwrap(), script)
}

fn done(result: CallbackReturn, state: State) -> Result<Transitioned, LifecycleError> {
    Ok(Transitioned { result, state })
}

#[test]
fn publishers_are_silent_unless_the_node_is_active() {
    let (node, script) = managed("quiet");
    let mut other = Node::create(context(DOMAIN), "other", "").unwrap();
    let numbers = other.subscribe::<Number>("/quiet/number", Qos::default()).unwrap();
    // In another context: they may take a moment.
    let take = |count: usize| {
        let mut taken: Vec<u64> = Vec::new();
        eventually("numbers", || {
            taken.extend(std::iter::from_fn(|| numbers.try_take().unwrap().map(|sample| sample.value)));
            taken.len() >= count
        });
        taken
    };
    node.configure().unwrap();
    script.publish(1);
    node.activate().unwrap();
    script.publish(2);
    {
        let publisher = script.publisher.lock().unwrap();
        let mut loan = publisher.as_ref().unwrap().loan().unwrap();
        loan.value = 3;
        loan.publish().unwrap();
    }
    node.deactivate().unwrap();
    script.publish(4);
    let loan_while_silent = || {
        let publisher = script.publisher.lock().unwrap();
        publisher.as_ref().unwrap().loan().unwrap().publish().unwrap();
        publisher.as_ref().unwrap().counters().silenced()
    };
    assert_eq!(loan_while_silent(), 5, "1, 100, 200, 4 and the loan");
    assert_eq!(take(2), [2, 3]);
    node.activate().unwrap();
    script.publish(5);
    assert_eq!(take(1), [5]);
    assert_eq!(numbers.counters().lost(), 0, "what was not sent is not missed");
    node.shutdown().unwrap();
    script.publish(6);
    assert!(take(0).is_empty());
}

#[test]
fn the_way_through_all_states_is_told() {
    let (node, script) = managed("teller");
    let mut other = Node::create(context(DOMAIN), "listener", "").unwrap();
    let qos = Qos::keep_last(20);
    let events = other.subscribe::<TransitionEvent>("/teller/transition_event", qos).unwrap();
    // In another context: they may take a moment.
    let told = |count: usize| {
        let next = || {
            let sample = events.try_take().unwrap()?;
            let event = sample.to_owned();
            assert!(event.timestamp > 0);
            Some((event.transition.id, event.start_state.label, event.goal_state.label))
        };
        let mut told = Vec::new();
        eventually("transitions", || {
            told.extend(std::iter::from_fn(next));
            told.len() >= count
        });
        told
    };
    let event = |id: u8, start: &str, goal: &str| (id, start.to_owned(), goal.to_owned());
    assert_eq!(node.state(), State::Unconfigured);
    assert_eq!(node.configure(), done(CallbackReturn::Success, State::Inactive));
    assert_eq!(told(2), [event(1, "unconfigured", "configuring"), event(10, "configuring", "inactive")]);
    assert_eq!(node.activate(), done(CallbackReturn::Success, State::Active));
    assert_eq!(told(2), [event(3, "inactive", "activating"), event(30, "activating", "active")]);
    assert_eq!(node.deactivate(), done(CallbackReturn::Success, State::Inactive));
    assert_eq!(node.cleanup(), done(CallbackReturn::Success, State::Unconfigured));
    assert_eq!(told(4).len(), 4);
    assert_eq!(node.change_state(5), done(CallbackReturn::Success, State::Finalized));
    assert_eq!(told(2), [event(5, "unconfigured", "shuttingdown"), event(50, "shuttingdown", "finalized")]);
    assert_eq!(script.calls(), ["configure", "activate", "deactivate", "cleanup", "shutdown"]);
    assert!(node.available_transitions().is_empty());
}

#[test]
fn failures_go_back_and_errors_are_processed() {
    let (node, script) = managed("unlucky");
    script.returns("configure", CallbackReturn::Failure);
    assert_eq!(node.configure(), done(CallbackReturn::Failure, State::Unconfigured));
    script.returns("configure", CallbackReturn::Error);
    script.returns("error", CallbackReturn::Success);
    assert_eq!(node.configure(), done(CallbackReturn::Error, State::Unconfigured));
    script.returns("configure", CallbackReturn::Success);
    script.returns("activate", CallbackReturn::Failure);
    node.configure().unwrap();
    assert_eq!(node.activate(), done(CallbackReturn::Failure, State::Inactive));
    script.returns("activate", CallbackReturn::Success);
    script.returns("deactivate", CallbackReturn::Error);
    script.returns("error", CallbackReturn::Failure);
    node.activate().unwrap();
    assert_eq!(node.deactivate(), done(CallbackReturn::Error, State::Finalized));
    let expected =
        ["configure", "configure", "error", "configure", "activate", "activate", "deactivate", "error"];
    assert_eq!(script.calls(), expected);
}

#[test]
fn what_does_not_begin_here_is_refused_and_runs_nothing() {
    let (node, script) = managed("strict");
    for refused in
        [node.activate(), node.deactivate(), node.cleanup(), node.change_state(10), node.change_state(200)]
    {
        let text = refused.unwrap_err().to_string();
        assert!(text.contains("'unconfigured'") && text.contains("configure, shutdown"), "{text}");
    }
    assert_eq!((node.state(), script.calls()), (State::Unconfigured, vec![]));
}

#[test]
fn a_panic_is_an_error_and_a_transition_in_a_transition_is_refused() {
    static SEEN: Log<String> = Log::new();
    struct Careless(Arc<Mutex<Option<LifecycleNode>>>);
    impl LifecycleCallbacks for Careless {
        fn on_configure(&mut self, _: &mut ManagedNode) -> CallbackReturn {
            let node = self.0.lock().unwrap().clone().unwrap();
            SEEN.add(format!("{}: {}", node.state(), node.activate().unwrap_err()));
            panic!("as the test wants");
        }
        fn on_error(&mut self, _: &mut ManagedNode, previous: State) -> CallbackReturn {
            SEEN.add(format!("error of {previous}"));
            CallbackReturn::Success
        }
    }
    let own = Arc::new(Mutex::new(None));
    let node = LifecycleNode::create(context(DOMAIN), "careless", "", Careless(own.clone())).unwrap();
    *own.lock().unwrap() = Some(node.clone());
    assert_eq!(node.configure(), done(CallbackReturn::Error, State::Unconfigured));
    let seen = SEEN.events();
    assert!(seen[0].starts_with("configuring: the node is in state 'configuring'"), "{}", seen[0]);
    assert_eq!(seen[1], "error of unconfigured");
    own.lock().unwrap().take();
}

/// Is configured when the gate is opened.
struct Slow;

static CONFIGURE: Gate = Gate::new();

impl LifecycleCallbacks for Slow {
    fn on_configure(&mut self, _: &mut ManagedNode) -> CallbackReturn {
        CONFIGURE.pass();
        CallbackReturn::Success
    }
}

#[test]
fn its_state_is_told_while_a_callback_runs() {
    let context = context(55);
    let _sampler = spin(&context);
    let node = LifecycleNode::create(context.clone(), "slow", "", Slow).unwrap();
    let (changes, states) = (node.serve_changes().unwrap(), node.serve_states().unwrap());
    let spawn = |future| {
        let options = CallbackOptions::other().stack_bytes(8 << 20);
        node.with_node(|node| node.spawn_callback(options, future)).unwrap().unwrap()
    };
    let callbacks = [spawn(changes.boxed()), spawn(states.boxed())];
    let mut other = Node::create(context, "manager", "").unwrap();
    let change = other.create_client::<ChangeState::Service>("/slow/change_state").unwrap();
    let state = other.create_client::<GetState::Service>("/slow/get_state").unwrap();
    for available in [change.wait_for_service().unwrap().boxed(), state.wait_for_service().unwrap().boxed()] {
        block_on(available).unwrap();
    }
    let mut request = ChangeState::Request::default();
    request.transition.id = 1;
    let configured = change.request(&request).unwrap();
    let now = || block_on(state.request(&GetState::Request::default()).unwrap()).unwrap().current_state.label;
    let mut seen = now();
    while seen == "unconfigured" {
        seen = now();
    }
    assert_eq!(seen, "configuring");
    CONFIGURE.open();
    assert!(block_on(configured).unwrap().success);
    assert_eq!(now(), "inactive");
    for callback in callbacks {
        callback.stop();
        callback.join().unwrap();
    }
}

#[cfg(all(feature = "untyped", feature = "std_msgs"))]
#[test]
fn untyped_publishers_are_silent_while_it_is_not_active() {
    let node = LifecycleNode::create(context(55), "untyped", "", Script::default()).unwrap();
    let create = |node: &mut ManagedNode| {
        node.create_publisher_untyped("~/text", "std_msgs/msg/String", Qos::default())
    };
    let publisher = node.with_node(create).unwrap().unwrap();
    let say = || publisher.publish(&tautline::Json(serde_json::json!({ "data": "here" }))).unwrap();
    let silenced = || publisher.counters().silenced();
    say();
    node.configure().unwrap();
    say();
    assert_eq!(silenced(), 2);
    node.activate().unwrap();
    say();
    assert_eq!(silenced(), 2, "it speaks");
    node.deactivate().unwrap();
    say();
    assert_eq!(silenced(), 3);
}

#[test]
fn its_services_are_ros_2s() {
    let context = context(DOMAIN);
    let _sampler = spin(&context);
    let script = Script::default();
    let node = LifecycleNode::create(context.clone(), "served", "", script.clone()).unwrap();
    let serve = node.serve().unwrap();
    let callback = node
        .with_node(|node| node.spawn_callback(CallbackOptions::other().stack_bytes(8 << 20), serve))
        .unwrap()
        .unwrap();

    let mut other = Node::create(context.clone(), "manager", "").unwrap();
    let change = other.create_client::<ChangeState::Service>("/served/change_state").unwrap();
    let state = other.create_client::<GetState::Service>("/served/get_state").unwrap();
    let states = other.create_client::<GetAvailableStates::Service>("/served/get_available_states").unwrap();
    let [transitions, graph] = ["available_transitions", "transition_graph"].map(|name| {
        other.create_client::<GetAvailableTransitions::Service>(&format!("/served/get_{name}")).unwrap()
    });
    block_on(change.wait_for_service().unwrap()).unwrap();
    let ask = |id: u8, label: &str| {
        let mut request = ChangeState::Request::default();
        (request.transition.id, request.transition.label) = (id, label.to_owned());
        block_on(change.request(&request).unwrap()).unwrap().success
    };
    let now = || block_on(state.request(&GetState::Request::default()).unwrap()).unwrap().current_state.label;
    let possible = |client: &tautline::Client<GetAvailableTransitions::Service>| {
        let response = block_on(client.request(&Default::default()).unwrap()).unwrap();
        response.available_transitions.into_iter().map(|found| found.transition.label).collect::<Vec<_>>()
    };
    assert!(!ask(3, ""), "not from here");
    assert_eq!(now(), "unconfigured");
    assert!(ask(1, ""));
    assert_eq!(
        (now(), possible(&transitions)),
        ("inactive".into(), vec!["cleanup".into(), "activate".into(), "shutdown".into()])
    );
    assert!(!ask(3, "no such"), "the name counts");
    assert!(ask(0, "activate"), "by name");
    script.returns("deactivate", CallbackReturn::Failure);
    assert!(!ask(4, ""), "its callback failed");
    assert_eq!((now(), node.state()), ("active".into(), State::Active));
    assert_eq!(possible(&graph).len(), 25);
    let known = block_on(states.request(&Default::default()).unwrap()).unwrap().available_states;
    assert_eq!(known.len(), 11);
    assert_eq!(script.calls(), ["configure", "activate", "deactivate"]);
    callback.stop();
    callback.join().unwrap();
}
