// SPDX-License-Identifier: MIT OR Apache-2.0
//! The published crates: packed as for crates.io, and used by a program that has nothing else of this repository.

use crate::build::Build;
use crate::machine;
use crate::steps::{cargo, execute};
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::Command;

/// What a user begins with, in a workspace with all that is published.
const PROGRAM: &str = r#"
use tautline::{Context, Node, Qos, geometry_msgs::msg::Twist};

fn main() -> tautline::Result<()> {
    let mut node = Node::create(Context::create()?, "drive", "")?;
    let publisher = node.create_publisher::<Twist>("/cmd_vel", Qos::default())?;
    publisher.publish(&Twist::default())?;
    Ok(())
}
"#;

/// Packs them into `crates` of this folder, and checks that they are enough for a program. Of a release each is checked, the gateway with Zenoh in
/// minutes; in CI what that program needs.
pub fn make(out: &Path, of: Build) -> Result<(), String> {
    let (target, to) = (machine::target_dir(), out.join("crates"));
    let names = published()?;
    let mut package = cargo("package --locked --offline --no-verify --quiet");
    package.args(names.iter().flat_map(|name| ["-p", name]));
    // What is published is what is committed.
    package.args((of == Build::Tests).then_some("--allow-dirty")).arg("--target-dir").arg(&target);
    execute(&mut package)?;
    let say = |error: std::io::Error| format!("{}: {error}", to.display());
    let (work, version) = (out.join("work/crates"), super::VERSION);
    for folder in [&to, &work] {
        let _ = fs::remove_dir_all(folder);
        fs::create_dir_all(folder).map_err(say)?;
    }
    let mut manifest = String::from(
        "[workspace]\nmembers = [\"program\", \"tautline*\", \"taut-*\"]\nresolver = \"3\"\n[patch.crates-io]\n",
    );
    for name in &names {
        let file = format!("{name}-{version}.crate");
        fs::copy(target.join("package").join(&file), to.join(&file)).map_err(say)?;
        manifest += &format!("{name} = {{ path = \"{name}-{version}\" }}\n");
    }
    let unpack = "for crate in \"$0\"/*.crate; do tar -xzf \"$crate\" -C \"$1\"; done";
    execute(Command::new("sh").args(["-euc", unpack]).arg(&to).arg(&work))?;
    let root = machine::root();
    // Of other packages it has the versions and, where much is built, the features that the repository's builds have.
    let program = format!(
        "[package]\nname = \"program\"\nedition = \"2024\"\n[dependencies]\ntautline = \"{version}\"\n\
         xtask-host-features = {{ path = \"{}\" }}\n",
        root.join("xtask/host-features").display()
    );
    let written = fs::write(work.join("Cargo.toml"), manifest)
        .and_then(|()| fs::create_dir_all(work.join("program/src")))
        .and_then(|()| fs::write(work.join("program/Cargo.toml"), program))
        .and_then(|()| fs::write(work.join("program/src/main.rs"), PROGRAM))
        .and_then(|()| fs::copy(root.join("Cargo.lock"), work.join("Cargo.lock")));
    written.map_err(say)?;
    let packages = if of == Build::Tests { "--package program" } else { "--workspace" };
    let mut check = cargo(&format!("check --offline {packages}"));
    execute(check.arg("--manifest-path").arg(work.join("Cargo.toml")).arg("--target-dir").arg(target))
}

/// Names of the packages that are not kept from it. Each has what crates.io and docs.rs show.
fn published() -> Result<Vec<String>, String> {
    let output =
        cargo("metadata --format-version 1 --no-deps --locked").current_dir(machine::root()).output();
    let output = output.map_err(|error| format!("cargo: {error}"))?;
    let metadata: Value = serde_json::from_slice(&output.stdout).map_err(|error| error.to_string())?;
    let packages = metadata["packages"].as_array().ok_or("cargo's metadata has no packages")?;
    let mut names = Vec::new();
    for package in packages.iter().filter(|package| package["publish"].is_null()) {
        let name = package["name"].as_str().unwrap_or_default();
        for field in ["description", "license", "repository", "readme", "keywords", "categories"] {
            if package[field].is_null() || package[field].as_array().is_some_and(Vec::is_empty) {
                return Err(format!(
                    "{name} is published without `{field}`: add it, or `publish = false`, to its Cargo.toml"
                ));
            }
        }
        let folder = Path::new(package["manifest_path"].as_str().unwrap_or_default()).with_file_name("");
        if let Some(licence) =
            ["LICENSE-MIT", "LICENSE-APACHE"].iter().find(|file| !folder.join(file).is_file())
        {
            return Err(format!(
                "{name} is published without its licence: link {licence} into {}",
                folder.display()
            ));
        }
        names.push(name.to_owned());
    }
    Ok(names)
}
