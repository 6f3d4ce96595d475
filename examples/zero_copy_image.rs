//! Zero copy: 8 MiB are loaned, written in place, and read in place, at the same bytes of the same shared memory.
//!
//! Publisher and subscription map that memory separately, even here in one process, so their pointers differ. Where they
//! point to is compared: the file and the offset that /proc/self/maps gives for an address.
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use std::process::ExitCode;
use std::sync::mpsc;
use tautline::{CallbackOptions, Limits, Message, Node, Qos, Result};
use tautline_examples::{context, exit_code};

#[derive(Message, Clone, Copy)]
#[repr(C)]
#[message(name = "demo_msgs/msg/Image")]
struct Image {
    pixels: [u8; 8 << 20],
}

fn main() -> ExitCode {
    exit_code(show())
}

fn show() -> Result<()> {
    let context = context()?;
    let mut node = Node::create(context.clone(), "camera", "")?;
    // The memory of all images that can be in flight is claimed at the start: these are few.
    node.set_topic_limits("/image", Limits { held: 1, loans: 1, ..Limits::default() })?;
    let qos = Qos::keep_last(1);
    let mut images = node.subscribe::<Image>("/image", qos)?;
    let publisher = node.create_publisher::<Image>("/image", qos)?;

    let (read_at, arrived) = mpsc::channel();
    let reader = node.spawn_callback(CallbackOptions::fifo(10).name("/image"), async move {
        if let Some(image) = images.next().await {
            println!("read:    {} bytes, checksum {:016x}", image.pixels.len(), checksum(&image.pixels));
            let _ = read_at.send(place_of(&image.pixels));
        }
        context.shutdown();
    })?;

    // Pages that were never written hold zeros: no image is ever built elsewhere and moved in.
    let mut image = publisher.loan().expect("one loan is free");
    for (pixel, index) in image.pixels.iter_mut().zip(0u32..) {
        *pixel = (index.wrapping_mul(0x9e37_79b9) >> 24) as u8;
    }
    println!("written: {} bytes, checksum {:016x}", image.pixels.len(), checksum(&image.pixels));
    let written_at = place_of(&image.pixels);
    image.publish().expect("keep-last never refuses");

    node.spin()?;
    reader.join()?;
    let read_at = arrived.recv().ok().flatten();
    println!("read where it was written: {}", written_at.is_some() && read_at == written_at);
    Ok(())
}

/// FNV-1a.
fn checksum(bytes: &[u8]) -> u64 {
    bytes
        .iter()
        .fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3))
}

/// The file that is mapped at these bytes, and their offset in it.
fn place_of(bytes: &[u8]) -> Option<(String, u64)> {
    let address = bytes.as_ptr() as u64;
    let number = |text| u64::from_str_radix(text, 16).ok();
    // first-last permissions offset device inode path
    std::fs::read_to_string("/proc/self/maps").ok()?.lines().find_map(|line| {
        let mut fields = line.split_ascii_whitespace();
        let (first, last) = fields.next()?.split_once('-')?;
        let (first, last) = (number(first)?, number(last)?);
        let (offset, path) = (number(fields.nth(1)?)?, fields.nth(2)?);
        (first <= address && address < last).then(|| (path.to_owned(), offset + (address - first)))
    })
}
