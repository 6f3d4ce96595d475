// SPDX-License-Identifier: MIT OR Apache-2.0
//! The simulation that bounds are held against, held against rmw_tautline: an unchanged executor of rclpy begins the callbacks of a group that
//! goes by ranks in the order of the simulation, with the same messages. node/tests/simulation.rs does this for nodes of Tautline.
//! `TAUT_SEED` chooses the systems.

#[path = "../../analysis/tests/runtime/mod.rs"]
mod runtime;
mod support;

use std::fmt::Write;

use rand::SeedableRng;
use rand::rngs::StdRng;
use runtime::machine::Step;
use runtime::made_up::Order;
use runtime::small::{HERE, group, run};
use serde_json::{Value, json};
use support::{Domain, words_of};

const SYSTEMS: usize = 40;

/// Publishes what arrives, spins once where a message is taken, and stays in a job until it ends. A join keeps the newest message of
/// each topic until all have one.
const FOLLOWER: &str = r#"
import json, sys, rclpy
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
rclpy.init()
source, begun = rclpy.create_node("source"), 0
for number, system in enumerate(json.load(open(sys.argv[1]))):
    node, steps, publishers = rclpy.create_node(f"listener{number}"), system["steps"], {}
    steps.reverse()
    def follow():
        what, callback, topic, values = steps.pop()
        if what == "arrived": publishers[callback, topic].publish(String(data=str(values[0])))
        return what
    def expect(*step):
        assert steps[-1] == list(step), (number, steps[-1], step)
        steps.pop()
    def begin(callback, values):
        global begun
        expect("begun", callback, None, values)
        begun += 1
        while steps and follow() != "ended": pass
    def heard(callback, topic, topics, newest):
        def run(message):
            if not steps: return
            value = int(message.data)
            if newest is None: return begin(callback, [value])
            expect("taken", callback, topic, [])
            newest[topic] = value
            if len(newest) == len(topics):
                values = [newest.pop(topic) for topic in topics]
                if steps: begin(callback, values)
        return run
    for callback, topics, is_join, depth in system["callbacks"]:
        newest = {} if is_join else None
        for topic in topics:
            name = f"/s{number}/t{callback}_{topic}"
            publishers[callback, topic] = source.create_publisher(String, name, 100)
            node.create_subscription(String, name, heard(callback, topic, topics, newest), depth)
    while any(publisher.get_subscription_count() < 1 for publisher in publishers.values()): pass
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while steps:
        if steps[-1][0] == "arrived": follow()
        else: executor.spin_once()
    executor.shutdown()
    node.destroy_node()
print(begun)
rclpy.shutdown()
"#;

#[test]
fn an_executor_of_rclpy_begins_what_the_simulation_begins() {
    let Some(domain) = Domain::new(117) else { return };
    let seed =
        std::env::var("TAUT_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or_else(rand::random);
    println!("TAUT_SEED={seed}");
    let mut rng = StdRng::seed_from_u64(seed);
    let mut file = "[hosts.here]\ncores = 1\n".to_owned();
    let (mut systems, mut begun, mut joins, mut lost) = (Vec::new(), 0, 0, 0);
    for system in 0..SYSTEMS {
        let (model, seen) = run(&mut rng, |rng| group(rng, Order::Rank));
        writeln!(file, "[nodes.listener{system}]\nclient = \"rclpy\"").unwrap();
        writeln!(file, "[groups.g{system}]\norder = \"priority\"\npriority = {}", system + 1).unwrap();
        let mut callbacks = Vec::new();
        for (i, callback) in model.callbacks.iter().enumerate().filter(|(_, callback)| callback.core == HERE)
        {
            let topics: Vec<String> =
                callback.triggers.iter().map(|topic| format!("/s{system}/t{i}_{topic}")).collect();
            let takes = if callback.join.is_some() { "all" } else { "topic" };
            let rank = callback.priority;
            writeln!(
                file,
                "[callbacks.s{system}t{i}]\n{takes} = {topics:?}\npriority = {rank}\nwcet = \"1us\"\nnode = \"listener{system}\""
            )
            .unwrap();
            writeln!(file, "group = \"g{system}\"").unwrap();
            for topic in &topics {
                writeln!(file, "[topics.{topic:?}]\nperiod = \"1s\"").unwrap();
            }
            joins += usize::from(callback.join.is_some());
            callbacks.push((i, &callback.triggers, callback.join.is_some(), callback.depth));
        }
        let steps: Vec<Value> = seen.steps.iter().map(|(_, step)| of(step)).collect();
        begun += steps.iter().filter(|step| step[0] == "begun").count();
        lost += seen.lost.values().sum::<u64>();
        systems.push(json!({ "callbacks": callbacks, "steps": steps }));
    }
    let folder = tempfile::tempdir().unwrap();
    let [path, steps] = ["system.toml", "steps.json"].map(|name| folder.path().join(name));
    std::fs::write(&path, file).unwrap();
    std::fs::write(&steps, json!(systems).to_string()).unwrap();
    let mut command = domain.python(FOLLOWER);
    let (_, out, errors) = words_of(command.arg(steps).env("TAUT_SYSTEM", path).env("TAUT_REALTIME", "off"));
    assert_eq!(out.trim(), begun.to_string(), "{errors}");
    println!(
        "{SYSTEMS} systems: {begun} jobs begin in one order, {joins} callbacks are joins, {lost} messages overwritten"
    );
    assert!(joins > 0);
}

/// What, whose, of which topic, with which messages.
fn of(step: &Step) -> Value {
    match step {
        Step::Arrived { callback, topic, number, .. } => json!(["arrived", callback, topic, [number]]),
        Step::Taken { callback, topic } => json!(["taken", callback, topic, []]),
        Step::Begun { callback, numbers } => json!(["begun", callback, null, numbers]),
        Step::Ended { callback } => json!(["ended", callback, null, []]),
        other => unreachable!("{other:?}"),
    }
}
