// SPDX-License-Identifier: MIT OR Apache-2.0
//! Generates the packages whose features are on, and a list of their messages for the tests.

use std::path::Path;
use std::{env, fs};

use tautline_gen::{Options, generate, messages};
use tautline_schema::Packages;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo::rerun-if-changed=definitions");
    println!("cargo::rerun-if-changed=build.rs");
    let mut packages = Packages::new();
    packages.add_folder("definitions");

    let enabled = |package: &&str| env::var_os(format!("CARGO_FEATURE_{}", package.to_uppercase())).is_some();
    let all = packages.list();
    let names: Vec<&str> = all.iter().map(|name| name.package()).filter(enabled).collect();
    let code = generate(&mut packages, &names, &Options::default())?;
    let list: String = messages(&mut packages, &names)?
        .into_iter()
        .map(|ty| {
            let constructor = if ty.is_plain { "plain" } else { "of" };
            format!("    Entry::{constructor}::<tautline_ros_msgs::{}>(),\n", ty.path)
        })
        .collect();

    let out = env::var_os("OUT_DIR").ok_or("cargo sets OUT_DIR")?;
    fs::write(Path::new(&out).join("packages.rs"), code)?;
    fs::write(Path::new(&out).join("entries.rs"), format!("const ENTRIES: &[Entry] = &[\n{list}];\n"))?;
    Ok(())
}
