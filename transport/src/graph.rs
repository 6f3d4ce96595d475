// SPDX-License-Identifier: MIT OR Apache-2.0
//! A domain's epoch: one word in shared memory that moves when a node, publisher, subscription, service or client appears or
//! goes.
//!
//! Who wants to know of changes compares it with what it read before it looked, or sleeps on it. A port that ends with its
//! killed process moves it when a janitor cleans up. The file stays when nobody is left, as iceoryx2's own per domain does.

use crate::error::TransportError;
use crate::nodes::Ownership;
use crate::sync::{FutexWord, Ordering};
use rustix::fs::{Mode, OFlags};
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;
use tautline_rt::clock::monotonic_ns;
use tautline_rt::shm::{self, Mapping};

/// What lies in the file: an atomic whose every value is valid.
#[repr(C)]
struct Layout {
    epoch: FutexWord,
}

const FILE_BYTES: usize = 4096;

/// The mapped word.
pub(crate) struct Graph {
    map: Mapping,
}

impl Graph {
    /// Maps the word of `domain`; the first one makes its file.
    pub(crate) fn open(domain: u32) -> Result<Arc<Self>, TransportError> {
        let path =
            Path::new(shm::DIRECTORY).join(format!("{}graph1", crate::participant::file_prefix(domain)));
        let make = || -> io::Result<Mapping> {
            let flags = OFlags::CREATE | OFlags::RDWR | OFlags::CLOEXEC | OFlags::NOFOLLOW;
            let file = rustix::fs::open(&path, flags, Mode::RUSR | Mode::WUSR)?;
            shm::check_owner(&file)?;
            // Whoever comes later does the same, which changes nothing.
            shm::claim(&file, 0, FILE_BYTES as u64)?;
            Mapping::new(&file, 0, FILE_BYTES, true)
        };
        let map = make().map_err(|source| TransportError::Graph { path: path.clone(), source })?;
        Ok(Arc::new(Graph { map }))
    }

    fn word(&self) -> &FutexWord {
        // SAFETY: `map` is a live, page-aligned mapping that is longer than a Layout, of which every bit pattern is valid.
        unsafe { &self.map.start().cast::<Layout>().as_ref().epoch }
    }

    pub(crate) fn epoch(&self) -> u32 {
        // Acquire: pairs with the Release in `advance`; what is listed after this shows that change.
        self.word().0.load(Ordering::Acquire)
    }

    pub(crate) fn advance(&self) {
        self.word().0.fetch_add(1, Ordering::Release);
        self.word().wake();
    }

    /// Has every sleeper look again.
    pub(crate) fn wake(&self) {
        self.word().wake();
    }

    /// Sleeps until the epoch is not `since`, at most for `timeout`. Returns the epoch.
    pub(crate) fn wait(&self, since: u32, timeout: Duration) -> u32 {
        self.wait_unless(since, timeout, &AtomicBool::new(false))
    }

    /// As [`wait`](Self::wait), or until it is woken and `stop` is set.
    pub(crate) fn wait_unless(&self, since: u32, timeout: Duration, stop: &AtomicBool) -> u32 {
        let timeout_ns = u64::try_from(timeout.as_nanos()).unwrap_or(u64::MAX);
        let end_ns = monotonic_ns().saturating_add(timeout_ns).min(i64::MAX as u64);
        while self.epoch() == since && monotonic_ns() < end_ns && !stop.load(Ordering::Acquire) {
            self.word().wait(since, Some(end_ns));
        }
        self.epoch()
    }
}

/// A port that is there, of a node if one is given: moves the epoch now, and when it is dropped, which is after the port.
pub(crate) struct Presence {
    owner: Option<Ownership>,
    graph: Arc<Graph>,
}

impl Presence {
    pub(crate) fn new(graph: &Arc<Graph>, owner: Option<Ownership>) -> Self {
        graph.advance();
        Presence { owner, graph: graph.clone() }
    }
}

impl Drop for Presence {
    fn drop(&mut self) {
        self.owner = None;
        self.graph.advance();
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use std::os::unix::fs::MetadataExt;

    #[test]
    fn its_memory_is_there_before_it_is_touched() {
        let graph = Graph::open(232).unwrap();
        let name = format!("{}graph1", crate::participant::file_prefix(232));
        let path = Path::new("/dev/shm").join(name);
        let file = std::fs::metadata(&path).unwrap();
        std::fs::remove_file(path).unwrap();
        assert_eq!((file.len(), file.blocks() * 512), (FILE_BYTES as u64, FILE_BYTES as u64));
        let epoch = graph.epoch();
        graph.advance();
        assert_ne!(graph.wait(epoch, Duration::ZERO), epoch);
    }
}
