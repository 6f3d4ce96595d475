// SPDX-License-Identifier: MIT OR Apache-2.0
//! r2r's `clock.rs`, `sim_time_publisher.rs` and `timer_sim_time.rs`.

use futures::executor::LocalPool;
use futures::task::LocalSpawnExt;
use r2r::{Clock, ClockType, QosProfile};
use std::cell::RefCell;
use std::rc::Rc;
use std::sync::{Arc, Mutex};

#[test]
fn clocks() -> Result<(), Box<dyn std::error::Error>> {
    for kind in [r2r::ClockType::RosTime, r2r::ClockType::SystemTime, r2r::ClockType::SteadyTime] {
        let mut clock = r2r::Clock::create(kind)?;
        let now = clock.get_now()?;
        let time: r2r::builtin_interfaces::msg::Time = r2r::Clock::to_builtin_time(&now);
        assert_eq!(time.nanosec, now.subsec_nanos());
        assert!(format!("{:?}", clock.get_clock_type()).ends_with("Time"));
    }
    Ok(())
}

async fn timer_task(
    mut t: r2r::Timer,
    ros_clock: Arc<Mutex<Clock>>,
    mut system_clock: Clock,
) -> Result<(), Box<dyn std::error::Error>> {
    let mut iteration: i32 = 0;
    loop {
        let elapsed = t.tick().await?;
        let ros_time = ros_clock.lock().unwrap().get_now()?;
        let system_time = system_clock.get_now()?;
        assert!(elapsed.as_millis() >= 1000 && system_time > ros_time);
        iteration += 1;
        if iteration == 3 {
            break;
        }
    }
    Ok(())
}

#[test]
fn a_timer_on_simulated_time() -> Result<(), Box<dyn std::error::Error>> {
    let ctx = super::context(165, "");
    let mut node = r2r::Node::create(ctx, "testnode", "")?;
    let publisher = node.create_publisher("/clock", QosProfile::default().keep_last(1))?;
    let time_source: r2r::TimeSource = node.get_time_source();
    time_source.enable_sim_time(&mut node)?;

    let mut pool = LocalPool::new();
    let spawner = pool.spawner();
    let timer = node.create_timer(std::time::Duration::from_millis(1000))?;
    let is_done = Rc::new(RefCell::new(false));
    let task_is_done = is_done.clone();
    let ros_clock = node.get_ros_clock();
    let system_clock = Clock::create(ClockType::SystemTime)?;
    spawner.spawn_local(async move {
        timer_task(timer, ros_clock, system_clock).await.unwrap();
        *task_is_done.borrow_mut() = true;
    })?;

    let mut msg = r2r::rosgraph_msgs::msg::Clock::default();
    while !*is_done.borrow() {
        msg.clock.sec += 1;
        publisher.publish(&msg)?;
        node.spin_once(std::time::Duration::from_millis(100));
        pool.run_until_stalled();
    }
    time_source.disable_sim_time();
    let own = Arc::new(Mutex::new(Clock::create(ClockType::RosTime)?));
    time_source.attach_ros_clock(Arc::downgrade(&own))?;
    assert!(own.lock().unwrap().get_now()?.as_secs() > 1_600_000_000);
    Ok(())
}
