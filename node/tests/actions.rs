// SPDX-License-Identifier: MIT OR Apache-2.0
//! Actions: goals accepted, rejected, pursued, cancelled, forgotten; with Rust types and as JSON.
#![cfg(all(feature = "action_msgs", feature = "example_interfaces"))]

mod common;

use std::time::Duration;

use common::{Log, context, eventually, spinning_node};
use futures::executor::block_on;
use futures::future::{Either, select};
use futures::stream::BoxStream;
use futures::{FutureExt, StreamExt};
use tautline::action_msgs::srv::CancelGoal;
use tautline::example_interfaces::action::Fibonacci;
use tautline::{
    ActionClient, ActionServerCancelRequest, ActionServerGoal, ActionServerGoalRequest, ActionServerOptions,
    CallbackOptions, Error, GoalStatus, MAX_PENDING_REQUESTS, Node, Qos,
};

type Goal = ActionServerGoal<Fibonacci::Action>;
type GoalRequest = ActionServerGoalRequest<Fibonacci::Action>;

fn numbers(order: i32) -> Vec<i32> {
    let mut sequence = vec![0, 1];
    for n in 1..order as usize {
        sequence.push(sequence[n] + sequence[n - 1]);
    }
    sequence
}

/// A server whose goals of order 0 are rejected, of order 1 dropped, of order 2 aborted; those of more than 100 wait until they are
/// cancelled, of which those over 200 reject it; the others succeed.
fn serve(node: &mut Node, name: &str) {
    let goals = node.create_action_server::<Fibonacci::Action>(name).unwrap();
    let answer = goals.for_each_concurrent(None, |request: GoalRequest| async move {
        match request.goal.order {
            0 => request.reject().unwrap(),
            1 => drop(request),
            2 => {
                let (mut goal, _cancel) = request.accept().unwrap();
                goal.abort(Fibonacci::Result { sequence: vec![2] }).unwrap();
                assert!(goal.succeed(Fibonacci::Result::default()).is_err(), "it has ended");
                assert!(goal.publish_feedback(Fibonacci::Feedback::default()).is_err());
            }
            3 => drop(request.accept().unwrap()),
            101.. => {
                let (mut goal, mut cancels) = request.accept().unwrap();
                goal.publish_feedback(Fibonacci::Feedback { sequence: vec![100] }).unwrap();
                assert!(goal.cancel(Fibonacci::Result::default()).is_err(), "nobody asked for that");
                let cancel = cancels.next().await.unwrap();
                assert_eq!(cancel.uuid, goal.uuid);
                if goal.goal.order > 200 {
                    cancel.reject();
                    goal.succeed(Fibonacci::Result { sequence: vec![200] }).unwrap();
                } else {
                    assert!(!goal.is_cancelling());
                    cancel.accept();
                    assert!(goal.is_cancelling());
                    goal.publish_feedback(Fibonacci::Feedback { sequence: vec![101] }).unwrap();
                    goal.cancel(Fibonacci::Result { sequence: vec![100] }).unwrap();
                }
                assert!(cancels.next().await.is_none(), "it ends with the goal");
            }
            order => {
                let (mut goal, _cancel) = request.accept().unwrap();
                for n in 1..order {
                    goal.publish_feedback(Fibonacci::Feedback { sequence: numbers(n + 1) }).unwrap();
                }
                goal.succeed(Fibonacci::Result { sequence: numbers(order) }).unwrap();
            }
        }
    });
    node.spawn_callback(CallbackOptions::other(), answer).unwrap();
}

fn client(node: &mut Node, name: &str) -> ActionClient<Fibonacci::Action> {
    let client = node.create_action_client(name).unwrap();
    block_on(client.wait_for_action_server().unwrap()).unwrap();
    client
}

#[test]
fn goals_and_their_ends() {
    let (mut node, _spinning) = spinning_node(165, "acting");
    serve(&mut node, "ends");
    let client = client(&mut node, "ends");
    let run = |order| {
        block_on(async {
            let sent = client.send_goal_request(Fibonacci::Goal { order }).unwrap();
            let (goal, result, feedback) = sent.await?;
            let feedback: Vec<_> = feedback.map(|feedback| feedback.sequence).collect().await;
            let (status, result) = result.await?;
            assert_eq!(goal.status(), status);
            // A goal that has ended.
            let error = goal.cancel().unwrap().await.unwrap_err();
            assert!(matches!(error, Error::GoalCancelAlreadyTerminated), "{error}");
            Ok::<_, Error>((status, result.sequence, feedback))
        })
    };
    for _ in 0..3 {
        let feedback: Vec<_> = (2..=8).map(numbers).collect();
        assert_eq!(run(8).unwrap(), (GoalStatus::Succeeded, numbers(8), feedback));
        assert_eq!(run(2).unwrap(), (GoalStatus::Aborted, vec![2], vec![]));
        assert_eq!(run(3).unwrap(), (GoalStatus::Aborted, vec![], vec![]), "its handle was dropped");
        for rejected in [0, 1] {
            let error = run(rejected).unwrap_err();
            assert!(matches!(error, Error::GoalRejected { .. }), "{error}");
            assert!(error.to_string().contains("'/ends'"), "{error}");
        }
    }
}

#[test]
fn cancelling() {
    let (mut node, _spinning) = spinning_node(167, "acting");
    serve(&mut node, "cancelled");
    let client = client(&mut node, "cancelled");
    let run = |order| {
        block_on(async {
            let sent = client.send_goal_request(Fibonacci::Goal { order }).unwrap();
            let (goal, result, mut feedback) = sent.await.unwrap();
            assert_eq!(feedback.next().await.unwrap().sequence, [100]);
            let cancelled = goal.clone().cancel().unwrap().await;
            let (status, result) = result.await.unwrap();
            (cancelled.is_ok(), status, result.sequence, feedback.count().await)
        })
    };
    assert_eq!(run(101), (true, GoalStatus::Canceled, vec![100], 1));
    assert_eq!(run(201), (false, GoalStatus::Succeeded, vec![200], 0));
}

#[test]
fn results_expire_and_goals_are_forgotten() {
    let (mut node, _spinning) = spinning_node(168, "acting");
    let options =
        ActionServerOptions { result_timeout: Duration::from_millis(10), ..ActionServerOptions::default() };
    let goals = node.create_action_server_with::<Fibonacci::Action>("forgetful", options).unwrap();
    let answer = goals.for_each(|request| async move {
        let (mut goal, _cancel) = request.accept().unwrap();
        goal.succeed(Fibonacci::Result::default()).unwrap();
    });
    node.spawn_callback(CallbackOptions::other(), answer).unwrap();
    let client = client(&mut node, "forgetful");
    block_on(async {
        let sent = client.send_goal_request(Fibonacci::Goal { order: 1 }).unwrap();
        let (goal, result, _feedback) = sent.await.unwrap();
        result.await.unwrap();
        // As a client that came too late.
        loop {
            match goal.cancel().unwrap().await {
                Err(Error::GoalCancelAlreadyTerminated) => {}
                Err(Error::GoalCancelUnknownGoalID) => break,
                other => panic!("{other:?}"),
            }
        }
    });
}

#[test]
fn a_server_that_goes_ends_what_waits_for_it() {
    let (mut node, _spinning) = spinning_node(169, "acting");
    let lonely = node.create_action_client::<Fibonacci::Action>("gone").unwrap();
    let error = lonely.send_goal_request(Fibonacci::Goal { order: 1 }).err().unwrap();
    assert!(error.to_string().contains("'/gone/_action/send_goal' has no server"), "{error}");

    let mut goals = node.create_action_server::<Fibonacci::Action>("gone").unwrap();
    let client = client(&mut node, "gone");
    let sent = client.send_goal_request(Fibonacci::Goal { order: 1 }).unwrap();
    let (goal, cancels) = block_on(accept(&mut goals));
    let (_handle, result, feedback) = block_on(sent).unwrap();
    // The goal goes on without the stream of goals, but new ones are rejected.
    drop(goals);
    goal.publish_feedback(Fibonacci::Feedback { sequence: vec![5] }).unwrap();
    let error = block_on(client.send_goal_request(Fibonacci::Goal { order: 1 }).unwrap()).err().unwrap();
    assert!(matches!(error, Error::GoalRejected { .. }), "{error}");
    drop((goal, cancels));
    let (status, _) = block_on(result).unwrap();
    assert_eq!(status, GoalStatus::Aborted);
    assert_eq!(block_on(feedback.map(|feedback| feedback.sequence).collect::<Vec<_>>()), [[5]]);
    // With the last goal the server has gone.
    eventually("the server to go", || client.send_goal_request(Fibonacci::Goal { order: 1 }).is_err());
}

#[test]
fn a_goal_is_known_as_long_as_somebody_asks_about_it() {
    let (mut node, spinning) = spinning_node(64, "acting");
    let client = node.create_action_client::<Fibonacci::Action>("known").unwrap();
    let known = |client: &ActionClient<_>, n: usize| {
        assert!(format!("{client:?}").contains(&format!("goals: {n}")), "{client:?}");
    };
    assert!(client.send_goal_request(Fibonacci::Goal { order: 1 }).is_err(), "there is no server");
    known(&client, 0);
    serve(&mut node, "known");
    block_on(client.wait_for_action_server().unwrap()).unwrap();
    for order in [0, 8] {
        drop(client.send_goal_request(Fibonacci::Goal { order }).unwrap());
        known(&client, 0);
    }
    assert!(block_on(client.send_goal_request(Fibonacci::Goal { order: 0 }).unwrap()).is_err());
    known(&client, 0);
    let send = |order| block_on(client.send_goal_request(Fibonacci::Goal { order }).unwrap()).unwrap();
    let (goal, result, feedback) = send(8);
    drop((goal, result));
    assert_eq!(block_on(feedback.count()), 7, "who only reads the feedback reads all of it");
    known(&client, 0);

    // The result and the feedback come though the client and the handle have gone.
    let (goal, result, mut feedback) = send(101);
    assert_eq!(block_on(feedback.next()).unwrap().sequence, [100]);
    let cancelled = goal.cancel().unwrap();
    let (_, late_result, late_feedback) = send(102);
    drop((goal, client));
    block_on(cancelled).unwrap();
    let (status, _) = block_on(result).unwrap();
    assert_eq!((status, block_on(feedback.count())), (GoalStatus::Canceled, 1));
    // Unless the context ends: then they end, with an error, or with what the server says of its goal when that is dropped.
    drop((spinning, node));
    assert!(block_on(late_feedback.count()) <= 1);
    assert!(block_on(late_result).map_or(true, |(status, _)| status == GoalStatus::Aborted));
}

#[test]
fn a_request_to_cancel_that_nobody_decided_on_ends_with_the_goal() {
    let (mut node, _spinning) = spinning_node(65, "acting");
    let mut goals = node.create_action_server::<Fibonacci::Action>("undecided").unwrap();
    let client = client(&mut node, "undecided");
    let sent = client.send_goal_request(Fibonacci::Goal { order: 1 }).unwrap();
    let (mut goal, mut cancels) = block_on(accept(&mut goals));
    let (handle, result, _feedback) = block_on(sent).unwrap();
    let [first, second] = [(); 2].map(|()| handle.cancel().unwrap());
    let undecided = block_on(cancels.next()).unwrap();
    assert!(cancels.next().now_or_never().is_none(), "both wait for one decision");
    goal.succeed(Fibonacci::Result::default()).unwrap();
    for cancelled in [first, second] {
        let error = block_on(cancelled).unwrap_err();
        // The latter if the request came after the end.
        let is_refused = matches!(error, Error::GoalCancelRejected | Error::GoalCancelAlreadyTerminated);
        assert!(is_refused, "{error}");
    }
    undecided.accept();
    assert_eq!(block_on(result).unwrap().0, GoalStatus::Succeeded);
    // Neither that request nor the stream of them keeps the server there.
    drop((goal, goals));
    eventually("the server to go", || client.send_goal_request(Fibonacci::Goal { order: 1 }).is_err());
    drop(cancels);
}

#[test]
fn feedback_that_nobody_reads_is_not_kept_for_ever() {
    let (mut node, _spinning) = spinning_node(71, "acting");
    let mut goals = node.create_action_server::<Fibonacci::Action>("talkative").unwrap();
    let client = client(&mut node, "talkative");
    let sent = client.send_goal_request(Fibonacci::Goal { order: 1 }).unwrap();
    let (mut goal, _cancels) = block_on(accept(&mut goals));
    let (_handle, result, feedback) = block_on(sent).unwrap();
    let all = node.subscribe::<Fibonacci::FeedbackMessage>("talkative/_action/feedback", Qos::default());
    let mut all = all.unwrap();
    for n in 0..2500 {
        goal.publish_feedback(Fibonacci::Feedback { sequence: vec![n] }).unwrap();
        block_on(all.next()).unwrap();
    }
    goal.succeed(Fibonacci::Result::default()).unwrap();
    block_on(result).unwrap();
    let heard: Vec<_> = block_on(feedback.map(|feedback| feedback.sequence[0]).collect());
    // A thousand are kept for who asked; as many wait in the topic's queue if the thread that moves them has not come to it.
    assert!((1..=2001).contains(&heard.len()), "{}", heard.len());
    assert!(heard.is_sorted() && heard[0] <= 1500, "the first ones: {heard:?}");
}

/// What the thread that listens has no time for waits, as much as its queue holds, whoever made the topic.
#[test]
fn feedback_waits_in_a_queue_of_a_thousand() {
    let mut node = Node::create(context(50), "acting", "").unwrap();
    let depths = |node: &Node, topic: &str| -> Vec<_> {
        let ends = node.get_subscriptions_info_by_topic(topic).unwrap();
        ends.iter().map(|end| end.qos.depth).collect()
    };
    let _goals = node.create_action_server::<Fibonacci::Action>("deep").unwrap();
    let _client = node.create_action_client::<Fibonacci::Action>("deep").unwrap();
    assert_eq!(depths(&node, "/deep/_action/feedback"), [1000]);
    let topic = "shallow/_action/feedback";
    let _first = node.create_publisher::<Fibonacci::FeedbackMessage>(topic, Qos::default()).unwrap();
    let _client = node.create_action_client::<Fibonacci::Action>("shallow").unwrap();
    assert_eq!(depths(&node, "/shallow/_action/feedback"), [1000]);
}

#[test]
fn all_who_ask_to_cancel_before_a_decision_share_it() {
    let (mut node, _spinning) = spinning_node(51, "acting");
    let mut goals = node.create_action_server::<Fibonacci::Action>("asked").unwrap();
    let client = client(&mut node, "asked");
    let sent = client.send_goal_request(Fibonacci::Goal { order: 1 }).unwrap();
    let (goal, mut cancels) = block_on(accept(&mut goals));
    let _waiting = block_on(sent).unwrap();
    let service = "asked/_action/cancel_goal";
    let canceller = node.create_client::<CancelGoal::Service>(service).unwrap();
    let ask = |uuid: [u8; 16]| {
        let mut request = CancelGoal::Request::default();
        request.goal_info.goal_id.uuid = uuid;
        canceller.request(&request).unwrap()
    };
    for _ in 0..3 {
        let asked = [(); 3].map(|()| ask(goal.uuid.into_bytes()));
        // Answered at once, after those before it were taken.
        assert_eq!(block_on(ask([9; 16])).unwrap().return_code, 2, "unknown goal");
        block_on(cancels.next()).unwrap().reject();
        for answer in asked {
            assert_eq!(block_on(answer).unwrap().return_code, 1, "rejected");
        }
    }
    assert!(cancels.next().now_or_never().is_none());
}

/// Goals that were accepted, with what keeps them going.
async fn accept(goals: &mut (impl futures::Stream<Item = GoalRequest> + Unpin)) -> (Goal, Cancels) {
    let (goal, cancels) = goals.next().await.unwrap().accept().unwrap();
    (goal, cancels.boxed())
}

type Cancels = BoxStream<'static, ActionServerCancelRequest>;

#[test]
fn a_goal_too_many_is_not_sent() {
    let (mut node, _spinning) = spinning_node(48, "acting");
    let mut goals = node.create_action_server::<Fibonacci::Action>("many").unwrap();
    let client = client(&mut node, "many");
    let send = || client.send_goal_request(Fibonacci::Goal { order: 1 });
    let (mut pursued, mut waiting) = (vec![], vec![]);
    for _ in 0..MAX_PENDING_REQUESTS {
        let sent = send().unwrap();
        pursued.push(block_on(accept(&mut goals)));
        waiting.push(block_on(sent).unwrap());
    }
    let error = send().err().unwrap();
    assert!(matches!(error, Error::TooManyGoals { max: MAX_PENDING_REQUESTS, .. }), "{error}");
    assert!(error.to_string().contains("'/many'"), "{error}");

    // Who drops the result alone still reads the feedback to its end, which the result tells.
    let (handle, result, feedback) = waiting.pop().unwrap();
    drop(result);
    assert!(send().is_err());
    drop(feedback);
    let sent = send().unwrap();
    pursued.push(block_on(accept(&mut goals)));
    waiting.push(block_on(sent).unwrap());
    drop(handle);
    // A goal that ends gives its place back, too.
    pursued[0].0.succeed(Fibonacci::Result::default()).unwrap();
    let (_handle, result, _feedback) = waiting.remove(0);
    block_on(result).unwrap();
    let _sent = send().unwrap();
    let _pursued = block_on(accept(&mut goals));
    assert!(goals.next().now_or_never().is_none(), "those that were refused did not come");
}

#[test]
fn a_goal_whose_result_cannot_be_asked_for_is_cancelled() {
    let (mut node, _spinning) = spinning_node(49, "acting");
    let mut goals = node.create_action_server::<Fibonacci::Action>("unheard").unwrap();
    let client = client(&mut node, "unheard");
    let send = || client.send_goal_request(Fibonacci::Goal { order: 1 }).unwrap();
    let (first, second) = (send(), send());
    let _first_goal = block_on(accept(&mut goals));
    let (second_goal, mut cancels) = block_on(accept(&mut goals));
    let _first = block_on(first).unwrap();
    // Each waits in a place of every service of the action.
    let _waits: Vec<_> =
        (1..MAX_PENDING_REQUESTS).map(|_| client.wait_for_action_server().unwrap()).collect();
    let error = block_on(second).err().unwrap();
    assert!(matches!(error, Error::GoalUnheard { .. }), "{error}");
    assert!(error.to_string().contains("was asked to cancel it"), "{error}");
    assert_eq!(block_on(cancels.next()).unwrap().uuid, second_goal.uuid);
}

#[test]
fn two_clients_hear_of_their_own_goals() {
    static HEARD: Log<(usize, Vec<i32>)> = Log::new();
    let (mut node, _spinning) = spinning_node(53, "acting");
    serve(&mut node, "shared");
    let clients = [client(&mut node, "shared"), client(&mut node, "shared")];
    for (index, client) in clients.iter().cloned().enumerate() {
        let run = async move {
            for order in [4, 9] {
                let order = order + index as i32;
                let sent = client.send_goal_request(Fibonacci::Goal { order }).unwrap();
                let (_goal, result, feedback) = sent.await.unwrap();
                let last = feedback.fold(vec![], |_, feedback| async { feedback.sequence }).await;
                assert_eq!(last, numbers(order));
                HEARD.add((index, result.await.unwrap().1.sequence));
            }
        };
        node.spawn_callback(CallbackOptions::other(), run).unwrap();
    }
    let mut heard = HEARD.wait_for(4);
    heard.sort();
    assert_eq!(heard, [(0, numbers(4)), (0, numbers(9)), (1, numbers(5)), (1, numbers(10))]);
}

#[cfg(feature = "untyped")]
#[test]
fn goals_as_json() {
    use serde_json::json;
    let (mut node, _spinning) = spinning_node(198, "acting");
    serve(&mut node, "json");
    let client = node.create_action_client_untyped("json", "example_interfaces/action/Fibonacci").unwrap();
    block_on(async {
        client.wait_for_action_server().unwrap().await.unwrap();
        let sent = client.send_goal_request(json!({ "order": 5 })).unwrap();
        let (goal, result, feedback) = sent.await.unwrap();
        let feedback: Vec<_> = feedback.map(Result::unwrap).collect().await;
        assert_eq!((feedback.len(), &feedback[0]), (4, &json!({ "sequence": [0, 1, 1] })));
        let (status, result) = result.await.unwrap();
        assert_eq!((status, result.unwrap()), (GoalStatus::Succeeded, json!({ "sequence": numbers(5) })));
        assert_eq!(goal.status(), GoalStatus::Succeeded);
        assert!(goal.cancel().unwrap().await.is_err());
        let error = client.send_goal_request(json!({ "orders": 5 })).err().unwrap().to_string();
        assert!(error.contains("orders"), "{error}");
    });
    let error = node.create_action_client_untyped("json", "no_msgs/action/None").unwrap_err().to_string();
    assert!(error.contains("no_msgs/action/None"), "{error}");
}

/// A cancel request that comes while the goal's own work goes on, as in r2r's example.
#[test]
fn work_and_cancel_requests_side_by_side() {
    let (mut node, _spinning) = spinning_node(54, "acting");
    let mut goals = node.create_action_server::<Fibonacci::Action>("beside").unwrap();
    let mut timer = node.create_wall_timer(Duration::from_secs(3600)).unwrap();
    let serve = async move {
        let (mut goal, mut cancels) = goals.next().await.unwrap().accept().unwrap();
        let work = async { timer.tick().await }.boxed();
        match select(work, cancels.next()).await {
            Either::Left(_) => unreachable!("an hour"),
            Either::Right((request, _)) => ActionServerCancelRequest::accept(request.unwrap()),
        }
        goal.cancel(Fibonacci::Result::default()).unwrap();
    };
    let served = node.spawn_callback(CallbackOptions::other(), serve).unwrap();
    let client = client(&mut node, "beside");
    block_on(async {
        let sent = client.send_goal_request(Fibonacci::Goal { order: 1 }).unwrap();
        let (goal, result, _feedback) = sent.await.unwrap();
        goal.cancel().unwrap().await.unwrap();
        assert_eq!(result.await.unwrap().0, GoalStatus::Canceled);
    });
    served.join().unwrap();
}
