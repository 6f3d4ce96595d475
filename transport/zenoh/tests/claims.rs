// SPDX-License-Identifier: MIT OR Apache-2.0
//! What large messages from the network claim in shared memory: what is in use, and not all that could be.

mod support;

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use support::{Host, UNKNOWN_HASH, image_type, until};
use tautline_gateway::wire::{Attachment, Token, TopicKey, endpoint_gid};
use tautline_gateway::{Direction, Reading};
use tautline_transport::{Limits, Qos};
use zenoh::Wait;
use zenoh::qos::CongestionControl;

const DOMAIN: u32 = 88;
const IMAGES: u64 = 20;
const IMAGE_BYTES: usize = 16 << 20;
/// What one takes in shared memory: the next power of two above body and header.
const SAMPLE_BYTES: u64 = 32 << 20;
const DEPTH: usize = 10;

/// What the domain's files take.
fn claimed_bytes() -> u64 {
    use std::os::unix::fs::MetadataExt;
    let folder = Path::new("/dev/shm").join(tautline_rt::domain::shared_folder(DOMAIN));
    let files = std::fs::read_dir(folder).unwrap().flatten();
    files.filter_map(|file| file.metadata().ok()).map(|file| file.blocks() * 512).sum()
}

fn incoming(host: &Host) -> Option<Reading> {
    let topics = host.stats().topics.into_iter();
    topics.filter(|topic| topic.direction == Direction::In).map(|topic| topic.reading).next()
}

/// A node of another host publishes images faster than one takes them.
#[test]
fn a_first_large_message_claims_what_it_needs_and_none_is_lost() {
    let host = Host::first(DOMAIN, DOMAIN);
    // As many as a subscription of rmw_tautline holds.
    let limits = Limits { held: 64, ..Limits::default() };
    let qos = Qos::keep_last(DEPTH);
    let subscription =
        host.participant.create_raw_subscription("/image", &image_type(), qos, limits).unwrap();
    let peer = host.session();
    let hash = UNKNOWN_HASH.replace("df", "ab");
    let key = TopicKey::parse(&format!("{DOMAIN}/image/sensor_msgs::msg::dds_::Image_/{hash}")).unwrap();
    let token = format!(
        "@ros2_lv/{DOMAIN}/bad/0/1/MP/%/%/camera/%image/sensor_msgs::msg::dds_::Image_/{hash}/::,10:,:,:,,"
    );
    let gid = endpoint_gid(&Token::parse(&token).unwrap());
    let _token = peer.liveliness().declare_token(token).wait().unwrap();
    let camera = peer.declare_publisher(key.to_string()).congestion_control(CongestionControl::Block);
    let camera = camera.wait().unwrap();
    until("the gateway's subscription", || camera.matching_status().wait().unwrap().matching());
    until("the gateway's port", || incoming(&host).is_some());

    let before = claimed_bytes();
    let is_done = AtomicBool::new(false);
    let (most, numbers) = std::thread::scope(|scope| {
        let sampled = scope.spawn(|| {
            let mut most = 0;
            while !is_done.load(Ordering::Relaxed) {
                most = most.max(claimed_bytes());
                std::thread::sleep(std::time::Duration::from_millis(1));
            }
            most
        });
        scope.spawn(|| {
            for number in 1..=IMAGES {
                let attachment = Attachment { sequence_number: number as i64, source_timestamp_ns: 1, gid };
                let payload = [&[0, 1, 0, 0][..], &vec![number as u8; IMAGE_BYTES]].concat();
                camera.put(payload).attachment(&attachment.encode()[..]).wait().unwrap();
            }
        });
        let mut numbers = Vec::new();
        until("all images", || {
            while let Some(sample) = subscription.try_take_valid().unwrap() {
                let number = sample.info().sequence_number;
                let ends = (sample.body().len(), sample.body().first(), sample.body().last());
                assert_eq!(ends, (IMAGE_BYTES, Some(&(number as u8)), Some(&(number as u8))));
                numbers.push(number);
            }
            numbers.len() as u64 + subscription.counters().lost() >= IMAGES
        });
        is_done.store(true, Ordering::Relaxed);
        (sampled.join().unwrap(), numbers)
    });
    let claimed = most - before;
    println!("{claimed} bytes claimed at most");
    assert!(claimed <= (DEPTH as u64 + 5) * SAMPLE_BYTES, "{claimed}");
    assert!(numbers.iter().copied().eq(1..=IMAGES), "{numbers:?}");
    until("the counters", || incoming(&host).is_some_and(|reading| reading.messages == IMAGES));
    let reading = incoming(&host).unwrap();
    assert!(reading.lost == 0 && reading.dropped.is_empty(), "{reading:?}");
}
