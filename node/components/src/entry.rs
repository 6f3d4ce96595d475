// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::stamp::{STAMP, STAMP_BYTES};
use tautline::{CallbackHandle, Node};

/// Makes a component of the node that it is given: creates its topics, starts its callbacks, and hands these over to whoever
/// unloads it.
pub type Create = fn(Node) -> tautline::Result<Vec<CallbackHandle>>;

/// A component of a library.
#[derive(Clone, Copy)]
pub struct Plugin {
    /// Its name, such as `demo::Talker`.
    pub name: &'static str,
    /// What makes it.
    pub create: Create,
}

/// Its address tells the copies of this library in a process apart.
static COPY: u8 = 1;

/// What a library exports: first the stamp, as plain bytes; what follows is only looked at if the stamp is right.
#[repr(C)]
pub struct Library {
    stamp: [u8; STAMP_BYTES],
    copy: fn() -> *const u8,
    plugins: &'static [Plugin],
}

impl Library {
    /// What [`components!`](crate::components) exports.
    pub const fn new(plugins: &'static [Plugin]) -> Self {
        Library { stamp: STAMP, copy, plugins }
    }

    /// Whether the library uses this process's copy of Tautline, and not one of its own.
    pub(crate) fn shares_copy(&self) -> bool {
        std::ptr::eq((self.copy)(), copy())
    }

    pub(crate) fn plugins(&self) -> &'static [Plugin] {
        self.plugins
    }

    /// The stamp as it lies in memory.
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
        // The copy that the process has, too. A crate without it does not compile.
        extern crate tautline_dylib as _;

        /// Read by `tautline_components::Container`.
        // SAFETY: no other symbol of a program has this name.
        #[unsafe(no_mangle)]
        pub static TAUTLINE_COMPONENTS: $crate::Library =
            $crate::Library::new(&[$($crate::Plugin { name: $name, create: $create }),+]);
    };
}
