// SPDX-License-Identifier: MIT OR Apache-2.0
//! What disturbs a measurement under load: ordinary threads that compute, one that copies memory, and traffic on the loopback.

use std::hint::{black_box, spin_loop};
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use tautline_rt::{CoreSet, current_affinity, set_affinity};

/// What the load consists of, for the report.
pub const LOAD: &str = "a thread that computes on each of the two cores, one that copies 64 MiB to and fro, one that sends over a TCP connection of the loopback and one that receives, these on any core, all SCHED_OTHER";

/// More than any cache.
const COPIED_BYTES: usize = 64 << 20;

/// The load, until it is dropped.
pub struct Load {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Load {
    pub fn start(cores: [usize; 2]) -> std::io::Result<Self> {
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let out = TcpStream::connect(listener.local_addr()?)?;
        let (input, _) = listener.accept()?;
        // So that neither waits for the other at the end.
        out.set_write_timeout(Some(Duration::from_millis(100)))?;
        input.set_read_timeout(Some(Duration::from_millis(100)))?;
        let stop = Arc::new(AtomicBool::new(false));
        let spawn = |step: Box<dyn FnMut() + Send>| {
            let stop = stop.clone();
            let mut step = step;
            thread::spawn(move || {
                while !stop.load(Ordering::Relaxed) {
                    step();
                }
            })
        };
        // A new thread runs where the one does that starts it.
        let before = current_affinity().map_err(std::io::Error::other)?;
        let mut load = Load { stop: stop.clone(), threads: Vec::new() };
        for core in cores {
            set_affinity(CoreSet::one(core)).map_err(std::io::Error::other)?;
            load.threads.push(spawn(compute()));
        }
        set_affinity(before).map_err(std::io::Error::other)?;
        load.threads.extend([spawn(copy()), spawn(send(out)), spawn(receive(input))]);
        Ok(load)
    }
}

impl Drop for Load {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // Ignored: they do not panic.
            let _ = thread.join();
        }
    }
}

type Step = Box<dyn FnMut() + Send>;

fn compute() -> Step {
    Box::new(|| (0..100_000).for_each(|_| spin_loop()))
}

fn copy() -> Step {
    let (mut from, mut to) = (vec![1_u8; COPIED_BYTES], vec![2_u8; COPIED_BYTES]);
    Box::new(move || {
        to.copy_from_slice(&from);
        std::mem::swap(&mut from, &mut to);
        black_box(&to);
    })
}

fn send(mut stream: TcpStream) -> Step {
    let packet = vec![0_u8; 64 << 10];
    // Ignored: the other end was dropped.
    Box::new(move || drop(stream.write(&packet)))
}

fn receive(mut stream: TcpStream) -> Step {
    let mut packet = vec![0_u8; 64 << 10];
    Box::new(move || drop(stream.read(&mut packet)))
}
