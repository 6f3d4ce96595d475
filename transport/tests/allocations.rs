// SPDX-License-Identifier: MIT OR Apache-2.0
//! The hot path's heap allocations, being traced: iceoryx2's one per loan, and none of ours. A file of its own: it replaces the
//! allocator.

mod support;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::{Cell, RefCell};
use std::time::{Duration, Instant};
use support::{Count, domain, wait_for};
use tautline_ros_msgs::sensor_msgs::msg::{
    Image, ImageSizes, PointCloud2, PointCloud2Sizes, PointField, PointFieldSizes,
};
use tautline_transport::{Limits, Liveliness, Participant, Qos, TopicType};

const CYCLES: usize = 10_000;

/// Counts what the current thread allocates and frees.
struct Counting;

thread_local! {
    static ALLOCATED: Cell<usize> = const { Cell::new(0) };
    static FREED: Cell<usize> = const { Cell::new(0) };
    static SIZES: RefCell<[usize; 8]> = const { RefCell::new([0; 8]) };
}

// SAFETY: System does the work; counting touches plain thread-locals that need no destructor.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let n = ALLOCATED.get();
        ALLOCATED.set(n + 1);
        SIZES.with_borrow_mut(|sizes| sizes[n % 8] = layout.size());
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

/// Until the janitor has looked at the new ports, which it does every 250 ms and tells them once: then they look at each
/// other again, which allocates.
fn settle(mut cycle: impl FnMut()) {
    let mut quiet_since = Instant::now();
    wait_for("the janitor's word on the new ports", || {
        if count(&mut cycle) != (1, 1) {
            quiet_since = Instant::now();
        }
        quiet_since.elapsed() > Duration::from_millis(600)
    });
}

#[test]
fn publish_and_take() {
    tautline_trace::configure(tautline_trace::TraceMode::On.into());
    let participant = Participant::new(domain(164)).unwrap();
    let limits = Limits::default();
    let publisher = participant.create_publisher::<Count>("/heap", Qos::default(), limits).unwrap();
    let subscriptions = [(); 3]
        .map(|()| participant.create_subscription::<Count>("/heap", Qos::keep_last(2), limits).unwrap());
    let waker = futures::task::noop_waker();
    let mut context = std::task::Context::from_waker(&waker);
    let publish = |n| publisher.publish(&Count { n }).unwrap();
    publish(0);
    for subscription in &subscriptions {
        assert!(subscription.try_take().unwrap().is_some());
    }

    settle(|| {
        publish(0);
        subscriptions.iter().for_each(|subscription| drop(subscription.try_take().unwrap()));
    });

    let (mut published, mut taken) = ((0, 0), (0, 0));
    let add = |sum: &mut (usize, usize), (allocated, freed)| {
        sum.0 += allocated;
        sum.1 += freed;
    };
    for n in 0..CYCLES {
        add(&mut published, count(|| publish(n as u64)));
        assert_eq!(SIZES.with_borrow(|sizes| sizes[(ALLOCATED.get() - 1) % 8]), 48, "iceoryx2's loan");
        // One takes each, one polls each, one is mostly overwritten.
        add(&mut taken, count(|| assert!(subscriptions[0].try_take().unwrap().is_some())));
        add(&mut taken, count(|| assert!(subscriptions[1].poll_take(&mut context).is_ready())));
        add(&mut taken, count(|| assert!(subscriptions[1].poll_take(&mut context).is_pending())));
        if n % 10 == 0 {
            add(&mut taken, count(|| assert!(subscriptions[2].try_take().unwrap().is_some())));
        }
    }
    assert_eq!(published, (CYCLES, CYCLES), "one per loan, freed by publishing");
    assert_eq!(taken, (0, 0));

    // A sample that is dropped without being published.
    assert_eq!(count(|| drop(publisher.loan().unwrap())), (1, 1));
    assert!(support::traced(164) > 3 * CYCLES, "publish and takes");
}

#[test]
fn publish_and_take_of_any_size_below_the_limit() {
    let participant = Participant::new(domain(180)).unwrap();
    let limits = Limits { message_bytes: 100_000, ..Limits::default() };
    let (text, qos) = (TopicType::new("test_msgs/msg/Text"), Qos::default());
    let publisher = participant.create_raw_publisher("/heap", &text, qos, limits).unwrap();
    let subscription = participant.create_raw_subscription("/heap", &text, qos, limits).unwrap();
    let cycle = |len_bytes: usize| {
        let mut loan = publisher.loan(len_bytes).unwrap();
        if let Some(first) = loan.first_mut() {
            *first = 5;
        }
        loan.publish().unwrap();
        let sample = subscription.try_take().unwrap().unwrap();
        assert!(sample.body().len() == len_bytes && sample.body().first().is_none_or(|first| *first == 5));
    };
    settle(|| cycle(0));
    let counted = count(|| (0..CYCLES).for_each(|n| cycle(n * 7919 % 100_001)));
    assert_eq!(counted, (CYCLES, CYCLES), "iceoryx2's loans, and none of ours");
    assert_eq!(publisher.counters().growths(), 0);
    assert!(count(|| cycle(100_001)).0 > 1, "a larger segment is made");
    assert_eq!(publisher.counters().growths(), 1);
    // The old segment goes when its last sample has come back.
    (0..2).for_each(cycle);
    assert_eq!(count(|| (0..CYCLES).for_each(|n| cycle(n * 13 % 100_001))), (CYCLES, CYCLES), "that is all");
}

#[test]
fn write_and_view_in_place() {
    let participant = Participant::new(domain(197)).unwrap();
    let limits = Limits { message_bytes: 9 << 20, depth: 2, ..Limits::default() };
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
    settle(image);
    settle(cloud);
    assert_eq!(
        count(|| (0..CYCLES).for_each(|_| image())),
        (CYCLES, CYCLES),
        "iceoryx2's loans, and none of ours"
    );
    assert_eq!(SIZES.with_borrow(|sizes| sizes[(ALLOCATED.get() - 1) % 8]), 48);
    assert_eq!(
        count(|| (0..CYCLES).for_each(|_| cloud())),
        (CYCLES, CYCLES),
        "iceoryx2's loans, and none of ours"
    );

    // An owned message is written into the loan.
    let owned = Image { data: vec![1; 100_000], ..Image::default() };
    let publish = || {
        images.publish(&owned).unwrap();
        assert!(image_in.try_take().unwrap().unwrap().view().data() == owned.data);
    };
    assert_eq!(count(|| (0..100).for_each(|_| publish())), (100, 100));
    assert_eq!(images.counters().growths(), 0);
}

#[test]
fn deadline_lifespan_lease_and_who_watches_them() {
    let participant = Participant::new(domain(164)).unwrap();
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
    let mut offered = publisher.raw().monitor(&slots[0]);
    let mut requested = subscription.raw().monitor(&slots[1]);
    let (mut lost, mut n) = (0, 0);
    let mut cycle = || {
        publisher.assert_liveliness();
        publisher.publish(&Count { n }).unwrap();
        // Three are lost before each take.
        if n % 5 == 4 {
            assert!(subscription.try_take().unwrap().is_some());
            assert!(subscription.try_take().unwrap().is_some());
        }
        offered.look();
        let changes = requested.look(n);
        lost += changes.message_lost.map_or(0, |lost| lost.total_count_change);
        n += 1;
    };
    settle(&mut cycle);
    let counted = count(|| (0..CYCLES).for_each(|_| cycle()));
    assert_eq!(counted, (CYCLES, CYCLES), "the loans");
    assert_eq!(lost, n / 5 * 3, "all of them told");
}
