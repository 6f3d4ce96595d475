// SPDX-License-Identifier: MIT OR Apache-2.0
//! A thread that carries, and is told what besides.

use std::sync::mpsc::{self, TryRecvError};
use tautline_rt::{JoinHandle, RtError, ThreadBuilder, ThreadInfo};

/// A thread that takes commands; dropping it ends it.
pub struct Worker<C> {
    commands: Option<mpsc::Sender<C>>,
    wake: Box<dyn Fn() + Send + Sync>,
    thread: Option<JoinHandle<()>>,
}

/// A command that does itself, with what the thread has.
pub type Job<T> = Box<dyn FnOnce(&mut T) + Send>;

impl<C: Send + 'static> Worker<C> {
    /// Starts the thread: it runs `run`, which returns when there will be no more commands. `wake` ends its wait, or else the next one.
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

    /// The thread, as it was read back.
    pub fn info(&self) -> Option<&ThreadInfo> {
        self.thread.as_ref().map(JoinHandle::info)
    }

    /// Leaves it a command.
    pub fn tell(&self, command: C) {
        if let Some(commands) = &self.commands {
            // Ignored: the thread ends when this does.
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

/// Gives `obey` the commands that are there. Whether there may be more.
pub fn commanded<C>(commands: &mpsc::Receiver<C>, mut obey: impl FnMut(C)) -> bool {
    loop {
        match commands.try_recv() {
            Ok(command) => obey(command),
            Err(error) => return error == TryRecvError::Empty,
        }
    }
}
