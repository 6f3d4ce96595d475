// SPDX-License-Identifier: MIT OR Apache-2.0
//! Messages of the project's own definitions (`msgs/`, generated in `build.rs`), written in place and read in place.
#![forbid(unsafe_code)]

use std::error::Error;

use tautline::geometry_msgs::msg::Point;
use tautline::msgs::cdr::{self, WriteError};
use tautline::msgs::{Body, Message, Service};
use track_msgs::msg::{PlaceSizes, Track, TrackSizes, TrackWriter};

tautline::msgs::include_packages!();

/// What a topic lends with `Publisher::loan_with`.
#[repr(align(8))]
struct Memory([u8; 256]);

const PLACES: [(&str, Point); 2] =
    [("dock", Point { x: 0.0, y: 0.0, z: 0.0 }), ("gate", Point { x: 4.0, y: 1.5, z: 0.0 })];

fn main() -> Result<(), Box<dyn Error>> {
    println!("{} {}", Track::TYPE_NAME, Track::TYPE_HASH.unwrap_or_default());
    println!("{} {}", track_msgs::srv::Find::Service::TYPE_NAME, track_msgs::srv::Find::Service::TYPE_HASH);

    let mut memory = Memory([0; 256]);
    // Lengths first.
    let places = PLACES.map(|(name, _)| PlaceSizes { name: name.len() });
    let mut sizes = TrackSizes { places: &places, speeds: 2, ..TrackSizes::default() };
    sizes.header.frame_id = "map".len();
    let len = cdr::fill::<Track>(sizes, &mut memory.0, write)?;

    let track = Track::view(Body::new(&memory.0, len)?)?;
    println!(
        "{len} bytes in frame {:?}, closed: {}",
        track.header().frame_id(),
        track.kind() == Track::CLOSED
    );
    for (place, speed) in track.places().iter().zip(track.speeds()) {
        let Point { x, y, .. } = place.position();
        println!("{} at ({x}, {y}), within {} m, {speed} m/s", place.name(), place.radius());
    }

    // The bound of a name is 16 characters.
    let mut track = track.to_owned();
    track.places[1].name = "the gate at the end".to_owned();
    println!("{}", track.to_cdr().expect_err("19 characters"));
    Ok(())
}

/// Each field in its place, in any order.
fn write(track: &mut TrackWriter<'_, '_>) -> Result<(), WriteError> {
    track.kind.set(Track::CLOSED);
    track.header.frame_id.set("map")?;
    track.places.each(|index, place| {
        let (name, position) = PLACES[index];
        place.position.set(position);
        place.name.set(name).map(|()| place.default_rest()) // the radius of the definition
    })?;
    track.speeds.copy_from(&[0.5, 1.25])?;
    track.default_rest();
    Ok(())
}
