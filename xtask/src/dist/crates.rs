// SPDX-License-Identifier: MIT OR Apache-2.0
//! The published crates: packed as for crates.io, and used by a program that has nothing else of this repository.

use crate::build::Build;
use crate::files::{self, write};
use crate::machine;
use crate::steps::{cargo, execute, json_of};
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// The packages of the programs.
pub const PACKAGES: [&str; 5] = ["taut", "taut-bag", "taut-top", "taut-filter", "tautline-gateway"];

/// What a user begins with, with types of its own, and something of each of the other libraries.
const PROGRAM: &str = r#"
use demo_msgs::msg::Speed;
use tautline::{Context, Node, Qos, geometry_msgs::msg::Twist};

tautline::msgs::include_packages!();

fn main() -> tautline::Result<()> {
    let context = Context::create()?;
    let mut node = Node::create(context.clone(), "drive", "")?;
    let speeds = node.create_publisher::<Speed>("/speed", tautline_r2r::QosProfile::default().into())?;
    speeds.publish(&Speed { value: 0.5 })?;
    let _container = tautline_components::Container::new(context);
    let publisher = node.create_publisher::<Twist>("/cmd_vel", Qos::default())?;
    publisher.publish(&Twist::default())?;
    Ok(())
}
"#;

/// Generates its types, with `tautline-gen`.
const BUILD: &str = r#"
fn main() -> Result<(), tautline_build::Error> {
    tautline_build::packages("msgs")
}
"#;

/// Packs them into `crates` of this folder, and checks that they are enough.
pub fn make(out: &Path, of: Build) -> Result<(), String> {
    let (target, to) = (machine::target_dir(), out.join("crates"));
    let names = published()?;
    let mut package = cargo("package --locked --offline --no-verify --quiet");
    package.args(names.iter().flat_map(|name| ["-p", name]));
    // What is published is what is committed.
    package.args((of == Build::Tests).then_some("--allow-dirty")).arg("--target-dir").arg(&target);
    execute(&mut package)?;
    let work = out.join("work/crates");
    for folder in [&to, &work] {
        files::make_empty(folder).map_err(files::at(folder))?;
    }
    for name in &names {
        let file = format!("{name}-{VERSION}.crate");
        let from = target.join("package").join(&file);
        fs::copy(&from, to.join(&file)).map_err(files::at(&from))?;
    }
    match of {
        Build::Release => use_registry(&names, &to, &work),
        Build::Tests => use_patch(&names, &to, &work),
    }
}

/// Builds the program and installs the others, in minutes, from a copy of the registry that has these crates, and nothing of this repository.
fn use_registry(names: &[String], crates: &Path, work: &Path) -> Result<(), String> {
    let (registry, source) = (work.join("registry"), work.join("registry.toml"));
    let mut copy = cargo("vendor --quiet --locked --versioned-dirs");
    execute(copy.arg(&registry).current_dir(machine::root()).stdout(Stdio::null()))?;
    unpack(crates, &registry)?;
    for name in names {
        write(&registry.join(format!("{name}-{VERSION}/.cargo-checksum.json")), "{\"files\":{}}")?;
    }
    let from = "[source.crates-io]\nreplace-with = \"packed\"\n[source.packed]\ndirectory";
    write(&source, format!("{from} = {registry:?}\n"))?;
    write_program(work, "", "")?;
    let from_registry = |command: &str| {
        let mut command = cargo(&format!("{command} --offline --target-dir target --config"));
        command.arg(&source).current_dir(work);
        command
    };
    execute(&mut from_registry("build --package program"))?;
    let mut install = from_registry("install --debug --no-track --root installed");
    execute(install.args(["--version", VERSION]).args(PACKAGES))?;
    fs::remove_dir_all(work).map_err(files::at(work))
}

/// Checks the program with what is built already: other packages have the versions and, where much is built, the features that the repository's builds
/// have.
fn use_patch(names: &[String], crates: &Path, work: &Path) -> Result<(), String> {
    unpack(crates, work)?;
    let patch = |name: &String| format!("{name} = {{ path = \"{name}-{VERSION}\" }}\n");
    let root = machine::root();
    write_program(
        work,
        &format!("[patch.crates-io]\n{}", names.iter().map(patch).collect::<String>()),
        &format!("xtask-host-features = {{ path = {:?} }}\n", root.join("xtask/host-features")),
    )?;
    fs::copy(root.join("Cargo.lock"), work.join("Cargo.lock")).map_err(files::at(work))?;
    let mut check = cargo("check --offline --package program --target-dir");
    execute(check.arg(machine::target_dir()).current_dir(work))
}

fn unpack(crates: &Path, to: &Path) -> Result<(), String> {
    let unpack = "for crate in \"$0\"/*.crate; do tar -xzf \"$crate\" -C \"$1\"; done";
    execute(Command::new("sh").args(["-euc", unpack]).arg(crates).arg(to))
}

/// [`PROGRAM`] in a workspace, whose manifest ends so, with one more dependency.
fn write_program(work: &Path, end: &str, dependency: &str) -> Result<(), String> {
    let manifest = format!(
        r#"[package]
name = "program"
edition = "2024"

[build-dependencies]
tautline-build = "{VERSION}"

[dependencies]
tautline = "{VERSION}"
tautline-components = "{VERSION}"
tautline-r2r = "{VERSION}"
{dependency}"#
    );
    write(
        &work.join("Cargo.toml"),
        format!("[workspace]\nmembers = [\"program\"]\nresolver = \"3\"\n{end}"),
    )?;
    write(&work.join("program/Cargo.toml"), &manifest)?;
    write(&work.join("program/msgs/demo_msgs/msg/Speed.msg"), "float64 value\n")?;
    write(&work.join("program/build.rs"), BUILD)?;
    write(&work.join("program/src/main.rs"), PROGRAM)
}

/// Names of the packages that are not kept from it. Each has what crates.io and docs.rs show.
fn published() -> Result<Vec<String>, String> {
    let mut metadata = cargo("metadata --format-version 1 --no-deps --locked");
    let metadata = json_of(metadata.current_dir(machine::root()))?;
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
