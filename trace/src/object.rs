// SPDX-License-Identifier: MIT OR Apache-2.0
//! The objects of events.

use crate::description::{Description, ObjectKind, shortened};
use crate::event::ObjectId;
use crate::process::{self, ObjectEntry};
use tautline_rt::clock::monotonic_ns;

/// An object of events. Its description exists as long as this does.
#[derive(Debug)]
#[must_use = "dropping it removes the description from the trace"]
pub struct Object {
    id: ObjectId,
    entry: Option<ObjectEntry>,
}

impl Object {
    pub(crate) fn describe(
        kind: ObjectKind,
        parent: ObjectId,
        detail: u64,
        gid: [u64; 2],
        name: &str,
    ) -> Object {
        // Relaxed: ids are only compared, so any order will do. Not loom's type, which cannot be in a static.
        static NEXT: core::sync::atomic::AtomicU64 = core::sync::atomic::AtomicU64::new(2);
        let odd = kind == ObjectKind::Callback && parent == ObjectId::NONE;
        let id = ObjectId(NEXT.fetch_add(2, core::sync::atomic::Ordering::Relaxed) + u64::from(odd));
        let name = shortened(name);
        let description =
            Description { id, kind, parent, detail, gid, created_ns: monotonic_ns(), name: name.to_owned() };
        Object { id, entry: process::describe(&description) }
    }

    /// Its id.
    pub fn id(&self) -> ObjectId {
        self.id
    }
}

impl Drop for Object {
    fn drop(&mut self) {
        if let Some(entry) = self.entry.take() {
            process::forget(entry);
        }
    }
}
