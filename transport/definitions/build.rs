// SPDX-License-Identifier: MIT OR Apache-2.0
//! Lists the definitions of the bundled packages, which become part of the program.
//! (`definitions` is a link to those of `tautline-ros-msgs`; a published package has a copy of them.)

use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::{env, fs, io};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo::rerun-if-changed=definitions");
    println!("cargo::rerun-if-changed=build.rs");
    let folder = Path::new(&env::var_os("CARGO_MANIFEST_DIR").ok_or("cargo sets it")?).join("definitions");
    let mut list = String::from("const DEFINITIONS: &[(&str, &str)] = &[\n");
    for package in entries(&folder)?.iter().filter(|path| path.is_dir()) {
        for kind in entries(package)? {
            for file in entries(&kind)? {
                let name = file.strip_prefix(&folder)?.with_extension("");
                writeln!(list, "    ({name:?}, include_str!({file:?})),")?;
            }
        }
    }
    list.push_str("];\n");
    let out = env::var_os("OUT_DIR").ok_or("cargo sets it")?;
    fs::write(Path::new(&out).join("definitions.rs"), list)?;
    Ok(())
}

/// In order.
fn entries(folder: &Path) -> io::Result<BTreeSet<PathBuf>> {
    fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect()
}
