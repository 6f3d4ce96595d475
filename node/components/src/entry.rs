// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::stamp::{STAMP, STAMP_BYTES};
use tautline::{CallbackHandle, Node};

/// Creates a component with the given node: creates its topics, starts its callbacks, and returns these callbacks, so that
/// they can be ended when the component is unloaded.
pub type Create = fn(Node) -> tautline::Result<Vec<CallbackHandle>>;

/// A component of a library.
#[derive(Clone, Copy)]
pub struct Plugin {
    /// Its name, such as `demo::Talker`.
    pub name: &'static str,
    /// The function that creates it.
    pub create: Create,
}

/// Its address distinguishes the copies of this library in a process.
static COPY: u8 = 1;

/// The exported symbol of a library: first the stamp, as plain bytes. The rest is read only if the stamp is
/// correct.
#[repr(C)]
pub struct Library {
    stamp: [u8; STAMP_BYTES],
    copy: fn() -> *const u8,
    pub(crate) plugins: &'static [Plugin],
}

impl Library {
    /// The value that [`components!`](crate::components) exports.
    pub const fn new(plugins: &'static [Plugin]) -> Self {
        Library { stamp: STAMP, copy, plugins }
    }

    /// Whether the library uses this process's copy of Tautline, and not one of its own.
    pub(crate) fn shares_copy(&self) -> bool {
        std::ptr::eq((self.copy)(), copy())
    }

    /// The stamp's bytes.
    pub fn stamp(&self) -> &[u8; STAMP_BYTES] {
        &self.stamp
    }
}

#[inline(never)]
fn copy() -> *const u8 {
    &raw const COPY
}

/// Makes the crate, of type `cdylib`, a library of components: each has a name and a function that makes it of a node. The crate
/// depends on `tautline-dylib` as well.
///
/// ```ignore
/// use tautline::{CallbackHandle, CallbackOptions, Node, Result};
///
/// tautline_components::components! { "demo::Ticker" => ticker }
///
/// fn ticker(mut node: Node) -> Result<Vec<CallbackHandle>> {
///     let mut timer = node.create_wall_timer(std::time::Duration::from_millis(100))?;
///     let tick = async move { while timer.tick().await.is_ok() {} };
///     Ok(vec![node.spawn_callback(CallbackOptions::fifo(10), tick)?])
/// }
/// ```
#[macro_export]
macro_rules! components {
    ($($name:literal => $create:expr),+ $(,)?) => {
        // The copy that the process has, too. A crate without this dependency does not compile.
        extern crate tautline_dylib as _;

        /// Read by `tautline_components::Container`.
        // SAFETY: no other symbol of a program has this name.
        #[unsafe(no_mangle)]
        pub static TAUTLINE_COMPONENTS: $crate::Library =
            $crate::Library::new(&[$($crate::Plugin { name: $name, create: $create }),+]);
    };
}
