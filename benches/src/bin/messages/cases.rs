// SPDX-License-Identifier: MIT OR Apache-2.0
//! The messages and, for each, the ways to handle it.

use std::hint::black_box;
use std::rc::Rc;

use tautline::msgs::cdr::{Endian, Fill, WriteError};
use tautline::msgs::{Message, Plain};
use tautline_ros_msgs::geometry_msgs::msg::{TransformStamped, TransformStampedSizes, Twist, Vector3};
use tautline_ros_msgs::sensor_msgs::msg::{
    Image, ImageSizes, Imu, ImuSizes, JointState, JointStateSizes, PointCloud2, PointCloud2Sizes, PointField,
    PointFieldSizes,
};
use tautline_ros_msgs::std_msgs::msg::{Header, HeaderSizes};
use tautline_ros_msgs::tf2_msgs::msg::{TFMessage, TFMessageSizes};

use crate::Result;
use crate::rivals::{self, CdrEncoding, Hiroz, Rival};
use crate::topic::Topic;

/// Filling a buffer of the message's size and reading it.
pub const FLOOR: (&str, &str) = ("floor", "plain buffer, filled and read");
/// Loan, write every field, publish, take, view, read every byte of the payload.
pub const IN_PLACE: (&str, &str) = ("tautline", "in place, filled and read");
/// The same without touching the payload: what the codec and the topic cost.
pub const PUBLISHED_ONLY: (&str, &str) = ("tautline", "in place, payload untouched");
/// Encoding an owned message and decoding it again.
pub const OWNED: &str = "owned, encoded and decoded";

pub const IMAGE: &str = "Image, 8 MiB";
pub const POINT_CLOUD: &str = "PointCloud2, 100,000 points";
pub const TWIST: &str = "Twist";
pub const IMU: &str = "Imu";
pub const JOINT_STATE: &str = "JointState, 12 joints";
pub const TF_MESSAGE: &str = "TFMessage, 8 transforms";

type Written = std::result::Result<(), WriteError>;

/// A message and the ways to handle it, the floor first.
pub struct Case {
    pub name: &'static str,
    pub bytes: usize,
    pub ways: Vec<Way>,
}

/// Handles a message once. The number depends on what was read.
pub struct Way {
    pub system: &'static str,
    pub mode: &'static str,
    pub run: Box<dyn FnMut() -> Result<u64>>,
}

impl Way {
    fn new((system, mode): (&'static str, &'static str), run: impl FnMut() -> Result<u64> + 'static) -> Self {
        Self { system, mode, run: Box::new(run) }
    }
}

pub fn all() -> Result<Vec<Case>> {
    Ok(vec![image()?, point_cloud()?, twist()?, imu()?, joint_state()?, tf()?])
}

/// The floor, ours and the rivals' encoders, for a message which they have as an `R` of the same bytes.
fn case<T, R>(name: &'static str, ours: T, in_place: Vec<Way>) -> Result<Case>
where
    T: Message + PartialEq,
    CdrEncoding: Rival<R>,
    Hiroz: Rival<R>,
    R: PartialEq + 'static,
{
    let bytes = ours.cdr_len();
    let mut buffer = vec![0u8; bytes];
    let mut byte = 0u8;
    let floor = Way::new(FLOOR, move || {
        byte = byte.wrapping_add(1);
        buffer.fill(byte);
        Ok(sum(black_box(&buffer)))
    });
    let mut ways = vec![floor];
    ways.extend(in_place);

    let mut body = vec![0; bytes];
    ours.encode(&mut body)?;
    ways.push(Way::new(("tautline", OWNED), {
        let mut body = body.clone();
        move || {
            let len = black_box(&ours).encode(&mut body)?;
            let again = T::decode(black_box(&body[..len]), Endian::Little)?;
            black_box(&again);
            Ok(len as u64)
        }
    }));
    let theirs: Rc<R> = Rc::new(CdrEncoding::decode(&body)?);
    ways.push(rival::<CdrEncoding, R>(theirs.clone(), &body)?);
    ways.push(rival::<Hiroz, R>(theirs, &body)?);
    Ok(Case { name, bytes, ways })
}

/// Encodes and decodes with another encoder, which must give the same bytes.
fn rival<E: Rival<R>, R: PartialEq + 'static>(message: Rc<R>, body: &[u8]) -> Result<Way> {
    let mut buffer = Vec::with_capacity(body.len());
    E::encode(&message, &mut buffer)?;
    if buffer != body || E::decode(&buffer)? != *message {
        return Err(format!("{} encodes another message", E::NAME).into());
    }
    Ok(Way::new((E::NAME, OWNED), move || {
        E::encode(black_box(&message), &mut buffer)?;
        let again = E::decode(black_box(&buffer))?;
        black_box(&again);
        Ok(buffer.len() as u64)
    }))
}

/// A message through a topic, written by `write` and read by `read`.
fn in_place<T: Message + Fill>(
    way: (&'static str, &'static str),
    sizes: T::Sizes<'static>,
    mut write: impl for<'a> FnMut(u8, &mut T::Writer<'a, 'static>) -> Written + 'static,
    mut read: impl for<'a> FnMut(T::View<'a>) -> u64 + 'static,
) -> Result<Way> {
    let topic = Topic::<T>::open()?;
    let mut byte = 0u8;
    Ok(Way::new(way, move || {
        byte = byte.wrapping_add(1);
        topic.write(sizes, |writer| write(byte, writer))?;
        topic.read(|sample| read(sample.view()))
    }))
}

/// A long message through a topic: with its payload filled and read, and with it untouched.
fn in_place_and_untouched<T: Message + Fill>(
    sizes: T::Sizes<'static>,
    write: for<'a> fn(u8, &mut T::Writer<'a, 'static>, bool) -> Written,
    data: for<'v, 'a> fn(&'v T::View<'a>) -> &'v [u8],
) -> Result<Vec<Way>> {
    Ok(vec![
        in_place::<T>(
            IN_PLACE,
            sizes,
            move |byte, message| write(byte, message, true),
            move |view| sum(data(&view)),
        )?,
        in_place::<T>(
            PUBLISHED_ONLY,
            sizes,
            move |byte, message| write(byte, message, false),
            move |view| data(&view).len() as u64,
        )?,
    ])
}

fn plain<T: Message + Plain>(message: T) -> Result<Way> {
    let topic = Topic::<T>::open()?;
    Ok(Way::new(IN_PLACE, move || {
        topic.write_plain(&message)?;
        topic.read(|sample| {
            black_box(&**sample);
            sample.info().sequence_number
        })
    }))
}

fn sum(bytes: &[u8]) -> u64 {
    let (words, rest) = bytes.as_chunks::<8>();
    let words = words.iter().fold(0u64, |sum, word| sum.wrapping_add(u64::from_le_bytes(*word)));
    rest.iter().fold(words, |sum, byte| sum.wrapping_add(u64::from(*byte)))
}

fn header() -> Header {
    Header { frame_id: "base_link".to_owned(), ..Header::default() }
}

const HEADER: HeaderSizes = HeaderSizes { frame_id: 9 };

fn write_header(header: &mut <Header as Fill>::Writer<'_, '_>, nanosec: u8) -> Written {
    header.stamp.value_mut().nanosec = nanosec.into();
    header.frame_id.set("base_link")
}

/// 8 MiB: 2,048 x 1,365 pixels of 3 bytes, and the rest of a row.
fn image() -> Result<Case> {
    const DATA: usize = 8 << 20;
    const SIZES: ImageSizes = ImageSizes { header: HEADER, encoding: 4, data: DATA };
    fn write(byte: u8, image: &mut <Image as Fill>::Writer<'_, 'static>, fill: bool) -> Written {
        write_header(&mut image.header, byte)?;
        image.height.set(2048);
        image.width.set(1365);
        image.encoding.set("rgb8")?;
        image.step.set(4096);
        image.is_bigendian.set(0);
        let data = image.data.slice_mut();
        if fill {
            data.fill(byte);
        }
        Ok(())
    }
    let ours = Image {
        header: header(),
        height: 2048,
        width: 1365,
        encoding: "rgb8".to_owned(),
        step: 4096,
        data: vec![7; DATA],
        ..Image::default()
    };
    let ways = in_place_and_untouched::<Image>(SIZES, write, |image| image.data())?;
    case::<_, rivals::Image>(IMAGE, ours, ways)
}

/// 100,000 points of x, y, z and intensity.
fn point_cloud() -> Result<Case> {
    const POINTS: usize = 100_000;
    const STEP: usize = 16;
    const NAMES: [&str; 4] = ["x", "y", "z", "intensity"];
    const FIELDS: [PointFieldSizes; 4] = [
        PointFieldSizes { name: 1 },
        PointFieldSizes { name: 1 },
        PointFieldSizes { name: 1 },
        PointFieldSizes { name: 9 },
    ];
    const SIZES: PointCloud2Sizes<'static> =
        PointCloud2Sizes { header: HEADER, fields: &FIELDS, data: POINTS * STEP };
    fn write(byte: u8, cloud: &mut <PointCloud2 as Fill>::Writer<'_, 'static>, fill: bool) -> Written {
        write_header(&mut cloud.header, byte)?;
        cloud.height.set(1);
        cloud.width.set(POINTS as u32);
        cloud.fields.each(|index, field| {
            field.name.set(NAMES[index])?;
            field.offset.set(4 * index as u32);
            field.datatype.set(PointField::FLOAT32);
            field.count.set(1);
            Ok(())
        })?;
        cloud.is_bigendian.set(false);
        cloud.point_step.set(STEP as u32);
        cloud.row_step.set((POINTS * STEP) as u32);
        let data = cloud.data.slice_mut();
        if fill {
            data.fill(byte);
        }
        cloud.is_dense.set(true);
        Ok(())
    }
    let field = |(index, name): (usize, &str)| PointField {
        name: name.to_owned(),
        offset: 4 * index as u32,
        datatype: PointField::FLOAT32,
        count: 1,
    };
    let ours = PointCloud2 {
        header: header(),
        height: 1,
        width: POINTS as u32,
        fields: NAMES.into_iter().enumerate().map(field).collect(),
        is_bigendian: false,
        point_step: STEP as u32,
        row_step: (POINTS * STEP) as u32,
        data: vec![7; POINTS * STEP],
        is_dense: true,
    };
    let ways = in_place_and_untouched::<PointCloud2>(SIZES, write, |cloud| cloud.data())?;
    case::<_, rivals::PointCloud2>(POINT_CLOUD, ours, ways)
}

fn twist() -> Result<Case> {
    let ours =
        Twist { linear: Vector3 { x: 0.5, y: 0.0, z: 0.0 }, angular: Vector3 { x: 0.0, y: 0.0, z: 0.1 } };
    case::<_, rivals::Twist>(TWIST, ours, vec![plain(ours)?])
}

fn imu() -> Result<Case> {
    let covariance = [0.25; 9];
    let ours = Imu {
        header: header(),
        orientation_covariance: covariance,
        angular_velocity_covariance: covariance,
        linear_acceleration_covariance: covariance,
        ..Imu::default()
    };
    let way = in_place::<Imu>(
        IN_PLACE,
        ImuSizes { header: HEADER },
        move |byte, imu| {
            write_header(&mut imu.header, byte)?;
            imu.orientation_covariance.copy_from(&covariance)?;
            imu.angular_velocity_covariance.copy_from(&covariance)?;
            imu.linear_acceleration_covariance.copy_from(&covariance)?;
            imu.orientation.value_mut().w = 1.0;
            imu.angular_velocity.set(Vector3::default());
            imu.linear_acceleration.set(Vector3::default());
            Ok(())
        },
        |imu| imu.orientation().w.to_bits() ^ imu.linear_acceleration_covariance()[8].to_bits(),
    )?;
    case::<_, rivals::Imu>(IMU, ours, vec![way])
}

fn joint_state() -> Result<Case> {
    const JOINTS: usize = 12;
    const SIZES: JointStateSizes<'static> = JointStateSizes {
        header: HEADER,
        name: &[8; JOINTS],
        position: JOINTS,
        velocity: JOINTS,
        effort: JOINTS,
    };
    let names: Vec<_> = (0..JOINTS).map(|joint| format!("joint_{joint:02}")).collect();
    let values = vec![0.5; JOINTS];
    let ours = JointState {
        header: header(),
        name: names.clone(),
        position: values.clone(),
        velocity: values.clone(),
        effort: values.clone(),
    };
    let way = in_place::<JointState>(
        IN_PLACE,
        SIZES,
        move |byte, joints| {
            write_header(&mut joints.header, byte)?;
            joints.name.each(|index, name| name.set(&names[index]))?;
            joints.position.copy_from(&values)?;
            joints.velocity.copy_from(&values)?;
            joints.effort.copy_from(&values)
        },
        |joints| {
            joints.name().iter().map(|name| name.len() as u64).sum::<u64>() + joints.effort().len() as u64
        },
    )?;
    case::<_, rivals::JointState>(JOINT_STATE, ours, vec![way])
}

fn tf() -> Result<Case> {
    const TRANSFORMS: usize = 8;
    const ONE: TransformStampedSizes = TransformStampedSizes { header: HEADER, child_frame_id: 7 };
    const SIZES: TFMessageSizes<'static> = TFMessageSizes { transforms: &[ONE; TRANSFORMS] };
    let names: Vec<_> = (0..TRANSFORMS).map(|link| format!("link_{link:02}")).collect();
    let transform = |name: &String| TransformStamped {
        header: header(),
        child_frame_id: name.clone(),
        ..Default::default()
    };
    let ours = TFMessage { transforms: names.iter().map(transform).collect() };
    let way = in_place::<TFMessage>(
        IN_PLACE,
        SIZES,
        move |byte, message| {
            message.transforms.each(|index, transform| {
                write_header(&mut transform.header, byte)?;
                transform.child_frame_id.set(&names[index])?;
                transform.transform.set(Default::default());
                Ok(())
            })
        },
        |message| message.transforms().iter().map(|one| one.transform().rotation.w as u64).sum(),
    )?;
    case::<_, rivals::TFMessage>(TF_MESSAGE, ours, vec![way])
}
