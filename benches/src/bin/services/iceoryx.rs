// SPDX-License-Identifier: MIT OR Apache-2.0
//! iceoryx2's request-response. It wakes nobody: an event service each way does.

use std::os::unix::ffi::OsStrExt;
use std::time::Duration;

use iceoryx2::prelude::*;
use tautline_benches::pair::Line;
use tautline_rt::{CoreSet, MemoryLock, Policy, lock_memory, prefault_stack, set_affinity, set_policy};

use crate::child::Clock;
use crate::{Job, PRIORITY, Result};

pub fn run(job: &Job) -> Result<()> {
    set_log_level(LogLevel::Error);
    let mut config = Config::default();
    config.global.prefix = FileName::new(job.prefix.as_bytes())?;
    config.global.set_root_path(&Path::new(job.directory.as_os_str().as_bytes())?);
    let node = NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()?;
    let service = node
        .service_builder(&ServiceName::new("ask")?)
        .request_response::<[u64], [u64; 8]>()
        .max_clients(1)
        .max_servers(1)
        .open_or_create()?;
    let event = |name: &str| -> Result<_> {
        let event = node.service_builder(&ServiceName::new(name)?).event().event_id_max_value(1);
        Ok(event.max_notifiers(1).max_listeners(1).open_or_create()?)
    };
    let (asked, answered) = (event("asked")?, event("answered")?);
    let patience = Duration::from_millis(100);
    if job.asks {
        let client = service
            .client_builder()
            .initial_max_slice_len(job.bytes / 8)
            .allocation_strategy(AllocationStrategy::Static)
            .create()?;
        let (notifier, listener) =
            (asked.notifier_builder().create()?, answered.listener_builder().create()?);
        go_realtime(job)?;
        let mut clock = Clock::new(job);
        while let Some(number) = clock.start() {
            let mut request = client.loan_slice_uninit(job.bytes / 8)?;
            request.payload_mut()[0].write(number);
            // SAFETY: zeroed by the kernel, or written before.
            let pending = unsafe { request.assume_init() }.send()?;
            notifier.notify()?;
            let answer = loop {
                if let Some(response) = pending.receive()? {
                    break response[0];
                }
                listener.timed_wait(|_| {}, patience)?;
                while listener.try_wait(|_| {})? > 0 {}
            };
            clock.end(answer);
        }
        set_policy(Policy::Other { nice: 0 })?;
        return clock.print();
    }
    let server = service.server_builder().create()?;
    let (notifier, listener) = (answered.notifier_builder().create()?, asked.listener_builder().create()?);
    go_realtime(job)?;
    Line::Ready.say()?;
    loop {
        listener.timed_wait(|_| {}, patience)?;
        while listener.try_wait(|_| {})? > 0 {}
        while let Some(request) = server.receive()? {
            let mut answer = [0; 8];
            answer[0] = request[0];
            request.loan_uninit()?.write_payload(answer).send()?;
            notifier.notify()?;
        }
    }
}

fn go_realtime(job: &Job) -> Result<()> {
    set_affinity(CoreSet::one(job.core))?;
    if job.realtime {
        lock_memory(MemoryLock::OnFault)?;
        prefault_stack(128 * 1024);
        set_policy(Policy::Fifo(PRIORITY))?;
    }
    Ok(())
}
