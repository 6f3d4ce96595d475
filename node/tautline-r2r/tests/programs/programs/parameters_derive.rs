// SPDX-License-Identifier: MIT OR Apache-2.0
//! A struct whose fields are parameters.

use futures::{executor::LocalPool, prelude::*, task::LocalSpawnExt};
use r2r::rcl_interfaces::{msg, srv};
use r2r::{QosProfile, RosParams};
use std::cell::RefCell;
use std::rc::Rc;
use std::sync::{Arc, Mutex};
use std::time::Duration;

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
}

pub fn main() -> Result<(), Box<dyn std::error::Error>> {
    let ctx = r2r::Context::create()?;
    let mut node = r2r::Node::create(ctx, "my_node", "demo")?;
    let params = Arc::new(Mutex::new({
        let mut p = Params::default();
        p.nested.par3 = "initial value".into();
        p
    }));
    let (paramater_handler, parameter_events) = node.make_derived_parameter_handler(params.clone())?;
    assert_eq!(node.get_parameter::<String>("nested.par3")?, "initial value");

    let set = node.create_client::<srv::SetParameters::Service>(
        "/demo/my_node/set_parameters",
        QosProfile::default(),
    )?;
    let describe = node.create_client::<srv::DescribeParameters::Service>(
        "/demo/my_node/describe_parameters",
        QosProfile::default(),
    )?;
    let set_available = r2r::Node::is_available(&set)?;
    let describe_available = r2r::Node::is_available(&describe)?;
    let mut pool = LocalPool::new();
    let spawner = pool.spawner();
    spawner.spawn_local(paramater_handler)?;
    let changed = Rc::new(RefCell::new(Vec::new()));
    let (log, seen) = (changed.clone(), params.clone());
    spawner.spawn_local(parameter_events.for_each(move |(name, _value)| {
        log.borrow_mut().push((name, seen.lock().unwrap().nested.par4));
        future::ready(())
    }))?;
    let answers = Rc::new(RefCell::new(None));
    let out = answers.clone();
    spawner.spawn_local(async move {
        set_available.await.unwrap();
        describe_available.await.unwrap();
        let mut accepted = Vec::new();
        for integer_value in [43, 70_000] {
            let value = msg::ParameterValue { type_: 2, integer_value, ..Default::default() };
            let parameters = vec![msg::Parameter { name: "nested.par4".into(), value }];
            let response = set.request(&srv::SetParameters::Request { parameters }).unwrap().await.unwrap();
            accepted.push(response.results[0].successful);
        }
        let names = vec!["par2".to_owned()];
        let response = describe.request(&srv::DescribeParameters::Request { names }).unwrap().await.unwrap();
        *out.borrow_mut() = Some((accepted, response.descriptors[0].description.clone()));
    })?;
    while answers.borrow().is_none() || changed.borrow().is_empty() {
        node.spin_once(Duration::from_millis(100));
        pool.run_until_stalled();
    }
    let (accepted, description) = answers.borrow_mut().take().unwrap();
    assert_eq!(accepted, [true, false]);
    assert_eq!(description, "Dummy parameter [m/s]");
    assert_eq!(*changed.borrow(), [("nested.par4".to_owned(), 43)]);
    let params = params.lock().unwrap();
    assert_eq!((params.nested.par4, params.par2, params.par1), (43, 0, 0.0));
    Ok(())
}
