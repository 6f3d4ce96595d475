// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut action`: goals that are reached, refused, given up and cancelled.

mod support;

use futures::StreamExt;
use serde_json::{Value, json};
use support::{Here, said};
use tautline::example_interfaces::action::Fibonacci;
use tautline::{ActionServerGoalRequest, Node};

/// A negative order is rejected, 0 is aborted, 100 waits until it is cancelled, and 101 refuses that.
async fn serve(mut goals: impl futures::Stream<Item = ActionServerGoalRequest<Fibonacci::Action>> + Unpin) {
    while let Some(request) = goals.next().await {
        let order = request.goal.order;
        if order < 0 {
            request.reject().unwrap();
            continue;
        }
        let (mut goal, mut cancels) = request.accept().unwrap();
        let mut sequence = vec![0, 1];
        if order >= 100 {
            goal.publish_feedback(Fibonacci::Feedback { sequence: sequence.clone() }).unwrap();
            while let Some(cancel) = cancels.next().await {
                if order == 100 {
                    cancel.accept();
                    goal.cancel(Fibonacci::Result { sequence }).unwrap();
                    break;
                }
                cancel.reject();
            }
            continue;
        }
        for n in 1..order as usize {
            sequence.push(sequence[n] + sequence[n - 1]);
            goal.publish_feedback(Fibonacci::Feedback { sequence: sequence.clone() }).unwrap();
        }
        match order {
            0 => goal.abort(Fibonacci::Result { sequence }).unwrap(),
            _ => goal.succeed(Fibonacci::Result { sequence }).unwrap(),
        }
    }
}

fn server(here: &mut Here) -> Node {
    let mut node = here.node("counter", "/robot");
    let goals = node.create_action_server::<Fibonacci::Action>("/robot/fibonacci").unwrap();
    here.serve(&mut node, serve(goals));
    node
}

#[test]
fn goals_are_sent_by_hand() {
    let mut here = Here::new(45);
    let mut node = server(&mut here);
    let _client = node.create_action_client::<Fibonacci::Action>("/nobody").unwrap();
    let list = here.json(&["action", "list"]);
    let servers = json!([{ "node": "/robot/counter", "remote": false, "place": null }]);
    let expected = json!({
        "action": "/robot/fibonacci", "type": "example_interfaces/action/Fibonacci", "servers": servers, "clients": [],
    });
    assert_eq!((list.as_array().unwrap().len(), &list[1]), (2, &expected));
    let table = here.taut(&["action", "list"]);
    let row: Vec<&str> = table.lines().last().unwrap().split_whitespace().collect();
    assert_eq!(row, ["/robot/fibonacci", "example_interfaces/action/Fibonacci", "here", "1", "0"]);
    let info = "Action: /robot/fibonacci\nType: example_interfaces/action/Fibonacci\nAction clients: 0\nAction servers: 1\n    /robot/counter\n";
    assert_eq!(here.taut(&["action", "info", "robot/fibonacci"]), info);

    const SEND: [&str; 3] = ["action", "send_goal", "/robot/fibonacci"];
    let of = |args: &[&'static str]| [&SEND, args].concat();
    let told = here.taut(&of(&["{order: 3}", "--feedback"]));
    let (accepted, rest) = told.split_once('\n').unwrap();
    assert!(accepted.starts_with("Goal accepted with ID: "), "{told}");
    let expected = "Feedback:\n    sequence:\n    - 0\n    - 1\n    - 1\nFeedback:\n    sequence:\n    - 0\n    - 1\n    - 1\n    - 2\n\
                    Result:\n    sequence:\n    - 0\n    - 1\n    - 1\n    - 2\nGoal finished with status: SUCCEEDED\n";
    assert_eq!(rest, expected);
    let lines = here.taut(&of(&["example_interfaces/Fibonacci", "{order: 2}", "--json", "-f"]));
    let lines: Vec<Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!((lines.len(), &lines[0]["accepted"]), (3, &json!(true)));
    assert_eq!(lines[1], json!({ "feedback": { "sequence": [0, 1, 1] } }));
    assert_eq!(lines[2], json!({ "status": "SUCCEEDED", "result": { "sequence": [0, 1, 1] } }));
    // Without feedback.
    assert_eq!(here.taut(&of(&["{order: 20}", "--json"])).lines().count(), 2);

    let refused = |args: &[&'static str]| here.refused(&of(args));
    let rejected = refused(&["{order: -1}"]);
    said(&rejected, 1, "the server rejected the goal");
    assert_eq!(rejected.1, "Goal was rejected.\n");
    let aborted = refused(&["{order: 0}"]);
    said(&aborted, 1, "the goal was not reached: it is aborted");
    assert!(aborted.1.ends_with("Goal finished with status: ABORTED\n"), "{aborted:?}");
    said(&refused(&["{ordr: 1}"]), 2, "there is no field `ordr`");
    said(&refused(&["{order: 1e10}"]), 2, "order");
    said(
        &refused(&["std_srvs/action/SetBool", "{}"]),
        2,
        "is of type example_interfaces/action/Fibonacci, not std_srvs",
    );
    said(&here.refused(&["action", "send_goal", "/robot/fibonaci"]), 1, "did you mean /robot/fibonacci?");
    said(
        &here.refused(&["action", "send_goal", "/nobody"]),
        1,
        "action '/nobody' has clients, but no server",
    );
    said(&here.refused(&["action", "info", "/robot/fibonaci"]), 1, "did you mean /robot/fibonacci?");

    // Cancelled by Ctrl-C, and when the time is over; and what if the server refuses that.
    let mut running = here.start(&of(&["{order: 100}", "--feedback", "--json"]));
    let lines = [running.line(), running.line()];
    assert!(lines[1].contains("feedback"), "{lines:?}");
    running.interrupt();
    let ended = running.end();
    said(
        &ended,
        1,
        "taut: interrupted: cancelling the goal\ntaut: the goal was not reached: it is canceled\n",
    );
    let last: Value = serde_json::from_str(&ended.1).unwrap();
    assert_eq!(last, json!({ "status": "CANCELED", "result": { "sequence": [0, 1] } }));
    said(&refused(&["{order: 100}", "--timeout", "1s"]), 1, "taut: not reached in time: cancelling the goal");
    let mut running = here.start(&of(&["{order: 101}"]));
    assert!(running.line().starts_with("Goal accepted"));
    running.interrupt();
    said(&running.end(), 1, "the goal continues: the action's server rejected the request");
}
