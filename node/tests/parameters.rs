// SPDX-License-Identifier: MIT OR Apache-2.0
//! Parameters of a node: declared, given, checked, read in callbacks, told to others.

mod common;

use std::io::Write;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use common::{context, spin};
use futures::StreamExt;
use futures::executor::block_on;
use tautline::rcl_interfaces::msg::ParameterEvent;
use tautline::{
    CallbackOptions, Context, Error, Node, NodeOptions, ParameterDescriptor, ParameterError, ParameterValue,
    Qos, Realtime, Result, RosParams,
};

/// Of one domain: only the changes that are published would be seen by others.
fn node(arguments: &str) -> Result<Node> {
    let ctx =
        Context::builder().domain(125).realtime(Realtime::Off).args(arguments.split_whitespace()).build()?;
    Node::create(ctx, "arm", "/robot")
}

fn reason<T>(result: Result<T>) -> String {
    match result {
        Ok(_) => "no error".into(),
        Err(error) => error.to_string(),
    }
}

#[test]
fn the_command_line_gives_what_is_declared() {
    let mut file = tempfile::NamedTempFile::new().unwrap();
    write!(
        file,
        "/**:\n  ros__parameters: {{speed: 1.0, frame: map}}\n/robot:\n  arm:\n    ros__parameters:\n      speed: 2.0\n      \
         grip: {{force: 5}}\n/*/leg:\n  ros__parameters: {{frame: leg}}\narm:\n  ros__parameters: {{frame: root}}\n"
    )
    .unwrap();
    let arguments = format!(
        "prog --ros-args --params-file {} -p grip.force:=7 -p robot/arm:joints:=[] -p arm:speed:=9.0",
        file.path().display()
    );
    let mut node = node(&arguments).unwrap();
    // As r2r has it: what is given is there without a declaration.
    assert_eq!(node.get_parameter::<f64>("speed").unwrap(), 2.0);
    assert_eq!(node.get_parameter::<Option<i64>>("missing").unwrap(), None);
    let mut speed = node.declare_parameter("speed", 0.5).unwrap();
    let mut force = node.declare_parameter("grip.force", 1).unwrap();
    let mut frame = node.declare_parameter("frame", "odom".to_owned()).unwrap();
    let mut joints = node.declare_parameter("joints", vec![1.0]).unwrap();
    let mut other = node.declare_parameter("other", true).unwrap();
    assert_eq!((speed.get(), force.get(), other.get()), (2.0, 7, true));
    assert_eq!((frame.read().as_str(), joints.read().len()), ("map", 0));
    assert_eq!(node.context().non_ros_args(), ["prog"]);
}

#[test]
fn bad_use_is_an_error_that_says_what_to_do() {
    let mut node = node("prog --ros-args -p gain:=1 -p height:=50").unwrap();
    for (error, expected) in [
        (
            reason(node.declare_parameter("gain", 1.0)),
            "parameter 'gain' is of type double, but 1 is of type integer: write a double with a point",
        ),
        (
            reason(node.declare_parameter_with("height", 2, ParameterDescriptor::new().range(0..=10))),
            "parameter 'height': 50 is not in 0..=10",
        ),
        (reason(node.declare_parameter("", 2)), "'' is not a parameter's name: it is empty"),
        (reason(node.get_parameter::<String>("nothing")), "parameter 'nothing' is not declared"),
        (
            reason(node.get_parameter::<String>("gain")),
            "parameter 'gain' is of type string, but 1 is of type integer",
        ),
        (reason(node.parameter::<f64>("nothing")), "parameter 'nothing' is not declared"),
    ] {
        assert!(error.starts_with(expected), "{error}");
    }
    let range = ParameterDescriptor::new().range(0.0..=1.0);
    let mut share = node.declare_parameter_with("share", 0.5, range).unwrap();
    node.declare_parameter_with("serial", "A1".to_owned(), ParameterDescriptor::new().read_only()).unwrap();
    for (error, expected) in [
        (reason(node.declare_parameter("share", 0.1)), "parameter 'share' is declared already"),
        (reason(node.set_parameter("share", 1.5)), "parameter 'share': 1.5 is not in 0.0..=1.0"),
        (
            reason(node.set_parameter("share", "x")),
            "parameter 'share' is of type double, but x is of type string",
        ),
        (reason(node.set_parameter("serial", "B2")), "parameter 'serial' is read-only"),
        (reason(node.set_parameter("nothing", 1)), "parameter 'nothing' is not declared"),
        (reason(node.parameter::<i64>("share")), "parameter 'share' is of type integer"),
        (reason(node.parameters().undeclare("serial")), "parameter 'serial' is read-only"),
        (reason(node.parameters().undeclare("nothing")), "parameter 'nothing' is not declared"),
        (reason(node.parameters().undeclare("share")), "parameter 'share' cannot be undeclared"),
        (
            reason(node.set_parameter("share", ParameterValue::NotSet)),
            "parameter 'share' cannot be undeclared: it was declared with one type",
        ),
        // Given on the command line, and not declared yet.
        (reason(node.set_parameter("gain", 2)), "parameter 'gain' is not declared"),
    ] {
        assert!(error.starts_with(expected), "{error}");
    }
    assert_eq!(share.get(), 0.5);
    assert_eq!(node.declare_parameter("gain", 0).unwrap().get(), 1, "what was given still counts");
    let any = || ParameterDescriptor::new().dynamic_typing();
    let mut port = node.declare_parameter_with("port", 80, any()).unwrap();
    node.parameters().undeclare("port").unwrap();
    assert_eq!(port.get(), 80);
    assert!(node.declare_parameter_with("port", "another type".to_owned(), any()).is_ok());
    // As in ROS 2.
    node.set_parameter("port", ParameterValue::NotSet).unwrap();
    assert!(!node.parameters().has("port") && node.declare_parameter("port", 8080).is_ok());
}

/// Of a node that declares no parameters.
#[test]
fn what_was_set_is_deleted_by_setting_nothing() {
    let parameters = node("").unwrap().parameters().clone();
    let absent = reason(parameters.set("x", ParameterValue::NotSet));
    assert!(absent.starts_with("parameter 'x' is not declared"), "{absent}");
    parameters.set("x", 1).unwrap();
    parameters.set("x", ParameterValue::NotSet).unwrap();
    assert!(!parameters.has("x"));
}

#[test]
fn callbacks_check_all_values_of_a_change_and_set_none() {
    let mut node = node("").unwrap();
    let mut low = node.declare_parameter("low", 0).unwrap();
    let mut high = node.declare_parameter("high", 10).unwrap();
    let parameters = node.parameters().clone();
    let calls = Arc::new(AtomicUsize::new(0));
    let (inside, count) = (parameters.clone(), calls.clone());
    let check = parameters.on_set(move |values| {
        count.fetch_add(1, Ordering::Relaxed);
        assert!(matches!(inside.set("low", 1), Err(Error::Parameter(e)) if matches!(*e, ParameterError::InCallback { .. })));
        let new = |name: &str| match values.iter().find(|(of, _)| of == name) {
            Some((_, ParameterValue::Integer(value))) => *value,
            _ => inside.get::<i64>(name).unwrap(),
        };
        if new("low") < new("high") { Ok(()) } else { Err("low is not below high".into()) }
    });
    assert_eq!(reason(parameters.set("low", 20)), "refused: low is not below high");
    let both = |low: i64, high: i64| [("low".to_owned(), low.into()), ("high".to_owned(), high.into())];
    parameters.set_atomically(both(20, 30)).unwrap();
    assert_eq!((low.get(), high.get()), (20, 30));
    assert_eq!(reason(parameters.set_atomically(both(25, 22))), "refused: low is not below high");
    assert_eq!((low.get(), high.get()), (20, 30));
    assert_eq!(calls.load(Ordering::Relaxed), 3);
    drop(check);
    parameters.set("low", 99).unwrap();
    assert_eq!(low.get(), 99);
}

#[test]
fn callbacks_may_add_and_end_callbacks_and_panic() {
    let mut node = node("").unwrap();
    let mut low = node.declare_parameter("low", 0).unwrap();
    let parameters = node.parameters().clone();
    let (inside, added) = (parameters.clone(), Arc::new(Mutex::new(Vec::new())));
    let list = added.clone();
    let check = parameters.on_set(move |_| {
        let mut list = list.lock().unwrap();
        // The second time, both at once: the former ends.
        list.clear();
        list.push(inside.on_set(|values| match values[0].1 {
            ParameterValue::Integer(3) => panic!("as the test wants"),
            ParameterValue::Integer(4) => Err("four".into()),
            _ => Ok(()),
        }));
        Ok(())
    });
    for value in 1..=2 {
        parameters.set("low", value).unwrap();
    }
    let panicked = std::panic::catch_unwind(|| parameters.set("low", 3));
    assert!(panicked.is_err() && low.get() == 2, "the panic goes on to who sets, and nothing is set");
    drop(check);
    assert_eq!(
        reason(parameters.set("low", 4)),
        "refused: four",
        "it goes on after a panic, in this thread too"
    );
    added.lock().unwrap().clear();
    parameters.set("low", 4).unwrap();
    assert_eq!(low.get(), 4);
}

#[test]
fn a_callback_reads_and_waits_for_changes() {
    static SEEN: common::Log<Vec<f64>> = common::Log::new();
    let ctx = context(128);
    let _spinning = spin(&ctx);
    let mut node = Node::create(ctx, "watcher", "").unwrap();
    let gains = node.declare_parameter("gains", vec![1.0]).unwrap();
    node.spawn_callback(CallbackOptions::fifo(20), gains.for_each(|gains| async move { SEEN.add(gains) }))
        .unwrap();
    for count in 1..=3 {
        node.set_parameter("gains", vec![0.5; count]).unwrap();
        assert_eq!(SEEN.wait_for(count)[count - 1], vec![0.5; count]);
    }
    // What is set to the value that it has is not changed.
    let mut reader = node.parameter::<Vec<f64>>("gains").unwrap();
    node.set_parameter("gains", vec![0.5; 3]).unwrap();
    node.set_parameter("gains", vec![0.25]).unwrap();
    assert_eq!(*block_on(reader.changed()), [0.25]);
    assert_eq!(SEEN.wait_for(4)[3], [0.25]);
}

#[test]
fn a_parameter_may_change_its_type_if_that_was_said() {
    let mut node = node("prog --ros-args -p port:=/dev/ttyUSB0").unwrap();
    let any = ParameterDescriptor::new().dynamic_typing();
    let mut port = node.declare_parameter_with("port", ParameterValue::Integer(80), any).unwrap();
    assert_eq!(*port.read(), "/dev/ttyUSB0".into());
    node.set_parameter("port", 8080).unwrap();
    assert_eq!(*port.read(), 8080.into());
}

#[test]
fn changes_of_all_nodes_are_published() {
    let ctx = context(154);
    let mut listener = Node::create(ctx.clone(), "listener", "").unwrap();
    let events = listener.subscribe::<ParameterEvent>("/parameter_events", Qos::parameter_events());
    let events = events.unwrap();
    let options = NodeOptions::default().parameter_overrides([("rate", 25)]);
    let mut node = Node::create_with_options(ctx, "camera", "/front", options).unwrap();
    let any = ParameterDescriptor::new().dynamic_typing();
    node.declare_parameter_with("rate", 30, any).unwrap();
    node.set_parameter("rate", 60).unwrap();
    node.parameters().undeclare("rate").unwrap();
    // One event for all of a change.
    let of_node = node.parameters();
    of_node.set_atomically([("a".to_owned(), 1.into()), ("b".to_owned(), 2.into())]).unwrap();
    of_node.set_atomically([("b".to_owned(), 3.into()), ("c".to_owned(), 4.into())]).unwrap();
    let mut heard = Vec::new();
    while let Some(event) = events.try_take().unwrap() {
        let event = event.to_owned();
        assert_eq!(event.node, "/front/camera");
        assert!(event.stamp.sec > 1_600_000_000);
        let told = |list: &[tautline::rcl_interfaces::msg::Parameter]| {
            list.iter()
                .map(|parameter| (parameter.name.clone(), parameter.value.integer_value))
                .collect::<Vec<_>>()
        };
        heard.push([
            told(&event.new_parameters),
            told(&event.changed_parameters),
            told(&event.deleted_parameters),
        ]);
    }
    let rate = |value| vec![("rate".to_owned(), value)];
    let values =
        |of: &[(&str, i64)]| of.iter().map(|(name, value)| ((*name).to_owned(), *value)).collect::<Vec<_>>();
    assert_eq!(
        heard,
        [
            [rate(25), vec![], vec![]],
            [vec![], rate(60), vec![]],
            [vec![], vec![], rate(60)],
            [values(&[("a", 1), ("b", 2)]), vec![], vec![]],
            [values(&[("c", 4)]), values(&[("b", 3)]), vec![]],
        ]
    );
}

#[derive(RosParams, Default, Debug, PartialEq)]
struct Controller {
    /// Of the heading
    /// controller.
    #[param(range = 0.0..=10.0, step = 0.5)]
    gain: f64,
    #[param(description = "Where it starts", read_only)]
    frame: String,
    limits: Limits,
}

#[derive(RosParams, Default, Debug)]
struct Second {
    rate: u16,
}

#[derive(RosParams, Default, Debug, PartialEq)]
struct Limits {
    #[param(range = -3..=3)]
    steps: i64,
    retries: u8,
    r#type: Vec<f64>,
}

#[test]
fn the_fields_of_a_struct_are_parameters() {
    let arguments = "--ros-args -p limits.retries:=7 -p frame:=map -p limits.type:=[]";
    let node = node(arguments).unwrap();
    let start =
        Controller { gain: 1.5, limits: Limits { steps: 2, ..Default::default() }, ..Default::default() };
    let of_struct = Arc::new(Mutex::new(start));
    let parameters = node.parameters().clone();
    parameters.declare_struct(of_struct.clone()).unwrap();
    assert_eq!(parameters.names()[1..], ["gain", "frame", "limits.steps", "limits.retries", "limits.type"]);
    let (_, gain) = parameters.describe("gain").unwrap();
    assert_eq!((gain.description.as_str(), gain.range.is_some()), ("Of the heading controller.", true));
    let mut retries = node.parameter::<i64>("limits.retries").unwrap();
    assert_eq!(retries.get(), 7);
    parameters.set("limits.retries", 255).unwrap();
    parameters.set("limits.type", vec![0.5]).unwrap();
    assert_eq!(retries.get(), 255);
    for (error, expected) in [
        (
            reason(parameters.set("limits.retries", 256)),
            "parameter 'limits.retries': 256 does not fit: out of range",
        ),
        (reason(parameters.set("limits.retries", "x")), "parameter 'limits.retries' is of type integer"),
        (reason(parameters.set("limits.steps", 4)), "parameter 'limits.steps': 4 is not in -3..=3"),
        (reason(parameters.set("gain", 1.25)), "parameter 'gain': 1.25 is not in 0.0..=10.0 in steps of 0.5"),
        (reason(parameters.set("frame", "odom")), "parameter 'frame' is read-only"),
        (reason(parameters.set("limits.other", 1)), "parameter 'limits.other' is not declared"),
        (reason(parameters.declare_struct(of_struct.clone())), "parameter 'gain' is declared already"),
    ] {
        assert!(error.starts_with(expected), "{error}");
    }
    // A second struct has fields of its own; the first one goes on.
    let second = Arc::new(Mutex::new(Second::default()));
    parameters.declare_struct(second.clone()).unwrap();
    parameters
        .set_atomically([("rate".to_owned(), 5.into()), ("limits.steps".to_owned(), 2.into())])
        .unwrap();
    assert_eq!((second.lock().unwrap().rate, parameters.get::<i64>("limits.steps").unwrap()), (5, 2));
    // What one value of a change does to the struct is not done if another one is refused.
    let change = [("gain".to_owned(), 9.0.into()), ("limits.retries".to_owned(), (-1).into())];
    assert!(parameters.set_atomically(change).is_err());
    let limits = Limits { steps: 2, retries: 255, r#type: vec![0.5] };
    assert_eq!(*of_struct.lock().unwrap(), Controller { gain: 1.5, frame: "map".into(), limits });
}

/// `on_set` checks what is declared, too; and a reader gets what is set, whatever the program did to the field.
#[test]
fn a_struct_is_checked_and_may_be_changed_by_the_program() {
    let parameters = node("--ros-args -p gain:=9.0").unwrap().parameters().clone();
    let check = parameters.on_set(|values| {
        let is_high = |(name, value): &(String, ParameterValue)| {
            name == "gain" && matches!(value, ParameterValue::Double(gain) if *gain > 5.0)
        };
        if values.iter().any(is_high) { Err("too high".into()) } else { Ok(()) }
    });
    let of_struct = Arc::new(Mutex::new(Controller::default()));
    let refused = reason(parameters.declare_struct(of_struct.clone()));
    assert!(refused.contains("too high"), "{refused}");
    assert_eq!(*of_struct.lock().unwrap(), Controller::default());
    assert!(!parameters.names().contains(&"limits.steps".to_owned()));
    drop(check);
    parameters.declare_struct(of_struct.clone()).unwrap();
    of_struct.lock().unwrap().gain = 2.0;
    let mut gain = parameters.reader::<f64>("gain").unwrap();
    assert_eq!(gain.get(), 2.0);
    parameters.set("gain", 9.0).unwrap();
    assert_eq!((gain.get(), of_struct.lock().unwrap().gain), (9.0, 9.0));
    of_struct.lock().unwrap().gain = 3.0;
    parameters.set("gain", 3.0).unwrap();
    assert_eq!(gain.get(), 3.0);
}

#[test]
fn what_is_given_must_fit_the_struct() {
    for (arguments, expected) in [
        ("--ros-args -p limits.retries:=300", "parameter 'limits.retries': 300 does not fit"),
        ("--ros-args -p gain:=9.0 -p limits.retries:=300", "parameter 'limits.retries': 300 does not fit"),
        ("--ros-args -p limits.steps:=9", "parameter 'limits.steps': 9 is not in -3..=3"),
        ("--ros-args -p gain:=1", "parameter 'gain' is of type double, but 1 is of type integer"),
    ] {
        let parameters = node(arguments).unwrap().parameters().clone();
        let before = parameters.names();
        let controller = Arc::new(Mutex::new(Controller::default()));
        let error = reason(parameters.declare_struct(controller.clone()));
        assert!(error.starts_with(expected), "{error}");
        assert_eq!(*controller.lock().unwrap(), Controller::default());
        assert_eq!(parameters.names(), before, "all fields are declared, or none");
        assert!(
            before
                .iter()
                .all(|name| *name == "use_sim_time" || reason(parameters.set(name, 1)) == "no error")
        );
    }
}

#[test]
fn what_is_given_counts_in_place_of_the_structs_value() {
    #[derive(RosParams, Default)]
    struct Positive {
        #[param(range = 1.0..=10.0)]
        gain: f64,
    }
    for (arguments, expected) in
        [("", "parameter 'gain': 0.0 is not in 1.0..=10.0"), ("--ros-args -p gain:=5.0", "no error")]
    {
        let parameters = node(arguments).unwrap().parameters().clone();
        assert_eq!(reason(parameters.declare_struct(Arc::new(Mutex::new(Positive::default())))), expected);
    }
}

/// One thread changes two parameters together, others look: none sees values that were never set together.
#[test]
fn changes_of_several_threads_come_one_after_the_other() {
    let mut node = node("").unwrap();
    node.declare_parameter("a", 0).unwrap();
    node.declare_parameter("b", 0).unwrap();
    let parameters = node.parameters().clone();
    let sums = Arc::new(Mutex::new(Vec::new()));
    let (seen, inside) = (sums.clone(), parameters.clone());
    let _check = parameters.on_set(move |_| {
        // The last change is whole: a and b are what one thread set.
        seen.lock().unwrap().push(inside.get::<i64>("a").unwrap() - inside.get::<i64>("b").unwrap());
        Ok(())
    });
    std::thread::scope(|scope| {
        for thread in 0..3 {
            let parameters = parameters.clone();
            scope.spawn(move || {
                for round in 0..200_i64 {
                    let value: ParameterValue = (thread * 1000 + round).into();
                    parameters
                        .set_atomically([("a".to_owned(), value.clone()), ("b".to_owned(), value)])
                        .unwrap();
                }
            });
        }
    });
    let sums = sums.lock().unwrap();
    assert_eq!((sums.len(), sums.iter().all(|sum| *sum == 0)), (600, true));
}
