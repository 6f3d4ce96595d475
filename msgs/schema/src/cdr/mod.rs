// SPDX-License-Identifier: MIT OR Apache-2.0
//! XCDR1 as ROS 2 uses it.
//!
//! Primitives are aligned to their size from the start of the body. A string is its length with the zero byte at the
//! end as `uint32`, then its UTF-8 and that byte. A `wstring` is the number of its UTF-16 units as `uint32`, then each
//! unit in *four* bytes and no zero: what Fast CDR of ROS 2 Jazzy writes. A sequence is its length, then its elements.

mod read;
mod validate;
mod write;

pub(crate) use read::{Failure, Reader};
pub(crate) use write::Writer;
