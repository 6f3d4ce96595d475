// SPDX-License-Identifier: MIT OR Apache-2.0

use std::panic::resume_unwind;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};

/// What goes on in a thread beside a measurement, until it is dropped at the latest.
#[derive(Debug)]
pub struct Beside<T> {
    stop: Arc<AtomicBool>,
    /// `None`: it was ended.
    thread: Option<JoinHandle<T>>,
}

impl<T: Send + 'static> Beside<T> {
    /// Starts `work`, which goes on until its flag is set.
    pub fn start(work: impl FnOnce(&AtomicBool) -> T + Send + 'static) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let thread = thread::spawn({
            let stop = stop.clone();
            move || work(&stop)
        });
        Beside { stop, thread: Some(thread) }
    }

    /// Ends it, and returns what it made.
    pub fn end(mut self) -> T {
        let ended = self.join().unwrap_or_else(|| unreachable!("it is ended once"));
        ended.unwrap_or_else(|panic| resume_unwind(panic))
    }
}

impl<T> Beside<T> {
    fn join(&mut self) -> Option<thread::Result<T>> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().map(JoinHandle::join)
    }
}

impl<T> Drop for Beside<T> {
    fn drop(&mut self) {
        // Ignored: what it made is not wanted, and its panic was printed.
        let _ = self.join();
    }
}
