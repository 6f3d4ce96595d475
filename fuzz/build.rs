// SPDX-License-Identifier: MIT OR Apache-2.0
//! Lists the messages of the bundled packages.

use std::path::Path;
use std::{env, fs};

use tautline_gen::messages;
use tautline_schema::Packages;

const DEFINITIONS: &str = "../msgs/ros/definitions";

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo::rerun-if-changed={DEFINITIONS}");
    println!("cargo::rerun-if-changed=build.rs");
    let mut packages = Packages::new();
    packages.add_folder(DEFINITIONS);
    let all = packages.list();
    let names: Vec<&str> = all.iter().map(|name| name.package()).collect();
    let list: String = messages(&mut packages, &names)?
        .into_iter()
        .map(|ty| format!("    Entry::of::<tautline_ros_msgs::{}>(),\n", ty.path))
        .collect();
    let out = env::var_os("OUT_DIR").ok_or("cargo sets OUT_DIR")?;
    fs::write(Path::new(&out).join("entries.rs"), format!("const ENTRIES: &[Entry] = &[\n{list}];\n"))?;
    Ok(())
}
