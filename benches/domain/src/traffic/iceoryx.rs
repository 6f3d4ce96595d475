// SPDX-License-Identifier: MIT OR Apache-2.0
//! iceoryx2 as its users write it: a publish-subscribe service and an event service for each topic, and one `WaitSet` for all of a
//! process.

use super::{LOOK, Publishing};
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use std::os::unix::ffi::OsStrExt;
use std::path::Path as FilePath;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use tautline_exchange::{Inlet, Job, Line, Result, Role, Sink, Source, Stamp, say, stop_flag};
use tautline_rt::clock::monotonic_ns;

const MOST_SUBSCRIBERS: usize = 16;

pub fn run(job: &Job) -> Result<()> {
    let (own, stop) = (job.clone(), stop_flag());
    job.as_application(move || {
        let node = node(&own)?;
        match own.role {
            Role::Near => send(&node, &own, stop),
            Role::Far => receive(&node, &own, &stop),
        }
    })
}

type Data = iceoryx2::service::port_factory::publish_subscribe::PortFactory<ipc::Service, [u8], ()>;
type Event = iceoryx2::service::port_factory::event::PortFactory<ipc::Service>;

struct Outlet {
    publisher: Publisher<ipc::Service, [u8], ()>,
    notifier: Notifier<ipc::Service>,
}

struct Inbox {
    subscriber: Subscriber<ipc::Service, [u8], ()>,
    listener: Listener<ipc::Service>,
    inlet: Inlet,
}

fn send(node: &Node<ipc::Service>, job: &Job, go: Arc<AtomicBool>) -> Result<()> {
    let mut outlets = Vec::new();
    for topic in 0..job.way.topics {
        let data = data(node, job, topic)?;
        let publisher = data.publisher_builder().initial_max_slice_len(job.payload_bytes);
        let publisher = publisher.allocation_strategy(AllocationStrategy::Static).create()?;
        outlets.push(Outlet { publisher, notifier: event(node, job, topic)?.notifier_builder().create()? });
    }
    let (mut source, mut publishing) = (Source::new(job, go), Publishing::of(job));
    while let Some((topic, stamp)) = source.next() {
        let start_ns = monotonic_ns();
        let Outlet { publisher, notifier } = &outlets[topic];
        let mut loan = publisher.loan_slice_uninit(job.payload_bytes)?;
        stamp.write_uninit(loan.payload_mut(), false);
        // SAFETY: shared memory that the kernel zeroed when it was made; receivers read the stamp, which is written.
        unsafe { loan.assume_init() }.send()?;
        notifier.notify()?;
        publishing.add(monotonic_ns() - start_ns);
    }
    say(&Line::Measured(publishing.into(source.measured())));
    // What it sent is read from its memory.
    std::thread::sleep(LOOK);
    Ok(())
}

fn receive(node: &Node<ipc::Service>, job: &Job, stop: &AtomicBool) -> Result<()> {
    let sink = Sink::new(job);
    let mut inboxes = Vec::new();
    for (topic, inlet) in sink.inlets(job) {
        let subscriber = data(node, job, topic)?.subscriber_builder().create()?;
        inboxes.push(Inbox {
            subscriber,
            listener: event(node, job, topic)?.listener_builder().create()?,
            inlet,
        });
    }
    let waitset =
        WaitSetBuilder::new().signal_handling_mode(SignalHandlingMode::Disabled).create::<ipc::Service>()?;
    let mut guards = Vec::new();
    for inbox in &inboxes {
        guards.push(waitset.attach_notification(&inbox.listener)?);
    }
    say(&Line::Ready(None));
    while !stop.load(Ordering::Relaxed) {
        let mut failed = None;
        let on_event = |id: WaitSetAttachmentId<ipc::Service>| {
            let which = guards.iter().position(|guard| id.has_event_from(guard));
            if let Some(inbox) = which.and_then(|index| inboxes.get(index)) {
                failed = failed.take().or(inbox.take_all().err());
            }
            CallbackProgression::Continue
        };
        waitset.wait_and_process_once_with_timeout(on_event, LOOK)?;
        if let Some(error) = failed {
            return Err(error);
        }
    }
    say(&Line::Measured(sink.measured()));
    Ok(())
}

impl Inbox {
    fn take_all(&self) -> Result<()> {
        // Until none is left: iceoryx2 0.10 stops waking a listener that collects once per wake-up.
        while self.listener.try_wait(|_| {})? > 0 {}
        while let Some(sample) = self.subscriber.receive()? {
            let stamp = Stamp::read(sample.payload(), false)?;
            drop(sample);
            self.inlet.arrive(stamp);
        }
        Ok(())
    }
}

fn data(node: &Node<ipc::Service>, job: &Job, topic: usize) -> Result<Data> {
    let name = ServiceName::new(&format!("{}/{topic}/topic", job.topic))?;
    let topic = node.service_builder(&name).publish_subscribe::<[u8]>();
    let topic = topic.payload_alignment(Alignment::new(8).ok_or("8 is a power of two")?);
    let topic = topic.subscriber_max_buffer_size(job.depth()).max_publishers(1);
    Ok(topic.max_subscribers(MOST_SUBSCRIBERS).open_or_create()?)
}

fn event(node: &Node<ipc::Service>, job: &Job, topic: usize) -> Result<Event> {
    let name = ServiceName::new(&format!("{}/{topic}/event", job.topic))?;
    // Collecting events costs in proportion to the greatest id.
    let event = node.service_builder(&name).event().event_id_max_value(1);
    Ok(event.max_notifiers(1).max_listeners(MOST_SUBSCRIBERS).open_or_create()?)
}

/// A node that shares nothing with other users of iceoryx2 on this machine.
fn node(job: &Job) -> Result<Node<ipc::Service>> {
    set_log_level(LogLevel::Error);
    let directory = FilePath::new(job.endpoint.as_deref().ok_or("no directory for files")?);
    let prefix = directory.file_name().ok_or("the directory has no name")?;
    let mut config = Config::default();
    config.global.prefix = FileName::new(prefix.as_bytes())?;
    config.global.set_root_path(&Path::new(directory.as_os_str().as_bytes())?);
    Ok(NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()?)
}
