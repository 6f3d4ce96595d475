//! Zero copy for messages of any length: an Image of 8 MiB is written field by field in shared memory and read there.
//!
//! Its strings and its pixels may be of any length, so the lengths are stated first; then each field has its place in the
//! loan. `zero_copy_image` shows messages of a fixed size.
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use std::process::ExitCode;
use tautline::sensor_msgs::msg::{Image, ImageSizes};
use tautline::std_msgs::msg::HeaderSizes;
use tautline::{CallbackOptions, Limits, Node, Qos, Result};
use tautline_examples::{context, exit_code};

const WIDTH: u32 = 4096;
const HEIGHT: u32 = 2048;

fn main() -> ExitCode {
    exit_code(show())
}

fn show() -> Result<()> {
    let context = context()?;
    let mut node = Node::create(context.clone(), "camera", "")?;
    // Room for the largest image from the start, so that the first one is as fast as the others.
    let limits = Limits { message_bytes: 9 << 20, ..Limits::default() };
    node.set_topic_limits("/image_raw", limits)?;
    let qos = Qos::keep_last(1);
    let mut images = node.subscribe::<Image>("/image_raw", qos)?;
    let publisher = node.create_publisher::<Image>("/image_raw", qos)?;
    let counters = publisher.counters();

    let reader = node.spawn_callback(CallbackOptions::fifo(10).name("/image_raw"), async move {
        if let Some(sample) = images.next().await {
            // Getters borrow from shared memory: `frame_id` and `encoding` are a &str there, `data` is a &[u8].
            let image = sample.view();
            let (frame, encoding) = (image.header().frame_id(), image.encoding());
            println!("read:    {}x{} {encoding} from {frame}", image.width(), image.height());
            println!("         {} bytes, sum {}", image.data().len(), sum(image.data()));
        }
        context.shutdown();
    })?;

    let (frame, encoding) = ("camera_front", "mono8");
    let header = HeaderSizes { frame_id: frame.len() };
    let sizes = ImageSizes { header, encoding: encoding.len(), data: (WIDTH * HEIGHT) as usize };
    let loan = publisher.loan_with(sizes)?.write(|image| {
        image.header.frame_id.set(frame)?;
        image.width.set(WIDTH);
        image.height.set(HEIGHT);
        image.step.set(WIDTH);
        image.encoding.set(encoding)?;
        let pixels = image.data.slice_mut();
        for (pixel, index) in pixels.iter_mut().zip(0u32..) {
            *pixel = (index.wrapping_mul(0x9e37_79b9) >> 24) as u8;
        }
        println!("written: {} bytes, sum {}", pixels.len(), sum(pixels));
        image.default_rest(); // the time stamp and is_bigendian: a field that was forgotten is an error
        Ok(())
    })?;
    loan.publish()?;

    node.spin()?;
    reader.join()?;
    println!("memory grew {} times", counters.growths());
    Ok(())
}

fn sum(bytes: &[u8]) -> u64 {
    bytes.iter().map(|byte| u64::from(*byte)).sum()
}
