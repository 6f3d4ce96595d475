// SPDX-License-Identifier: MIT OR Apache-2.0
//! A forwarding thread that takes commands.

use std::sync::mpsc::{self, TryRecvError};
use tautline_rt::{JoinHandle, RtError, ThreadBuilder, ThreadInfo};

/// A thread that takes commands; dropping it ends it.
pub struct Worker<C> {
    commands: Option<mpsc::Sender<C>>,
    wake: Box<dyn Fn() + Send + Sync>,
    thread: Option<JoinHandle<()>>,
}

/// A command as a closure over the thread's state.
pub type Job<T> = Box<dyn FnOnce(&mut T) + Send>;

impl<C: Send + 'static> Worker<C> {
    /// Starts the thread with `run`, which returns when no more commands can come. `wake` ends the thread's current or next wait.
    ///
    /// # Errors
    /// [`RtError`]: a missing privilege.
    pub fn start(
        thread: ThreadBuilder,
        wake: impl Fn() + Send + Sync + 'static,
        run: impl FnOnce(mpsc::Receiver<C>) + Send + 'static,
    ) -> Result<Self, RtError> {
        let (commands, received) = mpsc::channel();
        let thread = thread.spawn(move || move || run(received))?;
        Ok(Worker { commands: Some(commands), wake: Box::new(wake), thread: Some(thread) })
    }

    /// The thread, as read back at start.
    pub fn info(&self) -> Option<&ThreadInfo> {
        self.thread.as_ref().map(JoinHandle::info)
    }

    /// Sends a command.
    pub fn send(&self, command: C) {
        if let Some(commands) = &self.commands {
            // Ignored: the thread ends only when this is dropped.
            let _ = commands.send(command);
            (self.wake)();
        }
    }
}

impl<C> Drop for Worker<C> {
    fn drop(&mut self) {
        self.commands = None;
        (self.wake)();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Passes all pending commands to `obey`. Returns false when no more can come.
pub fn commanded<C>(commands: &mpsc::Receiver<C>, mut obey: impl FnMut(C)) -> bool {
    loop {
        match commands.try_recv() {
            Ok(command) => obey(command),
            Err(error) => return error == TryRecvError::Empty,
        }
    }
}
