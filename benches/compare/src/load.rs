// SPDX-License-Identifier: MIT OR Apache-2.0
//! What disturbs a measurement under load: ordinary threads that compute, one that copies memory, and traffic on the loopback.

use std::hint::{black_box, spin_loop};
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::Ordering;
use std::time::Duration;

use tautline_harness::Beside;
use tautline_rt::{CoreSet, current_affinity, set_affinity};

/// What the load consists of, for the report.
pub const LOAD: &str = "a thread that computes on each of the two cores, one that copies 64 MiB to and fro, one that sends over a TCP connection of the loopback and one that receives, these on any core, all SCHED_OTHER";

/// More than any cache.
const COPIED_BYTES: usize = 64 << 20;

/// Starts the load, which goes on until it is dropped.
pub fn start(cores: [usize; 2]) -> std::io::Result<Vec<Beside<()>>> {
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let out = TcpStream::connect(listener.local_addr()?)?;
    let (input, _) = listener.accept()?;
    // So that neither waits for the other at the end.
    out.set_write_timeout(Some(Duration::from_millis(100)))?;
    input.set_read_timeout(Some(Duration::from_millis(100)))?;
    // A new thread runs where the one does that starts it.
    let before = current_affinity().map_err(std::io::Error::other)?;
    let mut load = Vec::new();
    for core in cores {
        set_affinity(CoreSet::one(core)).map_err(std::io::Error::other)?;
        load.push(repeat(|| (0..100_000).for_each(|_| spin_loop())));
    }
    set_affinity(before).map_err(std::io::Error::other)?;
    load.extend([copy(), send(out), receive(input)]);
    Ok(load)
}

fn repeat(mut step: impl FnMut() + Send + 'static) -> Beside<()> {
    Beside::start(move |stop| {
        while !stop.load(Ordering::Relaxed) {
            step();
        }
    })
}

fn copy() -> Beside<()> {
    let (mut from, mut to) = (vec![1_u8; COPIED_BYTES], vec![2_u8; COPIED_BYTES]);
    repeat(move || {
        to.copy_from_slice(&from);
        std::mem::swap(&mut from, &mut to);
        black_box(&to);
    })
}

fn send(mut stream: TcpStream) -> Beside<()> {
    let packet = vec![0_u8; 64 << 10];
    // Ignored: the other end was dropped.
    repeat(move || drop(stream.write(&packet)))
}

fn receive(mut stream: TcpStream) -> Beside<()> {
    let mut packet = vec![0_u8; 64 << 10];
    repeat(move || drop(stream.read(&mut packet)))
}
