// SPDX-License-Identifier: MIT OR Apache-2.0
//! Generates `track_msgs`.

fn main() -> Result<(), tautline_build::Error> {
    tautline_build::packages("msgs/")
}
