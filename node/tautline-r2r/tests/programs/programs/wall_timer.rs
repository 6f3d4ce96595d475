// SPDX-License-Identifier: MIT OR Apache-2.0
//! A task that is woken by a timer.

use futures::executor::LocalPool;
use futures::task::LocalSpawnExt;
use std::cell::RefCell;
use std::rc::Rc;

async fn timer_task(mut t: r2r::Timer) -> Result<(), Box<dyn std::error::Error>> {
    for _ in 0..10 {
        let elapsed = t.tick().await?;
        assert!(elapsed.as_millis() >= 1, "{elapsed:?}");
    }
    Ok(())
}

pub fn main() -> Result<(), Box<dyn std::error::Error>> {
    let ctx = r2r::Context::create()?;
    let mut node = r2r::Node::create(ctx, "testnode", "")?;
    let timer = node.create_wall_timer(std::time::Duration::from_millis(20))?;
    let mut pool = LocalPool::new();
    let spawner = pool.spawner();
    let is_done = Rc::new(RefCell::new(false));
    let task_is_done = is_done.clone();
    spawner.spawn_local(async move {
        timer_task(timer).await.unwrap();
        *task_is_done.borrow_mut() = true;
    })?;
    while !*is_done.borrow() {
        node.spin_once(std::time::Duration::from_millis(100));
        pool.run_until_stalled();
    }
    Ok(())
}
