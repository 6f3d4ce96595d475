// SPDX-License-Identifier: MIT OR Apache-2.0
//! What arguments do to the parameters of r2r's programs, and what the answer says when a value does not fit.

use futures::executor::LocalPool;
use futures::prelude::*;
use futures::task::LocalSpawnExt;
use r2r::rcl_interfaces::{msg, srv};
use r2r::{QosProfile, RosParams};
use std::cell::RefCell;
use std::rc::Rc;
use std::sync::{Arc, Mutex};
use std::time::Duration;

#[derive(RosParams, Default, Debug)]
struct Params {
    par1: f64,
    par2: i32,
    nested: NestedParams,
}

#[derive(r2r::RosParams, Default, Debug)]
struct NestedParams {
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
    assert_eq!(node.fully_qualified_name()?, "/demo/my_node");
    assert_eq!(node.get_parameter::<Vec<String>>("key1")?, ["hello", "world"]);
    assert_eq!(node.get_parameter::<f64>("key2")?, 5.5);

    let (paramater_handler, _parameter_events) = node.make_parameter_handler()?;
    let set = node.create_client::<srv::SetParameters::Service>(
        "/demo/my_node/set_parameters",
        QosProfile::default(),
    )?;
    let available = r2r::Node::is_available(&set)?;
    let results = run(&mut node, paramater_handler, async move {
        available.await.unwrap();
        let mut key2 = parameter("key2", 1);
        key2.value.bool_value = true;
        set.request(&srv::SetParameters::Request { parameters: vec![key2] }).unwrap().await.unwrap().results
    });
    assert!(results[0].successful, "what nobody declared may get another type: {}", results[0].reason);
    assert!(node.get_parameter::<bool>("key2")?);
    Ok(())
}

#[test]
fn parameters_of_a_struct() -> Result<(), Box<dyn std::error::Error>> {
    let ctx = super::context(126, "--ros-args -p par1:=5.1 -p nested.par4:=42");
    let mut node = r2r::Node::create(ctx, "my_node", "/demo")?;
    let params = Arc::new(Mutex::new(Params { par2: 7, ..Params::default() }));
    let (paramater_handler, _parameter_events) = node.make_derived_parameter_handler(params.clone())?;
    let now = || {
        let now = params.lock().unwrap();
        (now.par1, now.par2, now.nested.par4, now.nested.nested2.par5)
    };
    assert_eq!(now(), (5.1, 7, 42, 0));

    let set = node.create_client::<srv::SetParametersAtomically::Service>(
        "/demo/my_node/set_parameters_atomically",
        QosProfile::default(),
    )?;
    let describe = node.create_client::<srv::DescribeParameters::Service>(
        "/demo/my_node/describe_parameters",
        QosProfile::default(),
    )?;
    let (reason, description) = run(&mut node, paramater_handler, async move {
        let (mut par2, mut par4) = (parameter("par2", 2), parameter("nested.par4", 2));
        (par2.value.integer_value, par4.value.integer_value) = (8, 70_000);
        let request = srv::SetParametersAtomically::Request { parameters: vec![par2, par4] };
        let reason = set.request(&request).unwrap().await.unwrap().result.reason;
        let names = vec!["nested.nested2.par5".to_owned()];
        let response = describe.request(&srv::DescribeParameters::Request { names }).unwrap().await.unwrap();
        (reason, response.descriptors[0].description.clone())
    });
    assert!(reason.starts_with("parameter 'nested.par4': 70000 does not fit"), "{reason}");
    assert_eq!(now(), (5.1, 7, 42, 0), "all of it or nothing");
    assert_eq!(description, "Small parameter");
    Ok(())
}
