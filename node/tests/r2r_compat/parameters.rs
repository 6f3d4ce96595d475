// SPDX-License-Identifier: MIT OR Apache-2.0
//! r2r's `parameters.rs` and `parameters_derive.rs`, and a node that sets and gets them.

use futures::executor::LocalPool;
use futures::future;
use futures::prelude::*;
use futures::task::LocalSpawnExt;
use r2r::rcl_interfaces::{msg, srv};
use r2r::{ParameterValue, QosProfile, RosParams};
use std::cell::RefCell;
use std::rc::Rc;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tautline as r2r;

#[derive(RosParams, Default, Debug)]
struct Params {
    /// Parameter description
    par1: f64,
    /// Dummy parameter [m/s]
    par2: i32,
    nested: NestedParams,
}

#[derive(r2r::RosParams, Default, Debug)]
struct NestedParams {
    par3: String,
    par4: u16,
    nested2: NestedParams2,
}

#[derive(RosParams, Default, Debug)]
struct NestedParams2 {
    /// Small parameter
    par5: i8,
}

/// Spins until the task has ended.
fn run<T: 'static>(
    node: &mut r2r::Node,
    handler: impl Future<Output = ()> + 'static,
    task: impl Future<Output = T> + 'static,
) -> T {
    let mut pool = LocalPool::new();
    let result = Rc::new(RefCell::new(None));
    let out = result.clone();
    pool.spawner().spawn_local(handler).unwrap();
    pool.spawner().spawn_local(async move { *out.borrow_mut() = Some(task.await) }).unwrap();
    while result.borrow().is_none() {
        node.spin_once(Duration::from_millis(100));
        pool.run_until_stalled();
    }
    result.borrow_mut().take().unwrap()
}

fn parameter(name: &str, type_: u8) -> msg::Parameter {
    msg::Parameter { name: name.into(), value: msg::ParameterValue { type_, ..Default::default() } }
}

#[test]
fn parameters_without_a_struct() -> Result<(), Box<dyn std::error::Error>> {
    let arguments = "--ros-args -p key1:=[hello,world] -p key2:=5.5 -r __ns:=/demo -r __node:=my_node";
    let ctx = super::context(127, arguments);
    let mut node = r2r::Node::create(ctx, "to_be_replaced", "to_be_replaced")?;
    assert!(node.get_parameter::<String>("serial_interface").is_err());
    let baud_rate: Option<i64> = node.get_parameter("baud_rate")?;
    assert_eq!(
        (baud_rate.unwrap_or(115200), node.fully_qualified_name()?.as_str()),
        (115200, "/demo/my_node")
    );
    let (paramater_handler, parameter_events) = node.make_parameter_handler()?;

    let set = node.create_client::<srv::SetParameters::Service>(
        "/demo/my_node/set_parameters",
        QosProfile::default(),
    )?;
    let get = node.create_client::<srv::GetParameters::Service>(
        "/demo/my_node/get_parameters",
        QosProfile::default(),
    )?;
    let available = r2r::Node::is_available(&set)?;
    let (values, events) = run(&mut node, paramater_handler, async move {
        available.await.unwrap();
        let mut key2 = parameter("key2", 1);
        key2.value.bool_value = true;
        let mut new = parameter("new", 2);
        new.value.integer_value = 7;
        let request = srv::SetParameters::Request { parameters: vec![key2, new] };
        let response = set.request(&request).unwrap().await.unwrap();
        assert!(response.results.iter().all(|result| result.successful));
        let names = ["key1", "key2", "new", "none"].map(String::from).to_vec();
        let response = get.request(&srv::GetParameters::Request { names }).unwrap().await.unwrap();
        (response.values, parameter_events.take(2).collect::<Vec<_>>().await)
    });
    assert_eq!(values[0].string_array_value, ["hello", "world"]);
    assert_eq!((values[1].bool_value, values[2].integer_value, values[3].type_), (true, 7, 0));
    assert_eq!(
        events,
        [("key2".into(), ParameterValue::Bool(true)), ("new".into(), ParameterValue::Integer(7))]
    );
    let params = node.params.clone();
    params.lock().unwrap().iter().for_each(|(k, v)| println!("{} - {:?}", k, v.value));
    params.lock().unwrap().insert("mine".into(), r2r::Parameter::new(ParameterValue::Double(0.5)));
    assert_eq!(node.get_parameter::<f64>("mine")?, 0.5);
    Ok(())
}

#[test]
fn parameters_of_a_struct() -> Result<(), Box<dyn std::error::Error>> {
    let ctx = super::context(126, "--ros-args -p par1:=5.1 -p nested.par4:=42");
    let mut node = r2r::Node::create(ctx, "my_node", "/demo")?;
    let params = Arc::new(Mutex::new({
        let mut p = Params::default();
        p.nested.par3 = "initial value".into();
        p
    }));
    let (paramater_handler, parameter_events) = node.make_derived_parameter_handler(params.clone())?;
    let now = || params.lock().unwrap();
    assert_eq!(now().par1, 5.1);
    assert_eq!(now().nested.par4, 42);

    let seen = params.clone();
    let values = Rc::new(RefCell::new(Vec::new()));
    let log = values.clone();
    let events = parameter_events.for_each(move |_| {
        log.borrow_mut().push(seen.lock().unwrap().nested.par4);
        future::ready(())
    });
    let set = node.create_client::<srv::SetParametersAtomically::Service>(
        "/demo/my_node/set_parameters_atomically",
        QosProfile::default(),
    )?;
    let describe = node.create_client::<srv::DescribeParameters::Service>(
        "/demo/my_node/describe_parameters",
        QosProfile::default(),
    )?;
    let handler = future::join(paramater_handler, events).map(|_| ());
    let reasons = run(&mut node, handler, async move {
        let mut reasons = Vec::new();
        for value in [43, 70_000] {
            let mut par4 = parameter("nested.par4", 2);
            par4.value.integer_value = value;
            let request = srv::SetParametersAtomically::Request { parameters: vec![par4] };
            reasons.push(set.request(&request).unwrap().await.unwrap().result.reason);
        }
        let names = vec!["nested.nested2.par5".to_owned(), "par2".to_owned()];
        let response = describe.request(&srv::DescribeParameters::Request { names }).unwrap().await.unwrap();
        reasons.extend(response.descriptors.into_iter().map(|descriptor| descriptor.description));
        reasons
    });
    assert!(
        reasons[0].is_empty() && reasons[1].starts_with("parameter 'nested.par4': 70000 does not fit"),
        "{reasons:?}"
    );
    assert_eq!(reasons[2..], ["Small parameter", "Dummy parameter [m/s]"]);
    assert_eq!(*values.borrow(), [43]);
    assert_eq!(now().nested.par4, 43);
    assert_eq!(now().par2, 0);
    assert_eq!(now().nested.nested2.par5, 0);
    Ok(())
}
