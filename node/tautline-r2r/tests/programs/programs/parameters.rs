// SPDX-License-Identifier: MIT OR Apache-2.0
//! Parameters without a struct: set by clients, heard of by the node.

use futures::{executor::LocalPool, prelude::*, task::LocalSpawnExt};
use r2r::rcl_interfaces::{msg, srv};
use r2r::{ParameterValue, QosProfile};
use std::cell::RefCell;
use std::rc::Rc;
use std::time::Duration;

pub fn main() -> Result<(), Box<dyn std::error::Error>> {
    let ctx = r2r::Context::create()?;
    let mut node = r2r::Node::create(ctx, "my_node", "/demo")?;
    assert!(node.get_parameter::<String>("serial_interface").is_err());
    let baud_rate: Option<i64> = node.get_parameter("baud_rate")?;
    assert_eq!(baud_rate.unwrap_or(115200), 115200);
    node.params
        .lock()
        .unwrap()
        .insert("rate".into(), r2r::Parameter::new(ParameterValue::Double(0.5)));
    assert_eq!(node.get_parameter::<f64>("rate")?, 0.5);
    let (paramater_handler, parameter_events) = node.make_parameter_handler()?;

    let qos = QosProfile::default();
    let set =
        node.create_client::<srv::SetParameters::Service>("/demo/my_node/set_parameters", qos.clone())?;
    let get = node.create_client::<srv::GetParameters::Service>("/demo/my_node/get_parameters", qos.clone())?;
    let list = node.create_client::<srv::ListParameters::Service>("/demo/my_node/list_parameters", qos)?;
    let set_available = r2r::Node::is_available(&set)?;
    let get_available = r2r::Node::is_available(&get)?;
    let list_available = r2r::Node::is_available(&list)?;
    let mut pool = LocalPool::new();
    let spawner = pool.spawner();
    spawner.spawn_local(paramater_handler)?;
    let result = Rc::new(RefCell::new(None));
    let out = result.clone();
    spawner.spawn_local(async move {
        set_available.await.unwrap();
        get_available.await.unwrap();
        list_available.await.unwrap();
        let value = |type_, integer_value| msg::ParameterValue { type_, integer_value, ..Default::default() };
        let parameters = vec![
            msg::Parameter { name: "key1".into(), value: value(2, 7) },
            msg::Parameter { name: "key2".into(), value: value(2, -3) },
        ];
        let response = set.request(&srv::SetParameters::Request { parameters }).unwrap().await.unwrap();
        assert!(response.results.iter().all(|result| result.successful));
        let names = ["key1", "rate", "none"].map(String::from).to_vec();
        let got = get.request(&srv::GetParameters::Request { names }).unwrap().await.unwrap();
        let all = list.request(&srv::ListParameters::Request::default()).unwrap().await.unwrap();
        let events = parameter_events.take(2).collect::<Vec<_>>().await;
        *out.borrow_mut() = Some((got.values, all.result.names, events));
    })?;
    while result.borrow().is_none() {
        node.spin_once(Duration::from_millis(100));
        pool.run_until_stalled();
    }
    let (values, names, events) = result.borrow_mut().take().unwrap();
    assert_eq!((values[0].integer_value, values[1].double_value, values[2].type_), (7, 0.5, 0));
    assert!(["key1", "key2", "rate"].iter().all(|name| names.iter().any(|known| known == name)), "{names:?}");
    let expected =
        [("key1".into(), ParameterValue::Integer(7)), ("key2".into(), ParameterValue::Integer(-3))];
    assert_eq!(events, expected);
    Ok(())
}
