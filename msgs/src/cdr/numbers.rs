// SPDX-License-Identifier: MIT OR Apache-2.0
//! Numbers and `bool`. Slices of them are copied in bulk: the target is little-endian as the format is.

use crate::cdr::{DecodeFault, EncodeError, Endian, Fault, Form, Reader, Writer};

macro_rules! numbers {
    ($($type:ty)*) => {$(
        impl Form for $type {
            type Value = Self;
            const MIN_SIZE: usize = size_of::<Self>();

            #[inline]
            fn end(_: &Self, at: usize) -> usize {
                at.next_multiple_of(size_of::<Self>()) + size_of::<Self>()
            }

            #[inline]
            fn write(value: &Self, writer: &mut Writer<'_>) -> Result<(), EncodeError> {
                writer.put(size_of::<Self>(), &value.to_le_bytes())
            }

            #[inline]
            fn read(reader: &mut Reader<'_>) -> Result<Self, Fault> {
                let bytes = reader.take(size_of::<Self>(), size_of::<Self>())?.try_into().unwrap_or_default();
                Ok(match reader.endian() {
                    Endian::Little => Self::from_le_bytes(bytes),
                    Endian::Big => Self::from_be_bytes(bytes),
                })
            }

            #[inline]
            fn end_all(values: &[Self], at: usize) -> usize {
                if values.is_empty() { at } else { at.next_multiple_of(size_of::<Self>()) + size_of_val(values) }
            }

            #[inline]
            fn write_all(values: &[Self], writer: &mut Writer<'_>) -> Result<(), EncodeError> {
                if values.is_empty() {
                    return Ok(());
                }
                // SAFETY: the bytes of initialised numbers, which have no padding, for as long as they are borrowed.
                let bytes = unsafe {
                    core::slice::from_raw_parts(values.as_ptr().cast::<u8>(), size_of_val(values))
                };
                writer.put(size_of::<Self>(), bytes)
            }

            fn read_vec(reader: &mut Reader<'_>, len: usize) -> Result<Vec<Self>, Fault> {
                if len == 0 {
                    if size_of::<Self>() == 8 {
                        reader.add_slack();
                    }
                    return Ok(Vec::new());
                }
                let bytes = reader.take(size_of::<Self>(), len.saturating_mul(size_of::<Self>()))?;
                let mut values = Vec::<Self>::with_capacity(len);
                // SAFETY: `bytes` are `len` numbers, since `take` gave that many; so many fit into the new vector, and
                // any bytes are a number.
                unsafe {
                    core::ptr::copy_nonoverlapping(bytes.as_ptr(), values.as_mut_ptr().cast(), bytes.len());
                    values.set_len(len);
                }
                if reader.endian() == Endian::Big {
                    for value in &mut values {
                        *value = Self::from_be_bytes(value.to_le_bytes());
                    }
                }
                Ok(values)
            }

            fn read_array<const N: usize>(reader: &mut Reader<'_>) -> Result<[Self; N], Fault> {
                let bytes = reader.take(size_of::<Self>(), N.saturating_mul(size_of::<Self>()))?;
                let mut values = [Self::default(); N];
                for (value, bytes) in values.iter_mut().zip(bytes.chunks_exact(size_of::<Self>())) {
                    let bytes = bytes.try_into().unwrap_or_default();
                    *value = match reader.endian() {
                        Endian::Little => Self::from_le_bytes(bytes),
                        Endian::Big => Self::from_be_bytes(bytes),
                    };
                }
                Ok(values)
            }
        }
    )*};
}

numbers!(i8 u8 i16 u16 i32 u32 i64 u64 f32 f64);

impl Form for bool {
    type Value = Self;
    const MIN_SIZE: usize = 1;

    #[inline]
    fn end(_: &Self, at: usize) -> usize {
        at + 1
    }

    #[inline]
    fn write(value: &Self, writer: &mut Writer<'_>) -> Result<(), EncodeError> {
        writer.put(1, &[u8::from(*value)])
    }

    #[inline]
    fn read(reader: &mut Reader<'_>) -> Result<Self, Fault> {
        match reader.take(1, 1)? {
            [0] => Ok(false),
            [1] => Ok(true),
            other => {
                let value = other.first().copied().unwrap_or_default();
                Err(Fault::new(reader.position() - 1, DecodeFault::Bool { value }))
            }
        }
    }

    #[inline]
    fn end_all(values: &[Self], at: usize) -> usize {
        at + values.len()
    }

    #[inline]
    fn write_all(values: &[Self], writer: &mut Writer<'_>) -> Result<(), EncodeError> {
        // SAFETY: a `bool` is one initialised byte, 0 or 1.
        writer.put(1, unsafe { core::slice::from_raw_parts(values.as_ptr().cast(), values.len()) })
    }

    fn read_vec(reader: &mut Reader<'_>, len: usize) -> Result<Vec<Self>, Fault> {
        Ok(bools(reader, len)?.iter().map(|&byte| byte == 1).collect())
    }

    fn read_array<const N: usize>(reader: &mut Reader<'_>) -> Result<[Self; N], Fault> {
        let bytes: [u8; N] = bools(reader, N)?.try_into().unwrap_or([0; N]);
        Ok(bytes.map(|byte| byte == 1))
    }
}

/// A Unicode scalar value as `uint32`: what the derive allows in plain structs. ROS 2's own `char` is a `uint8`.
impl Form for char {
    type Value = Self;
    const MIN_SIZE: usize = 4;

    #[inline]
    fn end(_: &Self, at: usize) -> usize {
        u32::end(&0, at)
    }

    #[inline]
    fn write(value: &Self, writer: &mut Writer<'_>) -> Result<(), EncodeError> {
        u32::write(&u32::from(*value), writer)
    }

    #[inline]
    fn read(reader: &mut Reader<'_>) -> Result<Self, Fault> {
        let value = u32::read(reader)?;
        Self::from_u32(value).ok_or_else(|| {
            let fault = DecodeFault::Value { value: value.into(), type_name: &"char" };
            Fault::new(reader.position() - 4, fault)
        })
    }
}

/// Bytes that are 0 or 1.
#[inline]
fn bools<'a>(reader: &mut Reader<'a>, len: usize) -> Result<&'a [u8], Fault> {
    let start = reader.position();
    let bytes = reader.take(1, len)?;
    match bytes.iter().position(|&byte| byte > 1) {
        None => Ok(bytes),
        Some(index) => {
            let value = bytes.get(index).copied().unwrap_or_default();
            Err(reader.at_index(Fault::new(start + index, DecodeFault::Bool { value }), index))
        }
    }
}
