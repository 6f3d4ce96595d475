// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clocks, and a timer on simulated time, which another node gives out.

use futures::{executor::LocalPool, task::LocalSpawnExt};
use r2r::{Clock, ClockType, QosProfile, rosgraph_msgs::msg};
use std::cell::RefCell;
use std::rc::Rc;
use std::sync::{Arc, Mutex};
use std::time::Duration;

async fn timer_task(
    mut t: r2r::Timer,
    ros_clock: Arc<Mutex<Clock>>,
    mut system_clock: Clock,
) -> Result<(), Box<dyn std::error::Error>> {
    for _ in 0..3 {
        let elapsed = t.tick().await?;
        let ros_time = ros_clock.lock().unwrap().get_now()?;
        let system_time = system_clock.get_now()?;
        assert!(elapsed.as_millis() >= 999, "{elapsed:?}");
        assert!(ros_time.as_secs() < 100_000 && system_time.as_secs() > 1_600_000_000);
    }
    Ok(())
}

pub fn main() -> Result<(), Box<dyn std::error::Error>> {
    r2r::assert_compiled_with_use_sim_time_support!();
    for kind in [ClockType::RosTime, ClockType::SystemTime, ClockType::SteadyTime] {
        let mut clock = Clock::create(kind)?;
        let now = clock.get_now()?;
        let time: r2r::builtin_interfaces::msg::Time = Clock::to_builtin_time(&now);
        assert_eq!(time.nanosec, now.subsec_nanos());
    }
    let ctx = r2r::Context::create()?;
    let mut simulator = r2r::Node::create(ctx.clone(), "clock_publisher", "")?;
    let publisher = simulator.create_publisher("/clock", QosProfile::default().keep_last(1))?;
    let mut node = r2r::Node::create(ctx, "testnode", "")?;
    let time_source = node.get_time_source();
    time_source.enable_sim_time(&mut node)?;

    let mut pool = LocalPool::new();
    let timer = node.create_timer(Duration::from_millis(1000))?;
    let is_done = Rc::new(RefCell::new(false));
    let task_is_done = is_done.clone();
    let ros_clock = node.get_ros_clock();
    let system_clock = Clock::create(ClockType::SystemTime)?;
    pool.spawner().spawn_local(async move {
        timer_task(timer, ros_clock, system_clock).await.unwrap();
        *task_is_done.borrow_mut() = true;
    })?;
    let mut time = Duration::ZERO;
    while !*is_done.borrow() {
        time += Duration::from_millis(500);
        publisher.publish(&msg::Clock { clock: Clock::to_builtin_time(&time) })?;
        node.spin_once(Duration::from_millis(20));
        pool.run_until_stalled();
    }
    time_source.disable_sim_time();
    Ok(())
}
