// SPDX-License-Identifier: MIT OR Apache-2.0
//! Lists the definitions of the bundled packages, to be part of the program. (`definitions` is a link to those of
//! `tautline-ros-msgs`: a published package has a copy of them.)

use std::fmt::Write;
use std::path::Path;
use std::{env, fs};

use tautline_schema::Packages;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo::rerun-if-changed=definitions");
    println!("cargo::rerun-if-changed=build.rs");
    let folder = Path::new(&env::var_os("CARGO_MANIFEST_DIR").ok_or("cargo sets it")?).join("definitions");
    let mut packages = Packages::new();
    packages.add_folder(&folder);
    let mut list = String::from("const DEFINITIONS: &[(&str, &str)] = &[\n");
    for name in packages.list() {
        let kind = name.kind().as_str();
        let file = folder.join(name.package()).join(kind).join(format!("{}.{kind}", name.name()));
        writeln!(list, "    ({:?}, include_str!({file:?})),", name.as_str())?;
    }
    list.push_str("];\n");
    let out = env::var_os("OUT_DIR").ok_or("cargo sets it")?;
    fs::write(Path::new(&out).join("definitions.rs"), list)?;
    Ok(())
}
