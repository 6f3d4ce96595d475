// SPDX-License-Identifier: MIT OR Apache-2.0
//! The hot path makes no heap allocation, being traced. A file of its own: it replaces the allocator.

mod support;

use futures::FutureExt;
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use support::{Count, Stop, domain, wait_for};
use tautline_ros_msgs::sensor_msgs::msg::{
    Image, ImageSizes, PointCloud2, PointCloud2Sizes, PointField, PointFieldSizes,
};
use tautline_transport::{
    Limits, Liveliness, MessageInfo, Participant, Qos, RequestId, ServiceType, TopicType, TracedSender,
};

const CYCLES: usize = 10_000;
const DOMAIN: u32 = 164;

/// The tests here run one after the other: a process's trace is of one domain, and what it tells of one of them is fetched at its end.
struct Alone {
    _guard: MutexGuard<'static, ()>,
}

fn alone() -> Alone {
    static ALONE: Mutex<()> = Mutex::new(());
    tautline_trace::configure(tautline_trace::TraceMode::On.into());
    Alone { _guard: ALONE.lock().unwrap_or_else(PoisonError::into_inner) }
}

impl Drop for Alone {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            support::traced(DOMAIN);
        }
    }
}

/// Counts what the current thread allocates and frees.
struct Counting;

thread_local! {
    static ALLOCATED: Cell<usize> = const { Cell::new(0) };
    static FREED: Cell<usize> = const { Cell::new(0) };
}

// SAFETY: System does the work; counting touches plain thread-locals that need no destructor.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATED.set(ALLOCATED.get() + 1);
        // SAFETY: the caller's promise.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        FREED.set(FREED.get() + 1);
        // SAFETY: the caller's promise.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Allocations and frees of `work`.
fn count(work: impl FnOnce()) -> (usize, usize) {
    let before = (ALLOCATED.get(), FREED.get());
    work();
    (ALLOCATED.get() - before.0, FREED.get() - before.1)
}

const NONE: (usize, usize) = (0, 0);

#[test]
fn publish_and_take() {
    let _alone = alone();
    let participant = Participant::new(domain(DOMAIN)).unwrap();
    let limits = Limits::default();
    let publisher = participant.create_publisher::<Count>("/heap", Qos::default(), limits).unwrap();
    let subscriptions = [(); 3]
        .map(|()| participant.create_subscription::<Count>("/heap", Qos::keep_last(2), limits).unwrap());
    let waker = futures::task::noop_waker();
    let mut context = std::task::Context::from_waker(&waker);
    let publish = |n| publisher.publish(&Count { n }).unwrap();
    // Whatever a thread sets up once: it gets its ring for trace events.
    publish(0);
    for subscription in &subscriptions {
        assert!(subscription.try_take().unwrap().is_some());
    }
    let (mut published, mut taken) = (NONE, NONE);
    let add = |sum: &mut (usize, usize), (allocated, freed)| {
        sum.0 += allocated;
        sum.1 += freed;
    };
    for n in 0..CYCLES {
        add(&mut published, count(|| publish(n as u64)));
        // One takes each, one polls each, one is mostly overwritten.
        add(&mut taken, count(|| assert!(subscriptions[0].try_take().unwrap().is_some())));
        add(&mut taken, count(|| assert!(subscriptions[1].poll_take(&mut context).is_ready())));
        add(&mut taken, count(|| assert!(subscriptions[1].poll_take(&mut context).is_pending())));
        if n % 10 == 0 {
            add(&mut taken, count(|| assert!(subscriptions[2].try_take().unwrap().is_some())));
        }
    }
    assert_eq!((published, taken), (NONE, NONE));
    // A sample that is dropped without being published.
    assert_eq!(count(|| drop(publisher.loan().unwrap())), NONE);
    assert!(support::traced(DOMAIN) > 3 * CYCLES, "publish and takes");
}

/// What gateways and bridges do with each message, and who plays a recording.
#[test]
fn passing_on() {
    let _alone = alone();
    let participant = Participant::new(domain(DOMAIN)).unwrap();
    let (limits, qos, source) = (Limits::default(), Qos::default(), MessageInfo::default());
    let text = TopicType::new("test_msgs/msg/Text");
    let port = participant.create_raw_publisher("/passed", &text, qos, limits).unwrap();
    let subscription = participant.create_raw_subscription("/passed", &text, qos, limits).unwrap();
    let sender = TracedSender::new("/passed", source.publisher_gid);
    let cycle = |number| {
        let source = MessageInfo { sequence_number: number, ..source };
        port.traced().received(&source);
        port.loan(8).unwrap().publish_as(source).unwrap();
        let sample = subscription.try_take().unwrap().unwrap();
        sender.sample((sample.port_gid(), sample.port_sequence_number()), number).record();
        port.loan(8).unwrap().publish_again(source).unwrap();
        assert!(subscription.try_take().unwrap().is_some());
    };
    cycle(1);
    assert_eq!(count(|| (0..CYCLES as u64).for_each(cycle)), NONE);
    assert!(support::traced(DOMAIN) > 5 * CYCLES, "receive, pass, publish, take, pass");
}

#[test]
fn publish_and_take_of_any_size_below_the_limit() {
    let _alone = alone();
    let participant = Participant::new(domain(DOMAIN)).unwrap();
    let limits = Limits { message_bytes: 100_000, ..Limits::default() };
    let (text, qos) = (TopicType::new("test_msgs/msg/Text"), Qos::default());
    let publisher = participant.create_raw_publisher("/text", &text, qos, limits).unwrap();
    let subscription = participant.create_raw_subscription("/text", &text, qos, limits).unwrap();
    let cycle = |len_bytes: usize| {
        let mut loan = publisher.loan(len_bytes).unwrap();
        if let Some(first) = loan.first_mut() {
            *first = 5;
        }
        loan.publish().unwrap();
        let sample = subscription.try_take().unwrap().unwrap();
        assert!(sample.body().len() == len_bytes && sample.body().first().is_none_or(|first| *first == 5));
    };
    cycle(0);
    let counted = count(|| (0..CYCLES).for_each(|n| cycle(n * 7919 % 100_001)));
    assert_eq!(counted, NONE);
    assert_eq!(publisher.counters().growths(), 0);
    assert!(count(|| cycle(100_100)).0 > 1, "a larger segment is made");
    assert_eq!(publisher.counters().growths(), 1);
    // The old segment goes when its last sample has come back.
    (0..2).for_each(cycle);
    assert_eq!(count(|| (0..CYCLES).for_each(|n| cycle(n * 13 % 100_001))), NONE, "that is all");
}

#[test]
fn write_and_view_in_place() {
    let _alone = alone();
    let participant = Participant::new(domain(DOMAIN)).unwrap();
    let limits = Limits { message_bytes: 9 << 20, ..Limits::default() };
    let qos = Qos::keep_last(2);
    let images = participant.create_publisher::<Image>("/image", qos, limits).unwrap();
    let image_in = participant.create_subscription::<Image>("/image", qos, limits).unwrap();
    let clouds = participant.create_publisher::<PointCloud2>("/points", qos, limits).unwrap();
    let cloud_in = participant.create_subscription::<PointCloud2>("/points", qos, limits).unwrap();
    let fields = [PointFieldSizes { name: 1 }; 3];
    let image = || {
        let sizes = ImageSizes { encoding: 5, data: 8 << 20, ..ImageSizes::default() };
        let loan = images.loan_with(sizes).unwrap();
        let loan = loan.write(|image| {
            image.header.stamp.value_mut().sec = 1;
            image.height.set(2048);
            image.width.set(4096);
            image.step.set(4096);
            image.is_bigendian.set(0);
            image.encoding.set("mono8")?;
            image.data.slice_mut()[..8].copy_from_slice(b"tautline");
            Ok(())
        });
        loan.unwrap().publish().unwrap();
        let sample = image_in.try_take().unwrap().unwrap();
        let image = sample.view();
        assert!(image.encoding() == "mono8" && image.data()[..8] == *b"tautline");
        assert!(image.header().frame_id().is_empty() && image.data().len() == 8 << 20);
    };
    let cloud = || {
        let sizes = PointCloud2Sizes { fields: &fields, data: 1_600_000, ..PointCloud2Sizes::default() };
        let loan = clouds.loan_with(sizes).unwrap();
        let loan = loan.write(|cloud| {
            cloud.fields.each(|index, field| {
                field.name.set(["x", "y", "z"][index])?;
                field.offset.set(4 * index as u32);
                field.datatype.set(PointField::FLOAT32);
                field.count.set(1);
                Ok(())
            })?;
            cloud.data.slice_mut()[0] = 5;
            cloud.default_rest();
            Ok(())
        });
        loan.unwrap().publish().unwrap();
        let sample = cloud_in.try_take().unwrap().unwrap();
        let cloud = sample.view();
        assert_eq!((cloud.fields().iter().map(|field| field.offset()).sum(), cloud.data()[0]), (12u32, 5));
    };
    image();
    cloud();
    assert_eq!(count(|| (0..CYCLES).for_each(|_| image())), NONE);
    assert_eq!(count(|| (0..CYCLES).for_each(|_| cloud())), NONE);

    // An owned message is written into the loan.
    let owned = Image { data: vec![1; 100_000], ..Image::default() };
    let publish = || {
        images.publish(&owned).unwrap();
        assert!(image_in.try_take().unwrap().unwrap().view().data() == owned.data);
    };
    assert_eq!(count(|| (0..100).for_each(|_| publish())), NONE);
    assert_eq!(images.counters().growths(), 0);
}

#[test]
fn deadline_lifespan_lease_and_who_watches_them() {
    let _alone = alone();
    let participant = Participant::new(domain(DOMAIN)).unwrap();
    let (hour, limits) = (Some(Duration::from_secs(3600)), Limits::default());
    let qos = Qos {
        deadline: hour,
        lifespan: hour,
        liveliness: Liveliness::ManualByTopic,
        liveliness_lease_duration: hour,
        ..Qos::keep_last(2)
    };
    let publisher = participant.create_publisher::<Count>("/watched", qos, limits).unwrap();
    let subscription = participant.create_subscription::<Count>("/watched", qos, limits).unwrap();
    let slots = [(); 2].map(|()| participant.claim_slot().unwrap());
    let mut offered = publisher.as_ref().monitor(&slots[0]);
    let mut requested = subscription.as_ref().monitor(&slots[1]);
    let (mut lost, mut n) = (0, 0);
    let mut cycle = || {
        publisher.assert_liveliness();
        publisher.publish(&Count { n }).unwrap();
        // Three are lost before each take.
        if n % 5 == 4 {
            assert!(subscription.try_take().unwrap().is_some());
            assert!(subscription.try_take().unwrap().is_some());
        }
        offered.changes();
        let changes = requested.changes(n);
        lost += changes.message_lost.map_or(0, |lost| lost.total_count_change);
        n += 1;
    };
    (0..5).for_each(|_| cycle());
    let counted = count(|| (0..CYCLES).for_each(|_| cycle()));
    assert_eq!(counted, NONE);
    assert_eq!(lost, n / 5 * 3, "all of them told");
}

#[test]
fn a_server_answers_while_clients_come_and_go() {
    let _alone = alone();
    let participant = Participant::new(domain(DOMAIN)).unwrap();
    let elsewhere = Participant::new(domain(DOMAIN)).unwrap();
    let service_type = ServiceType::new("test_srvs/srv/Bytes", None);
    let server = participant.create_raw_server("/asked", &service_type, 10, Limits::default()).unwrap();
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let _stop = Stop(&is_over);
            for _ in 0..100 {
                let client = elsewhere.create_raw_client("/asked", &service_type, Limits::default()).unwrap();
                wait_for("the server", || client.server_count() == 1);
                let pending = [(); 3].map(|()| client.send(client.loan(0).unwrap()).unwrap());
                for mut pending in pending {
                    wait_for("the answer", || match (&mut pending).now_or_never() {
                        None => false,
                        Some(answer) => answer.unwrap().body() == b"!",
                    });
                }
            }
        });
        let mut answered = 0;
        while !is_over.load(Ordering::SeqCst) {
            let counted = count(|| {
                let Some(request) = server.try_take().unwrap() else { return };
                let mut response = server.loan(RequestId::of(request.info()), 1).unwrap();
                response.fill(b'!');
                response.send().unwrap();
                answered += 1;
            });
            // The first time this thread gets its ring for trace events.
            assert!(counted == NONE || answered == 1, "{counted:?}");
        }
        assert_eq!(answered, 300);
    });
}
