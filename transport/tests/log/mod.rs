// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is said in the log.
#![allow(dead_code, reason = "each test file uses a part")]

use std::io::Write;
use std::sync::{Arc, Mutex};

/// What `work` says in the log, in this thread.
pub fn of<T>(work: impl FnOnce() -> T) -> (T, Vec<String>) {
    let said = Arc::<Said>::default();
    let log = tracing_subscriber::fmt().with_ansi(false).with_writer(said.clone()).finish();
    (tracing::subscriber::with_default(log, work), said.lines())
}

/// What all threads of this process say from now on.
pub fn of_process() -> Arc<Said> {
    let said = Arc::<Said>::default();
    let log = tracing_subscriber::fmt().with_ansi(false).with_writer(said.clone()).finish();
    tracing::subscriber::set_global_default(log).unwrap();
    said
}

#[derive(Default)]
pub struct Said(Mutex<Vec<u8>>);

impl Said {
    pub fn lines(&self) -> Vec<String> {
        let text = String::from_utf8(self.0.lock().unwrap().clone()).unwrap();
        text.lines().map(str::to_owned).collect()
    }
}

impl Write for &Said {
    fn write(&mut self, text: &[u8]) -> std::io::Result<usize> {
        self.0.lock().unwrap().write(text)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}
