// SPDX-License-Identifier: MIT OR Apache-2.0
//! The same messages as `cdr-encoding` (serde) and `hiroz-cdr` (its own traits) would have them: bytes as `serde_bytes`,
//! numbers in bulk, as the code that `hiroz-codegen` writes does. Both write into a buffer that is used again.

use byteorder::{ByteOrder, LittleEndian};
use hiroz_cdr::{CdrBuffer, CdrDeserialize, CdrReader, CdrSerialize, CdrWriter};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::Result;

/// How one encoder makes bytes of a message, and a message of them again.
pub trait Rival<M> {
    const NAME: &'static str;
    fn encode(message: &M, buffer: &mut Vec<u8>) -> Result<()>;
    fn decode(buffer: &[u8]) -> Result<M>;
}

/// Of RustDDS.
pub enum CdrEncoding {}

impl<M: Serialize + DeserializeOwned> Rival<M> for CdrEncoding {
    const NAME: &'static str = "cdr-encoding";

    fn encode(message: &M, buffer: &mut Vec<u8>) -> Result<()> {
        buffer.clear();
        Ok(cdr_encoding::to_writer::<M, LittleEndian, _>(buffer, message)?)
    }

    fn decode(buffer: &[u8]) -> Result<M> {
        Ok(cdr_encoding::from_bytes::<M, LittleEndian>(buffer)?.0)
    }
}

/// Of hiroz, ROS 2 over Zenoh.
pub enum Hiroz {}

impl<M: CdrSerialize + CdrDeserialize> Rival<M> for Hiroz {
    const NAME: &'static str = "hiroz-cdr";

    fn encode(message: &M, buffer: &mut Vec<u8>) -> Result<()> {
        buffer.clear();
        message.cdr_serialize(&mut CdrWriter::<LittleEndian>::new(buffer));
        Ok(())
    }

    fn decode(buffer: &[u8]) -> Result<M> {
        Ok(M::cdr_deserialize(&mut CdrReader::<LittleEndian>::new(buffer))?)
    }
}

/// A struct for both. `list` and `array` stand before what is moved at once: numbers, and covariances of 9.
macro_rules! message {
    ($name:ident { $($field:ident: $($kind:ident)? [$ty:ty]),* $(,)? }) => {
        #[derive(Debug, PartialEq, Serialize, Deserialize)]
        pub struct $name {
            $(pub $field: $ty,)*
        }

        impl CdrSerialize for $name {
            #[inline]
            fn cdr_serialize<BO: ByteOrder, B: CdrBuffer>(&self, writer: &mut CdrWriter<'_, BO, B>) {
                $(message!(@write $($kind)?, self.$field, writer);)*
            }
        }

        impl CdrDeserialize for $name {
            #[inline]
            fn cdr_deserialize<'de, BO: ByteOrder>(
                reader: &mut CdrReader<'de, BO>,
            ) -> hiroz_cdr::Result<Self> {
                Ok(Self { $($field: message!(@read $($kind)?, reader),)* })
            }
        }
    };
    (@write , $value:expr, $writer:ident) => { $value.cdr_serialize($writer) };
    (@write list, $value:expr, $writer:ident) => {{
        $writer.write_sequence_length($value.len());
        if !$value.is_empty() {
            $writer.write_pod_slice(&$value);
        }
    }};
    (@write array, $value:expr, $writer:ident) => { $writer.write_pod_slice(&$value) };
    (@read , $reader:ident) => { CdrDeserialize::cdr_deserialize($reader)? };
    (@read list, $reader:ident) => {{
        let len = $reader.read_sequence_length()?;
        $reader.read_pod_slice(len)?.into()
    }};
    (@read array, $reader:ident) => {
        $reader.read_pod_slice(9)?.try_into().map_err(|_| hiroz_cdr::Error::UnexpectedEof)?
    };
}

message!(Time { sec: [i32], nanosec: [u32] });
message!(Header { stamp: [Time], frame_id: [String] });
message!(Vector3 { x: [f64], y: [f64], z: [f64] });
message!(Quaternion { x: [f64], y: [f64], z: [f64], w: [f64] });
message!(Twist { linear: [Vector3], angular: [Vector3] });
message!(Imu {
    header: [Header],
    orientation: [Quaternion],
    orientation_covariance: array[[f64; 9]],
    angular_velocity: [Vector3],
    angular_velocity_covariance: array[[f64; 9]],
    linear_acceleration: [Vector3],
    linear_acceleration_covariance: array[[f64; 9]],
});
message!(JointState {
    header: [Header],
    name: [Vec<String>],
    position: list [Vec<f64>],
    velocity: list [Vec<f64>],
    effort: list [Vec<f64>],
});
message!(Transform { translation: [Vector3], rotation: [Quaternion] });
message!(TransformStamped { header: [Header], child_frame_id: [String], transform: [Transform] });
message!(TFMessage { transforms: [Vec<TransformStamped>] });
message!(Image {
    header: [Header],
    height: [u32],
    width: [u32],
    encoding: [String],
    is_bigendian: [u8],
    step: [u32],
    data: list[Bytes],
});
message!(PointField { name: [String], offset: [u32], datatype: [u8], count: [u32] });
message!(PointCloud2 {
    header: [Header],
    height: [u32],
    width: [u32],
    fields: [Vec<PointField>],
    is_bigendian: [bool],
    point_step: [u32],
    row_step: [u32],
    data: list [Bytes],
    is_dense: [bool],
});

/// Bytes that serde moves at once.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Bytes(#[serde(with = "serde_bytes")] pub Vec<u8>);

impl std::ops::Deref for Bytes {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.0
    }
}

impl From<Vec<u8>> for Bytes {
    fn from(bytes: Vec<u8>) -> Self {
        Self(bytes)
    }
}
