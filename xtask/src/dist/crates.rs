// SPDX-License-Identifier: MIT OR Apache-2.0
//! The published crates: packed as for crates.io, and used by a program that has nothing else of this repository.

use crate::build::Build;
use crate::machine;
use crate::steps::{cargo, execute};
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

/// What a user begins with.
const PROGRAM: &str = r#"
use tautline::{Context, Node, Qos, geometry_msgs::msg::Twist};

fn main() -> tautline::Result<()> {
    let mut node = Node::create(Context::create()?, "drive", "")?;
    let publisher = node.create_publisher::<Twist>("/cmd_vel", Qos::default())?;
    publisher.publish(&Twist::default())?;
    Ok(())
}
"#;

/// Packs them into `crates` of this folder, and checks that they are enough. Of a release from a copy of the registry that has them, and nothing of this
/// repository: that program is built and the others are installed, in minutes. In CI that program is checked, with what is built already.
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
    for name in &names {
        let file = format!("{name}-{version}.crate");
        fs::copy(target.join("package").join(&file), to.join(&file)).map_err(say)?;
    }
    let unpack = |into: &Path| {
        let unpack = "for crate in \"$0\"/*.crate; do tar -xzf \"$crate\" -C \"$1\"; done";
        execute(Command::new("sh").args(["-euc", unpack]).arg(&to).arg(into))
    };
    let begin = |manifest: &str, dependency: &str| {
        let program = format!(
            "[package]\nname = \"program\"\nedition = \"2024\"\n[dependencies]\ntautline = \"{version}\"\n{dependency}"
        );
        fs::write(
            work.join("Cargo.toml"),
            format!("[workspace]\nmembers = [\"program\"]\nresolver = \"3\"\n{manifest}"),
        )
        .and_then(|()| fs::create_dir_all(work.join("program/src")))
        .and_then(|()| fs::write(work.join("program/Cargo.toml"), program))
        .and_then(|()| fs::write(work.join("program/src/main.rs"), PROGRAM))
        .map_err(say)
    };
    let root = machine::root();
    if of == Build::Release {
        let registry = work.join("registry");
        let mut copy = cargo("vendor --quiet --locked --versioned-dirs");
        execute(copy.arg(&registry).current_dir(&root).stdout(Stdio::null()))?;
        unpack(&registry)?;
        for name in &names {
            let file = registry.join(format!("{name}-{version}/.cargo-checksum.json"));
            fs::write(file, "{\"files\":{}}").map_err(say)?;
        }
        begin("", "")?;
        let from = format!(
            "[source.crates-io]\nreplace-with = \"packed\"\n[source.packed]\ndirectory = {registry:?}\n"
        );
        let source = work.join("registry.toml");
        fs::write(&source, from).map_err(say)?;
        execute(
            cargo("build --offline --package program --target-dir target --config")
                .arg(&source)
                .current_dir(&work),
        )?;
        let mut install =
            cargo("install --debug --offline --no-track --root installed --target-dir target --version");
        install.arg(version).arg("--config").arg(&source);
        execute(install.args(super::PACKAGES).current_dir(&work))?;
        return fs::remove_dir_all(&work).map_err(say);
    }
    unpack(&work)?;
    let patch = |name: &String| format!("{name} = {{ path = \"{name}-{version}\" }}\n");
    // Of other packages it has the versions and, where much is built, the features that the repository's builds have.
    let features = root.join("xtask/host-features");
    begin(
        &format!("[patch.crates-io]\n{}", names.iter().map(patch).collect::<String>()),
        &format!("xtask-host-features = {{ path = {features:?} }}\n"),
    )?;
    fs::copy(root.join("Cargo.lock"), work.join("Cargo.lock")).map_err(say)?;
    let mut check = cargo("check --offline --package program");
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
