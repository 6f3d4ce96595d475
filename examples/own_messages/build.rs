// SPDX-License-Identifier: MIT OR Apache-2.0
//! Generates `track_msgs`. A crate that depends on `tautline` only needs `tautline_build::packages("msgs/")`.

fn main() -> Result<(), tautline_build::Error> {
    tautline_build::Builder::new()
        .folder("msgs/")
        .msgs("::tautline_msgs")
        .bundled("::tautline_ros_msgs")
        .generate()
}
