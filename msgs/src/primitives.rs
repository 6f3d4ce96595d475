// SPDX-License-Identifier: MIT OR Apache-2.0
//! `Plain` for the primitives of CDR and for arrays.

use core::any::type_name;

use crate::layout::{self, next_multiple};
use crate::{Invalid, Plain, Shape};

macro_rules! always_valid {
    ($($primitive:ty = $name:literal)*) => {$(
        // SAFETY: one primitive, little-endian (checked in lib.rs), any bits are a value. A target that aligns it to
        // less than its size fails the field-by-field proof of the derive.
        unsafe impl Plain for $primitive {
            const CDR_SIZE: usize = size_of::<Self>();
            const FIRST_ALIGN: usize = size_of::<Self>();
            const CONTENT_SIZE: usize = size_of::<Self>();
            const SHAPE: Shape = Shape::Primitive($name);
            const ALWAYS_VALID: bool = true;

            #[inline]
            fn clear_padding(_: &mut [u8]) {}

            #[inline]
            fn validate(_: &[u8]) -> Result<(), Invalid> {
                Ok(())
            }

            #[inline]
            fn write_fields(&self, out: &mut [u8]) {
                out[..Self::CDR_SIZE].copy_from_slice(&self.to_le_bytes());
            }
        }
    )*};
}

always_valid! {
    u8 = "uint8" u16 = "uint16" u32 = "uint32" u64 = "uint64" i8 = "int8" i16 = "int16" i32 = "int32" i64 = "int64"
    f32 = "float32" f64 = "float64"
}

// SAFETY: one byte, of which `validate` accepts 0 and 1, the two bit patterns of `bool`.
unsafe impl Plain for bool {
    const CDR_SIZE: usize = 1;
    const FIRST_ALIGN: usize = 1;
    const CONTENT_SIZE: usize = 1;
    const SHAPE: Shape = Shape::Primitive("bool");
    const ALWAYS_VALID: bool = false;

    #[inline]
    fn clear_padding(_: &mut [u8]) {}

    #[inline]
    fn validate(bytes: &[u8]) -> Result<(), Invalid> {
        match layout::read::<1, Self>(bytes)? {
            [0 | 1] => Ok(()),
            [other] => Err(Invalid::Value { offset: 0, value: other.into(), type_name: "bool" }),
        }
    }

    #[inline]
    fn write_fields(&self, out: &mut [u8]) {
        u8::from(*self).write_fields(out);
    }
}

// SAFETY: has the layout of `u32`; `validate` accepts what `char::from_u32` accepts, 0 among it.
unsafe impl Plain for char {
    const CDR_SIZE: usize = 4;
    const FIRST_ALIGN: usize = 4;
    const CONTENT_SIZE: usize = 4;
    const SHAPE: Shape = Shape::Primitive("uint32");
    const ALWAYS_VALID: bool = false;

    #[inline]
    fn clear_padding(_: &mut [u8]) {}

    #[inline]
    fn validate(bytes: &[u8]) -> Result<(), Invalid> {
        let value = u32::from_le_bytes(layout::read::<4, Self>(bytes)?);
        if char::from_u32(value).is_some() {
            return Ok(());
        }
        Err(Invalid::Value { offset: 0, value: value.into(), type_name: "char" })
    }

    #[inline]
    fn write_fields(&self, out: &mut [u8]) {
        u32::from(*self).write_fields(out);
    }
}

// SAFETY: the elements are `Plain` and evaluating `CDR_SIZE` proves that C's distance between two of them is CDR's.
unsafe impl<T: Plain, const N: usize> Plain for [T; N] {
    const CDR_SIZE: usize = {
        assert!(N > 0, "an array of length 0 has alignment in C but none in CDR: remove the field");
        if N > 1 && next_multiple(T::CDR_SIZE, T::FIRST_ALIGN) != size_of::<T>() {
            layout::array_error(size_of::<T>() - T::CDR_SIZE);
        }
        (N - 1) * size_of::<T>() + T::CDR_SIZE
    };
    const FIRST_ALIGN: usize = T::FIRST_ALIGN;
    const CONTENT_SIZE: usize = N * T::CONTENT_SIZE;
    const SHAPE: Shape = Shape::Array(&T::SHAPE, N);
    const ALWAYS_VALID: bool = T::ALWAYS_VALID;

    #[inline]
    fn clear_padding(memory: &mut [u8]) {
        if T::CONTENT_SIZE == size_of::<T>() {
            return;
        }
        let last = N - 1;
        for (index, element) in memory.chunks_mut(size_of::<T>()).take(N).enumerate() {
            T::clear_padding(element);
            if index != last {
                layout::clear(element, T::CDR_SIZE, size_of::<T>());
            }
        }
    }

    #[inline]
    fn validate(bytes: &[u8]) -> Result<(), Invalid> {
        if T::ALWAYS_VALID {
            return Ok(());
        }
        if bytes.len() < Self::CDR_SIZE {
            let type_name = type_name::<Self>();
            return Err(Invalid::Length { type_name, needed: Self::CDR_SIZE, len: bytes.len() });
        }
        // The last element comes without its trailing padding.
        for (i, element) in bytes.chunks(size_of::<T>()).take(N).enumerate() {
            T::validate(element).map_err(|fault| fault.at(i * size_of::<T>()))?;
        }
        Ok(())
    }

    fn write_fields(&self, out: &mut [u8]) {
        for (element, out) in self.iter().zip(out.chunks_mut(size_of::<T>())) {
            element.write_fields(out);
        }
    }
}
