// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services and actions between nodes of ours and hiroz, another implementation of the wire, through the gateway.

#[path = "../../tests/support/mod.rs"]
mod support;

use futures::executor::block_on;
use futures::{FutureExt, StreamExt};
use hiroz::Builder;
use hiroz::action::ZAction;
use hiroz::action::server::ExecutingGoal;
use hiroz::context::{ZContext, ZContextBuilder};
use hiroz::entity::{TypeHash, TypeInfo};
use hiroz::node::ZNode;
use hiroz_msgs::example_interfaces::action::Fibonacci as TheirFibonacci;
use hiroz_msgs::example_interfaces::{FibonacciFeedback, FibonacciGoal, FibonacciResult};
use hiroz_msgs::std_srvs::srv::SetBool as TheirSetBool;
use hiroz_msgs::std_srvs::{SetBoolRequest, SetBoolResponse};
use support::{Host, wait};
use tautline::action_msgs::srv::CancelGoal;
use tautline::example_interfaces::action::Fibonacci;
use tautline::std_srvs::srv::SetBool;
use tautline::{
    ActionServerGoalRequest, CallbackOptions, Context, GoalStatus, Node, Qos, Realtime, Service,
    ServiceRequest,
};

/// Between two messages of feedback.
const PAUSE: std::time::Duration = std::time::Duration::from_millis(5);

/// A host with a node of ours that spins, and a node of theirs beside it.
struct Pair {
    context: Context,
    spinning: Option<std::thread::JoinHandle<()>>,
    ours: Node,
    theirs: ZNode,
    _their_context: ZContext,
    _host: Host,
}

impl Pair {
    fn new(domain: u32) -> Self {
        let host = Host::first(domain, domain);
        let their_context = ZContextBuilder::default()
            .with_mode("client")
            .with_connect_endpoints([host.locator()])
            .with_domain_id(domain as usize)
            .disable_multicast_scouting()
            .build()
            .unwrap();
        let theirs = their_context.create_node("their_node").without_parameters().build().unwrap();
        let context = Context::builder().domain(domain).realtime(Realtime::Off).build().unwrap();
        let ours = Node::create(context.clone(), "our_node", "").unwrap();
        let sampler = context.clone();
        let spinning = Some(std::thread::spawn(move || sampler.spin().unwrap()));
        Pair { context, spinning, ours, theirs, _their_context: their_context, _host: host }
    }
}

impl Drop for Pair {
    fn drop(&mut self) {
        self.context.shutdown();
        if let Some(spinning) = self.spinning.take() {
            let _ = spinning.join();
        }
    }
}

/// Theirs, with ROS 2's hash of `action_msgs/srv/CancelGoal`: that of their definition is another one.
struct RosFibonacci;

impl ZAction for RosFibonacci {
    type Goal = FibonacciGoal;
    type Result = FibonacciResult;
    type Feedback = FibonacciFeedback;

    fn name() -> &'static str {
        TheirFibonacci::name()
    }

    fn send_goal_type_info() -> TypeInfo {
        TheirFibonacci::send_goal_type_info()
    }

    fn get_result_type_info() -> TypeInfo {
        TheirFibonacci::get_result_type_info()
    }

    fn cancel_goal_type_info() -> TypeInfo {
        let hash = TypeHash::from_rihs_string(<CancelGoal::Service as Service>::TYPE_HASH).unwrap();
        TypeInfo::new("action_msgs::srv::dds_::CancelGoal_", hash)
    }

    fn feedback_type_info() -> TypeInfo {
        TheirFibonacci::feedback_type_info()
    }

    fn status_type_info() -> TypeInfo {
        TheirFibonacci::status_type_info()
    }
}

fn numbers(order: i32) -> Vec<i32> {
    let mut sequence = vec![0, 1];
    for n in 1..order as usize {
        sequence.push(sequence[n] + sequence[n - 1]);
    }
    sequence
}

#[test]
fn a_service_each_way() {
    let mut pair = Pair::new(68);
    let mut server = pair.theirs.create_service::<TheirSetBool>("/theirs/switch").build().unwrap();
    let client = pair.ours.create_client::<SetBool::Service>("/theirs/switch").unwrap();
    block_on(client.wait_for_service().unwrap()).unwrap();
    for data in [true, false] {
        let response = client.request(&SetBool::Request { data }).unwrap();
        let request = wait("our request", || server.try_take_request().unwrap());
        assert_eq!(request.message().data, data);
        request.reply_blocking(&SetBoolResponse { success: data, message: "théirs".into() }).unwrap();
        let response = block_on(response).unwrap();
        assert_eq!((response.success, response.message.as_str()), (data, "théirs"));
    }

    let requests =
        pair.ours.create_service::<SetBool::Service>("/ours/switch", Qos::default()).unwrap().owned();
    let answer = |request: ServiceRequest<SetBool::Service>| async move {
        let success = request.message.data;
        request.respond(SetBool::Response { success, message: "Grüße".into() }).unwrap();
    };
    pair.ours.spawn_callback(CallbackOptions::other(), requests.for_each(answer)).unwrap();
    let client = pair.theirs.create_client::<TheirSetBool>("/ours/switch").build().unwrap();
    for data in [true, false] {
        // Without a server it ends at once.
        let response = wait("our service", || block_on(client.call(&SetBoolRequest { data })).ok());
        assert_eq!((response.success, response.message.as_str()), (data, "Grüße"));
    }
}

#[test]
fn our_goals_for_their_server() {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let _entered = runtime.enter();
    let mut pair = Pair::new(69);
    let server = pair.theirs.create_action_server::<RosFibonacci>("/theirs/fibonacci").build().unwrap();
    let _server = server.with_handler(|goal: ExecutingGoal<RosFibonacci>| async move {
        let order = goal.goal.order;
        for n in 2..=order.min(5) {
            goal.publish_feedback(FibonacciFeedback { sequence: numbers(n) }).unwrap();
        }
        goal.succeed(FibonacciResult { sequence: numbers(order) }).unwrap();
    });
    let client = pair.ours.create_action_client::<Fibonacci::Action>("/theirs/fibonacci").unwrap();
    block_on(client.wait_for_action_server().unwrap()).unwrap();
    let goal = client.send_goal_request(Fibonacci::Goal { order: 5 }).unwrap();
    let (goal, result, feedback) = block_on(goal).unwrap();
    let (status, result) = block_on(result).unwrap();
    assert_eq!((status, result.sequence), (GoalStatus::Succeeded, numbers(5)));
    assert_eq!(goal.status(), GoalStatus::Succeeded);
    // What was published before the network knew of us, or was overtaken by the result, is lost.
    let feedback: Vec<_> = block_on(feedback.map(|feedback| feedback.sequence).collect());
    assert!(feedback.iter().all(|heard| (2..=5).any(|n| *heard == numbers(n))), "{feedback:?}");
    // Too late. While a goal goes on whose result was asked for, their server takes no request to cancel it.
    assert!(block_on(goal.cancel().unwrap()).is_err());
}

#[test]
fn their_goals_for_our_server() {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let _entered = runtime.enter();
    let mut pair = Pair::new(70);
    let goals = pair.ours.create_action_server::<Fibonacci::Action>("/ours/fibonacci").unwrap();
    let pursue = |request: ActionServerGoalRequest<Fibonacci::Action>| async move {
        let order = request.goal.order;
        if order == 0 {
            return request.reject().unwrap();
        }
        let (mut goal, mut cancels) = request.accept().unwrap();
        for n in 2..=order.min(5) {
            goal.publish_feedback(Fibonacci::Feedback { sequence: numbers(n) }).unwrap();
        }
        if order < 100 {
            return goal.succeed(Fibonacci::Result { sequence: numbers(order) }).unwrap();
        }
        // Until somebody has heard of it.
        let cancel = loop {
            goal.publish_feedback(Fibonacci::Feedback { sequence: numbers(5) }).unwrap();
            match cancels.next().now_or_never() {
                Some(cancel) => break cancel.unwrap(),
                None => std::thread::sleep(PAUSE),
            }
        };
        cancel.accept();
        goal.cancel(Fibonacci::Result { sequence: vec![order] }).unwrap();
    };
    pair.ours.spawn_callback(CallbackOptions::other(), goals.for_each_concurrent(None, pursue)).unwrap();
    let client = pair.theirs.create_action_client::<RosFibonacci>("/ours/fibonacci").build().unwrap();
    runtime.block_on(async {
        assert!(client.wait_for_server(std::time::Duration::from_secs(20)).await);
        let goal = client.send_goal(FibonacciGoal { order: 5 }).await.unwrap();
        assert_eq!(goal.result().await.unwrap().sequence, numbers(5));
        assert!(client.send_goal(FibonacciGoal { order: 0 }).await.is_err(), "rejected");
        let mut goal = client.send_goal(FibonacciGoal { order: 100 }).await.unwrap();
        let mut feedback = goal.feedback().unwrap();
        let heard = feedback.recv().await.unwrap().sequence;
        assert!((2..=5).any(|n| heard == numbers(n)), "{heard:?}");
        let cancelled = goal.cancel().await.unwrap();
        assert_eq!((cancelled.return_code, cancelled.goals_canceling.len()), (0, 1));
        assert_eq!(goal.result().await.unwrap().sequence, [100]);
    });
}
