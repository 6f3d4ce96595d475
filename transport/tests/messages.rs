// SPDX-License-Identifier: MIT OR Apache-2.0
//! Topics of generated types: written and read in place across processes, beside bytes and plain types, whatever a
//! publisher sends.

mod log;
mod support;

use rand::rngs::StdRng;
use rand::{Rng, RngExt};
use support::{Part, clean, domain, place_of, say, wait_for_some, wait_for_the_end};
use tautline_msgs::cdr::{DecodeFault, EncodeFault, WriteError, WriteFault};
use tautline_msgs::{Message, Plain};
use tautline_ros_msgs::geometry_msgs::msg::{Point32, PoseStamped, Twist};
use tautline_ros_msgs::sensor_msgs::msg::*;
use tautline_ros_msgs::shape_msgs::msg::{SolidPrimitive, SolidPrimitiveSizes};
use tautline_ros_msgs::std_msgs::msg::HeaderSizes;
use tautline_transport::{
    IncompatibleType, Limits, LoanError, Participant, PublishError, Publisher, Qos, RawPublisher, Sample,
    SendError, Subscription, TakeError, TopicType,
};

const POINTS: usize = 100_000;
const POINT_BYTES: usize = 16;
const PIXELS: usize = 8 << 20;
const FRAME: &str = "sensor";
const LIMITS: Limits = Limits { loans: 2, ..support::LIMITS };

fn header() -> HeaderSizes {
    HeaderSizes { frame_id: FRAME.len() }
}

fn image_sizes(data: usize) -> ImageSizes {
    ImageSizes { header: header(), encoding: 5, data }
}

fn write_image(image: &mut ImageWriter<'_, '_>) -> Result<(), WriteError> {
    image.header.frame_id.set(FRAME)?;
    image.height.set(2048);
    image.width.set(4096);
    image.step.set(4096);
    image.encoding.set("mono8")?;
    for (pixel, n) in image.data.slice_mut().iter_mut().zip(0u32..) {
        *pixel = (n >> 4) as u8;
    }
    image.default_rest();
    Ok(())
}

const FIELDS: [&str; 4] = ["x", "y", "z", "intensity"];
const FIELD_SIZES: [PointFieldSizes; 4] = [
    PointFieldSizes { name: 1 },
    PointFieldSizes { name: 1 },
    PointFieldSizes { name: 1 },
    PointFieldSizes { name: 9 },
];

fn cloud_sizes() -> PointCloud2Sizes<'static> {
    PointCloud2Sizes { header: header(), fields: &FIELD_SIZES, data: POINTS * POINT_BYTES }
}

fn write_cloud(cloud: &mut PointCloud2Writer<'_, '_>) -> Result<(), WriteError> {
    cloud.header.frame_id.set(FRAME)?;
    cloud.height.set(1);
    cloud.width.set(POINTS as u32);
    cloud.fields.each(|index, field| {
        field.name.set(FIELDS[index])?;
        field.offset.set(4 * index as u32);
        field.datatype.set(PointField::FLOAT32);
        field.count.set(1);
        Ok(())
    })?;
    cloud.point_step.set(POINT_BYTES as u32);
    cloud.row_step.set((POINTS * POINT_BYTES) as u32);
    for (point, n) in cloud.data.slice_mut().chunks_exact_mut(POINT_BYTES).zip(0u32..) {
        point.copy_from_slice(&[n as f32, 1.0, 2.0, 0.5].map(f32::to_le_bytes).concat());
    }
    cloud.is_dense.set(true);
    cloud.default_rest();
    Ok(())
}

/// The child's part of the tests here; without its variable it is no test.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    assert_eq!(part, "camera");
    let participant = Participant::new(domain).unwrap();
    let limits = Limits { message_bytes: 9 << 20, ..LIMITS };
    let images = participant.create_publisher::<Image>("/image", Qos::default(), limits).unwrap();
    let clouds = participant.create_publisher::<PointCloud2>("/points", Qos::default(), limits).unwrap();
    let tell = |data: &[u8]| {
        let place = place_of(data.as_ptr());
        say(&format!("{} {} {}", place.path, place.inode, place.offset));
    };
    let loan = images.loan_with(image_sizes(PIXELS)).unwrap();
    let loan = loan.write(|image| {
        write_image(image)?;
        tell(image.data.slice_mut());
        Ok(())
    });
    loan.unwrap().publish().unwrap();
    let loan = clouds.loan_with(cloud_sizes()).unwrap();
    let loan = loan.write(|cloud| {
        write_cloud(cloud)?;
        tell(cloud.data.slice_mut());
        Ok(())
    });
    loan.unwrap().publish().unwrap();
    assert_eq!((images.counters().growths(), clouds.counters().growths()), (0, 0));
    say("published");
    wait_for_the_end();
}

#[test]
fn images_and_clouds_of_another_process_are_read_in_that_ones_segment() {
    let participant = Participant::new(domain(189)).unwrap();
    let images = participant.create_subscription::<Image>("/image", Qos::default(), LIMITS).unwrap();
    let clouds = participant.create_subscription::<PointCloud2>("/points", Qos::default(), LIMITS).unwrap();
    let mut part = Part::start("camera", 189);
    let (image_place, cloud_place) = (part.hear(), part.hear());
    part.hear();
    let is_at = |data: &[u8], written: &str| {
        let (first, last) = (place_of(data.as_ptr()), place_of(data.last().unwrap()));
        assert_eq!(format!("{} {} {}", first.path, first.inode, first.offset), written);
        assert!(first.path.starts_with("/dev/shm/taut_189_"), "{first:?}");
        assert_eq!((last.inode, last.offset), (first.inode, first.offset + data.len() - 1));
    };

    let sample = wait_for_some("the image", || images.try_take().unwrap());
    let image = sample.view();
    assert_eq!((image.header().frame_id(), image.encoding()), (FRAME, "mono8"));
    assert_eq!((image.height(), image.width(), image.is_bigendian()), (2048, 4096, 0));
    assert!(
        image.data().len() == PIXELS && image.data().iter().zip(0u32..).all(|(p, n)| *p == (n >> 4) as u8)
    );
    is_at(image.data(), &image_place);

    let cloud_sample = wait_for_some("the cloud", || clouds.try_take().unwrap());
    let cloud = cloud_sample.view();
    let fields: Vec<_> = cloud.fields().iter().map(|field| (field.name(), field.offset())).collect();
    assert_eq!(fields, FIELDS.into_iter().zip([0, 4, 8, 12]).collect::<Vec<_>>());
    assert!(cloud.is_dense() && cloud.data().len() == POINTS * POINT_BYTES);
    let x = |point: &[u8]| f32::from_le_bytes(point[..4].try_into().unwrap());
    assert!(cloud.data().chunks_exact(POINT_BYTES).zip(0u32..).all(|(point, n)| x(point) == n as f32));
    is_at(cloud.data(), &cloud_place);

    part.kill();
    assert_eq!(sample.view().data()[PIXELS - 1], 0xff, "a held sample outlives its publisher");
    assert_eq!(sample.to_owned().data[PIXELS - 1], 0xff);
    drop((sample, cloud_sample, images, clouds, participant));
    clean(189);
}

/// A plain type with padding between its fields and after them.
#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(name = "test_msgs/msg/Gaps", crate = "tautline_msgs")]
#[repr(C)]
struct Gaps {
    flag: bool,
    wide: u64,
    last: u16,
}

#[test]
fn owned_plain_written_in_place_and_raw_ends_share_topics() {
    let participant = Participant::new(domain(194)).unwrap();
    let ends = Ends::<Image>::open(&participant, "/mixed");
    let owned = Image {
        header: with_frame(Default::default()),
        height: 2048,
        width: 4096,
        step: 4096,
        encoding: "mono8".into(),
        data: (0..1000u32).map(|n| (n >> 4) as u8).collect(),
        ..Image::default()
    };
    ends.publisher.publish(&owned).unwrap();
    ends.publisher.loan_with(image_sizes(1000)).unwrap().write(write_image).unwrap().publish().unwrap();
    ends.raw.publish(&owned.to_cdr().unwrap()[4..]).unwrap();
    ends.expect(&owned, 3);

    // What was in the memory before is not in the message.
    let loan = ends.publisher.loan_with(image_sizes(1000)).unwrap();
    loan.write(|image| {
        image.data.slice_mut().fill(0xff);
        image.header.frame_id.set(FRAME)?;
        image.encoding.set("rgba8")?;
        image.default_rest();
        Ok(())
    })
    .unwrap()
    .publish()
    .unwrap();
    ends.subscription.try_take().unwrap().unwrap();
    ends.publisher.publish(&owned).unwrap();
    assert_eq!(ends.subscription.try_take().unwrap().unwrap().to_owned(), owned);

    // The same with a plain type, which can be a `&mut T` as well.
    let ends = Ends::<Twist>::open(&participant, "/twist");
    let mut twist = Twist::default();
    twist.angular.z = -0.5;
    ends.publisher.publish(&twist).unwrap();
    let mut loan = ends.publisher.loan().unwrap();
    *loan = twist;
    loan.publish().unwrap();
    ends.publisher
        .loan_with(())
        .unwrap()
        .write(|writer| {
            tautline_msgs::cdr::Piece::<Twist>::default_rest(writer, Some(&twist));
            Ok(())
        })
        .unwrap()
        .publish()
        .unwrap();
    ends.raw.publish(&twist.to_cdr().unwrap()[4..]).unwrap();
    assert_eq!(ends.publisher.as_ref().limits().message_bytes, 48);
    ends.expect(&twist, 4);
}

fn with_frame(header: tautline_ros_msgs::std_msgs::msg::Header) -> tautline_ros_msgs::std_msgs::msg::Header {
    tautline_ros_msgs::std_msgs::msg::Header { frame_id: FRAME.into(), ..header }
}

/// Typed and raw ends of one topic.
struct Ends<T: Message> {
    publisher: Publisher<T>,
    raw: RawPublisher,
    subscription: Subscription<T>,
    raw_subscription: tautline_transport::RawSubscription,
}

impl<T: Message + PartialEq + std::fmt::Debug> Ends<T> {
    fn open(participant: &Participant, topic: &str) -> Self {
        let qos = Qos::default();
        let name = TopicType::new(T::TYPE_NAME);
        Ends {
            publisher: participant.create_publisher(topic, qos, LIMITS).unwrap(),
            raw: participant.create_raw_publisher(topic, &name, qos, LIMITS).unwrap(),
            subscription: participant.create_subscription(topic, qos, LIMITS).unwrap(),
            raw_subscription: participant.create_raw_subscription(topic, &name, qos, LIMITS).unwrap(),
        }
    }

    /// `count` samples with the same bytes, which are `message`.
    fn expect(&self, message: &T, count: usize) {
        let body = &message.to_cdr().unwrap()[4..];
        for n in 0..count {
            assert_eq!(self.raw_subscription.try_take().unwrap().unwrap().body(), body, "message {n}");
            let sample = self.subscription.try_take().unwrap().unwrap();
            assert_eq!((&sample.to_owned(), sample.as_ref().body()), (message, body), "message {n}");
        }
        assert!(self.subscription.try_take().unwrap().is_none());
    }
}

#[test]
fn padding_is_zero_whatever_was_assigned() {
    let participant = Participant::new(domain(194)).unwrap();
    let ends = Ends::<Gaps>::open(&participant, "/gaps");
    assert_eq!((Gaps::CDR_SIZE, Gaps::CONTENT_SIZE, size_of::<Gaps>()), (18, 11, 24));
    let value = Gaps { flag: true, wide: u64::MAX, last: 0x0102 };
    let body = [&[1, 0, 0, 0, 0, 0, 0, 0][..], &[0xff; 8], &[2, 1]].concat();
    for n in 0..20 {
        // Padding of another value than zero, as a value on a used stack has it.
        let mut used = std::mem::MaybeUninit::<Gaps>::uninit();
        // SAFETY: within the value; each field is set after.
        let used = unsafe {
            used.as_mut_ptr().cast::<u8>().write_bytes(0xee, size_of::<Gaps>());
            (*used.as_mut_ptr()).flag = value.flag;
            (*used.as_mut_ptr()).wide = value.wide;
            (*used.as_mut_ptr()).last = value.last;
            used
        };
        let mut loan = ends.publisher.loan().unwrap();
        // SAFETY: a whole Gaps, fields and padding, as an assignment may copy them.
        unsafe { std::ptr::copy_nonoverlapping(used.as_ptr().cast::<u8>(), (&raw mut *loan).cast(), 24) };
        assert_eq!(*loan, value);
        match n % 2 {
            0 => loan.publish().unwrap(),
            _ => loan.publish_released_at(5).unwrap(),
        }
        let sample = ends.subscription.try_take().unwrap().unwrap();
        assert_eq!((*sample, sample.as_ref().body()), (value, &body[..]));
        // SAFETY: a Gaps in shared memory, where padding has a value too.
        let memory = unsafe { std::slice::from_raw_parts((&raw const *sample).cast::<u8>(), 24) };
        assert_eq!(memory[18..], [0; 6], "nothing follows the body either");
    }
}

#[test]
fn what_cannot_be_written_is_said_and_nothing_is_sent() {
    let participant = Participant::new(domain(194)).unwrap();
    let ends = Ends::<Image>::open(&participant, "/errors");
    let publisher = &ends.publisher;
    let written = publisher.loan_with(image_sizes(4)).unwrap().write(|_| Ok(()));
    let error = written.err().unwrap();
    assert_eq!((error.field, error.fault), ("stamp", WriteFault::Unset), "{error}");
    let written = publisher.loan_with(image_sizes(4)).unwrap().write(|image| image.encoding.set("rgb"));
    let error = written.err().unwrap();
    assert_eq!(error.fault, WriteFault::Length { len: 3, stated: 5 });
    assert!(error.to_string().contains("state the one it has"), "{error}");
    assert_eq!(publisher.loan_with(image_sizes(usize::MAX)).err(), Some(LoanError::TooLarge));
    // Both loans came back.
    let loans = [(); 2].map(|()| publisher.loan_with(image_sizes(4)).unwrap());
    assert_eq!(publisher.loan_with(image_sizes(4)).err(), Some(LoanError::Exhausted));
    assert_eq!(publisher.publish(&Image::default()), Err(PublishError::Loan(LoanError::Exhausted)));
    drop(loans);
    assert!(ends.subscription.try_take().unwrap().is_none());

    // A bound: at most three dimensions.
    let solids = participant.create_publisher::<SolidPrimitive>("/solid", Qos::default(), LIMITS).unwrap();
    let bound = EncodeFault::Bound { len: 4, bound: 3 };
    let owned = SolidPrimitive { dimensions: vec![1.0; 4], ..SolidPrimitive::default() };
    let Err(PublishError::Encode(error)) = solids.publish(&owned) else { panic!("four dimensions") };
    assert_eq!((error.type_name, error.field, error.fault), (SolidPrimitive::TYPE_NAME, "dimensions", bound));
    let sizes = SolidPrimitiveSizes { dimensions: 4, ..SolidPrimitiveSizes::default() };
    let error = solids.loan_with(sizes).unwrap().write(|_| Ok(())).err().unwrap();
    assert_eq!((error.field, error.fault), ("dimensions", WriteFault::Encode(bound)));

    // A full keep-all queue gives the loan back, written as it is.
    let qos = Qos::keep_all(1);
    let publisher = participant.create_publisher::<Image>("/full", qos, LIMITS).unwrap();
    let subscription = participant.create_subscription::<Image>("/full", qos, LIMITS).unwrap();
    publisher.loan_with(image_sizes(7)).unwrap().write(write_image).unwrap().publish().unwrap();
    let loan = publisher.loan_with(image_sizes(9)).unwrap().write(write_image).unwrap();
    let Err(SendError { error: PublishError::Full, loan }) = loan.publish() else {
        panic!("a keep-all queue of 1 took 2")
    };
    assert_eq!(subscription.try_take().unwrap().unwrap().view().data().len(), 7);
    futures::executor::block_on(loan.publish_when_ready()).unwrap();
    assert_eq!(subscription.try_take().unwrap().unwrap().view().data().len(), 9);
}

#[test]
fn ends_of_other_types_do_not_match_and_both_are_named() {
    let participant = Participant::new(domain(194)).unwrap();
    let publisher = participant.create_publisher::<Image>("/hash", Qos::default(), LIMITS).unwrap();
    let slots = [(); 3].map(|()| participant.claim_slot().unwrap());
    let mut monitor = publisher.as_ref().monitor(&slots[0]);
    let hash = Image::TYPE_HASH.unwrap();
    let other = format!("RIHS01_{}", "5".repeat(64));
    let changed = TopicType::new(Image::TYPE_NAME).with_hash(other.clone());
    let raw = || participant.create_raw_subscription("/hash", &changed, Qos::default(), LIMITS).unwrap();
    let (raw, log) = log::of(raw);
    let said = |parts: &[&str]| log.iter().any(|line| parts.iter().all(|part| line.contains(part)));
    assert!(said(&[Image::TYPE_NAME, hash, &other, "/hash"]), "{log:?}");
    let found = |count| Some(IncompatibleType { total_count: count, total_count_change: 1 });
    assert_eq!(raw.monitor(&slots[1]).changes(0).incompatible_type, found(1));
    assert_eq!(monitor.changes().incompatible_type, found(1));
    let compressed =
        || participant.create_subscription::<CompressedImage>("/hash", Qos::default(), LIMITS).unwrap();
    let (compressed, log) = log::of(compressed);
    let said = |parts: &[&str]| log.iter().any(|line| parts.iter().all(|part| line.contains(part)));
    assert!(said(&[hash, CompressedImage::TYPE_HASH.unwrap(), CompressedImage::TYPE_NAME]), "{log:?}");
    let changes = compressed.as_ref().monitor(&slots[2]).changes(0);
    assert_eq!(
        (changes.incompatible_type, changes.matched, changes.incompatible_qos),
        (found(1), None, None)
    );
    assert_eq!((monitor.changes().incompatible_type, publisher.subscription_count()), (found(2), 0));
    publisher.publish(&Image::default()).unwrap();
    assert!(raw.try_take().unwrap().is_none() && compressed.try_take().unwrap().is_none());
    // All three are there for who looks, of no type that they agree on.
    let ends = participant.graph().unwrap().endpoints.iter().filter(|end| end.topic == "/hash").count();
    assert_eq!((ends, participant.topic_type("/hash").unwrap()), (3, None));

    let of = TopicType::of::<Image>();
    assert_eq!((of.hash.as_deref(), of.body_bytes), (Some(hash), None));
    assert!(of.definition.unwrap().contains("MSG: std_msgs/Header"));
    assert_eq!(TopicType::of::<Twist>().body_bytes, Some(48));
}

/// Bytes that may be a message: random, cut off, with a few bytes changed.
fn hostile(random: &mut StdRng, valid: &[u8]) -> Vec<u8> {
    let mut body = valid.to_vec();
    match random.random_range(0..4) {
        0 => {
            body = vec![0; random.random_range(0..300)];
            random.fill_bytes(&mut body);
        }
        1 => body.truncate(random.random_range(0..=valid.len())),
        2 => body.resize(valid.len() + random.random_range(0..30), random.random()),
        _ => {
            for _ in 0..random.random_range(1..4) {
                let at = random.random_range(0..body.len());
                body[at] =
                    *[0, 1, 2, 0x7f, 0x80, 0xff, random.random()].get(random.random_range(0..7)).unwrap();
            }
        }
    }
    body
}

#[test]
fn hostile_bytes_are_messages_or_counted_errors() {
    let header = with_frame(Default::default());
    attack(&Image { header: header.clone(), encoding: "rgb8".into(), data: vec![9; 48], ..Image::default() });
    attack(&JointState {
        header: header.clone(),
        name: vec!["left".into(), "".into(), "right_wheel_joint".into()],
        position: vec![1.0; 3],
        velocity: vec![],
        effort: vec![2.0],
    });
    attack(&PointCloud2 {
        header: header.clone(),
        fields: vec![PointField { name: "x".into(), ..PointField::default() }; 3],
        data: vec![1; 32],
        is_dense: true,
        ..PointCloud2::default()
    });
    attack(&PointCloud {
        header: header.clone(),
        points: vec![Point32::default(); 4],
        channels: vec![ChannelFloat32 { name: "i".into(), values: vec![1.0; 5] }; 2],
    });
    attack(&PoseStamped { header: header.clone(), ..PoseStamped::default() });
    attack(&CameraInfo { header, d: vec![0.5; 5], ..CameraInfo::default() });
    attack(&Gaps { flag: true, wide: 3, last: 4 });
    attack(&Twist::default());
}

fn attack<T>(message: &T)
where
    T: Message + std::fmt::Debug,
    for<'a> T::View<'a>: std::fmt::Debug,
{
    let mut random = tautline_seed::random();
    let participant = Participant::new(domain(194)).unwrap();
    let topic = format!("/attack/{}", T::TYPE_NAME.rsplit('/').next().unwrap());
    // Of a name alone: a publisher that knows nothing of sizes or hashes made the topic.
    let topic_type = TopicType::new(T::TYPE_NAME);
    let raw = participant.create_raw_publisher(&topic, &topic_type, Qos::default(), LIMITS).unwrap();
    let subscription = participant.create_subscription::<T>(&topic, Qos::default(), LIMITS).unwrap();
    let valid = &message.to_cdr().unwrap()[4..];
    let (mut read, mut refused) = (0, 0);
    for n in 0..3000 {
        let body = hostile(&mut random, valid);
        raw.publish(&body).unwrap();
        match subscription.try_take() {
            Ok(sample) => {
                let sample = sample.expect("it was published");
                read += 1;
                let owned = sample.to_owned();
                // A text of length 0 is read as an empty one, which is written with the zero that ends it: 8 bytes for 4.
                assert!(owned.cdr_len() <= 2 * body.len() + 8, "{n}: {body:?}");
                assert!(format!("{:?}", sample.view()) == format!("{sample:?}"));
                // Read as owned it is the same.
                let decoded = T::decode(&body, tautline_msgs::cdr::Endian::Little).unwrap();
                assert_eq!(decoded.to_cdr(), owned.to_cdr());
            }
            Err(TakeError::Invalid(error)) => {
                refused += 1;
                assert!(error.type_name.contains("/msg/") && error.offset <= body.len() + 8, "{error}");
            }
            Err(other) => panic!("{other}"),
        }
    }
    println!("{topic}: {read} read, {refused} refused");
    let counters = subscription.counters();
    assert_eq!((counters.invalid(), counters.lost(), counters.refused()), (refused, 0, 0));
    // The stream passes over what is none.
    raw.publish(&[0x77; 3]).unwrap();
    raw.publish(valid).unwrap();
    assert_eq!(subscription.try_take_valid().unwrap().unwrap().as_ref().body(), valid);
    assert_eq!(counters.invalid(), refused + 1);
}

#[test]
fn an_error_names_type_field_and_byte() {
    let participant = Participant::new(domain(194)).unwrap();
    let ends = Ends::<JointState>::open(&participant, "/named");
    let message = JointState { name: vec!["ab".into(), "cd".into()], ..JointState::default() };
    let mut body = message.to_cdr().unwrap()[4..].to_vec();
    let at = body.windows(2).position(|pair| pair == b"cd").unwrap();
    body[at] = 0xff;
    ends.raw.publish(&body).unwrap();
    let Err(TakeError::Invalid(error)) = ends.subscription.try_take() else { panic!("it is not UTF-8") };
    assert_eq!((error.fault, error.offset), (DecodeFault::Unicode, at));
    let text = TakeError::Invalid(error).to_string();
    let said = ["sensor_msgs/msg/JointState", "name[1]", &format!("byte {at}")];
    assert!(said.iter().all(|part| text.contains(part)), "{text}");
}

#[test]
fn late_joiners_get_messages_of_every_length() {
    let participant = Participant::new(domain(194)).unwrap();
    let qos = Qos::keep_last(4).transient_local();
    let limits = Limits { message_bytes: 64, ..LIMITS };
    let publisher = participant.create_publisher::<Image>("/late", qos, limits).unwrap();
    let lengths = [0, 5, 70_000, 1, 300];
    for data in lengths {
        publisher.loan_with(image_sizes(data)).unwrap().write(write_image).unwrap().publish().unwrap();
    }
    let subscription = participant.create_subscription::<Image>("/late", qos, limits).unwrap();
    for (number, data) in (2..).zip(&lengths[1..]) {
        let sample = wait_for_some("the history", || subscription.try_take().unwrap());
        assert_eq!((sample.view().data().len(), sample.info().sequence_number), (*data, number));
        assert!(sample.view().data().iter().zip(0u32..).all(|(pixel, n)| *pixel == (n >> 4) as u8));
    }
}

/// They are moved through streams and returned by value.
#[test]
fn samples_and_errors_are_small() {
    fn sample<T: Message>() -> usize {
        println!("{} bytes: a sample of {}", size_of::<Sample<T>>(), T::TYPE_NAME);
        size_of::<Sample<T>>()
    }
    assert!(sample::<Twist>() <= 128 && sample::<Image>() <= 256);
    assert!(sample::<PointCloud2>() <= 256 && sample::<CameraInfo>() <= 320);
    println!("{} and {} bytes: errors", size_of::<TakeError>(), size_of::<PublishError>());
    assert!(size_of::<TakeError>() <= 128 && size_of::<PublishError>() <= 64);
    fn is_send<S: Send + Sync>() {}
    is_send::<Sample<Image>>();
    is_send::<Sample<Twist>>();
}

/// Plain types with padding, so that they are written field by field.
mod padded {
    use tautline_msgs::{in_place, message, plain_struct};

    #[derive(Clone, Copy, Debug, Default, PartialEq)]
    #[repr(C)]
    pub struct Part {
        pub flag: bool,
        pub n: u16,
    }

    #[derive(Clone, Copy, Debug, Default, PartialEq)]
    #[repr(C)]
    pub struct Whole {
        pub parts: [Part; 2],
    }

    plain_struct! { "test_msgs/msg/Part"; Part { flag: bool, n: u16 } }
    in_place! { "test_msgs/msg/Part"; Part PartRef PartWriter (); { flag: bool as bool [], n: u16 as u16 [], } }
    plain_struct! { "test_msgs/msg/Whole"; Whole { parts: [Part; 2] } }
    in_place! {
        "test_msgs/msg/Whole";
        Whole WholeRef WholeWriter ();
        { parts: [Part; 2] as tautline_msgs::cdr::Seq<'a, Part> [], }
    }
    message! { plain Whole "test_msgs/msg/Whole" {} }
}

#[test]
fn a_plain_message_is_written_where_it_lies() {
    use padded::{Part, Whole};
    use tautline_msgs::cdr::{Carver, Fill};
    let participant = Participant::new(domain(194)).unwrap();
    let publisher = participant.create_publisher::<Whole>("/replaced", Qos::default(), LIMITS).unwrap();
    let whole = Whole { parts: [Part { flag: true, n: 1 }; 2] };
    let loan = publisher.loan_with(()).unwrap().write(|writer| {
        tautline_msgs::cdr::Piece::default_rest(writer, Some(&whole));
        Ok(())
    });
    assert_eq!(*loan.unwrap(), whole);

    // No bools where they will be.
    for _ in 0..LIMITS.loans {
        publisher.as_ref().publish(&[7; size_of::<Whole>()]).unwrap();
    }
    let memory = vec![0; size_of::<Whole>()].leak();
    let refused = publisher.loan_with(()).unwrap().write(|writer| {
        let mut elsewhere = <[Part; 2] as Fill>::carve(&[], &mut Carver::new(memory, 0))?;
        elsewhere.each(|_, part| {
            part.flag.set(true);
            part.n.set(1);
            Ok(())
        })?;
        writer.parts = elsewhere;
        Ok(())
    });
    assert_eq!(refused.err().map(|error| error.fault), Some(WriteFault::Elsewhere));
}
