// SPDX-License-Identifier: MIT OR Apache-2.0
//! What it takes to build a program of r2r's: a ROS 2 to link with and libclang.

use crate::ros::Distribution;
use crate::steps::{self, Outcome, Steps};
use crate::{files, machine, ros};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs, io};

/// From PyPI, where the system has none.
const LIBCLANG: &str = "libclang==18.1.1";

/// What the bridge's build script makes the rpath of.
pub const RPATH: &str = "TAUT_ROS_RPATH";

/// What programs need to be built and to run.
pub type Environment = Vec<(&'static str, String)>;

/// The distribution that is sourced, if builds use it: where another one than the default was chosen they do not.
pub fn sourced() -> Option<String> {
    let sourced = env::var("ROS_DISTRO").ok().filter(|_| env::var_os("AMENT_PREFIX_PATH").is_some());
    sourced.filter(|_| ros::chosen() == Distribution::default())
}

/// Variables that a build needs beside those that are set: none where a ROS 2 is sourced, no other is chosen, and the system has libclang.
pub fn environment() -> Result<Environment, String> {
    let mut variables = Vec::new();
    if sourced().is_none() {
        let prefix = wheels()?;
        let text = |path: &Path| path.display().to_string();
        variables.extend([("AMENT_PREFIX_PATH", text(&prefix)), ("ROS_DISTRO", ros::distribution())]);
        variables.push((RPATH, text(&prefix.join("lib"))));
    }
    variables.extend(libclang()?);
    Ok(variables)
}

/// They, for the steps of this name. Without a ROS 2 these are left out, which is said; but not in CI.
pub fn environment_of(steps: &mut Steps, name: &str) -> Option<Environment> {
    let mut found = None;
    steps.step(&format!("{name}: ROS 2"), || {
        Outcome::from(environment().map(|variables| found = Some(variables))).unless_ci()
    });
    if found.is_none() {
        steps.skip(name, "there is no ROS 2 to build it with: source one, or run `cargo xtask ros`");
    }
    found
}

/// Those of them by which bindgen finds libclang.
pub fn libclang() -> Result<Environment, String> {
    match env::var_os("LIBCLANG_PATH").is_none() && !system_has_libclang() {
        true => Ok(pypi_libclang()?.into_iter().collect()),
        false => Ok(Vec::new()),
    }
}

/// Has all builds use one libclang, which bridge and RMW need; what looks for one is otherwise built anew for these, with all that needs it. Of
/// PyPI's, that which is there or, with `fetch`, a new one.
pub fn prepare_libclang(steps: &mut Steps, fetch: bool) {
    if !fetch && native().is_none() {
        return;
    }
    steps.step("libclang", || Outcome::from(libclang().map(steps::build_with)).unless_ci());
}

/// The ROS 2 that the user has sourced, else the one under the target directory, which is made first: `include` and `lib`.
pub fn prefix() -> Result<PathBuf, String> {
    let sourced = env::var_os("AMENT_PREFIX_PATH").unwrap_or_default();
    match env::split_paths(&sourced).find(|prefix| prefix.join("lib/libfastrtps.so").exists()) {
        Some(prefix) => Ok(prefix),
        None => wheels(),
    }
}

/// The wheels' files in the layout of an installed ROS 2.
pub fn wheels() -> Result<PathBuf, String> {
    ros::prepare()?;
    let prefix = ros::folder().join("prefix");
    make_prefix(&ros::venv(), &prefix).map_err(files::at(&prefix))?;
    Ok(prefix)
}

/// Makes the environment and says how to use it.
pub fn run() -> Result<(), String> {
    ros::prepare()?;
    let setup = setup_file()?;
    println!(
        "ROS 2 {} is in {}. To build and run the bridge with it:",
        ros::distribution(),
        ros::venv().display()
    );
    println!("  source {}", setup.display());
    println!(
        "  cargo build --release --manifest-path bridge-ros/Cargo.toml --target-dir {}",
        machine::target_dir().display()
    );
    Ok(())
}

/// A file for a shell to source, with [`environment`] and the venv's Python.
pub fn setup_file() -> Result<PathBuf, String> {
    let mut text = String::from("# Made by `cargo xtask ros`: to be sourced.\n");
    for (name, value) in environment()? {
        text += &format!("export {name}='{value}'\n");
    }
    text += &format!(". '{}'\n", ros::venv().join("bin/activate").display());
    let path = ros::folder().join("setup.sh");
    files::write(&path, text)?;
    Ok(path)
}

/// Links the wheels' files into the layout of an installed ROS 2 and adds the libraries that the wheels lack.
fn make_prefix(venv: &Path, prefix: &Path) -> io::Result<()> {
    let lib = prefix.join("lib");
    // Written last: what was interrupted is made anew.
    let dispatcher = lib.join("librmw_implementation.so");
    if dispatcher.exists() {
        return Ok(());
    }
    files::remove(prefix)?;
    fs::create_dir_all(&lib)?;
    for name in ["include", "share"] {
        symlink(venv.join(name), prefix.join(name))?;
    }
    let bundled = entries(&site_packages(venv)?)?
        .into_iter()
        .filter(|(name, _)| name.starts_with("ros_") && name.ends_with(".libs"));
    for folder in std::iter::once(venv.join("lib")).chain(bundled.map(|(_, path)| path)) {
        for (name, path) in entries(&folder)?.into_iter().filter(|(name, _)| name.contains(".so")) {
            let link = lib.join(&name);
            if name.ends_with("__rosidl_generator_py.so") {
                // librcl needs them by name only; the real ones need a Python around them.
                make_empty_library(&name, &link)?;
            } else if !link.exists() {
                symlink(path, link)?;
            }
        }
    }
    fs::write(dispatcher, "INPUT(-lrmw_fastrtps_cpp)\n")
}

fn entries(folder: &Path) -> io::Result<Vec<(String, PathBuf)>> {
    let named = |entry: fs::DirEntry| (entry.file_name().to_string_lossy().into_owned(), entry.path());
    fs::read_dir(folder)?.map(|entry| entry.map(named)).collect()
}

/// That of the environment's Python, of whatever version.
fn site_packages(venv: &Path) -> io::Result<PathBuf> {
    let python = entries(&venv.join("lib"))?.into_iter().find(|(name, _)| name.starts_with("python3."));
    let (_, folder) = python.ok_or_else(|| io::Error::other(format!("{}: no Python", venv.display())))?;
    Ok(folder.join("site-packages"))
}

fn make_empty_library(name: &str, path: &Path) -> io::Result<()> {
    let mut gcc = Command::new("gcc");
    gcc.args(["-shared", "-nostdlib", &format!("-Wl,-soname,{name}"), "-o"]).arg(path);
    let status = gcc.args(["-x", "c", "/dev/null"]).status()?;
    if status.success() { Ok(()) } else { Err(io::Error::other(format!("gcc for {name}: {status}"))) }
}

/// Where Debian and its kin install it.
fn system_has_libclang() -> bool {
    let has =
        |folder: &Path| entries(folder).is_ok_and(|files| files.iter().any(|(name, _)| is_libclang(name)));
    let llvm = entries(Path::new("/usr/lib")).unwrap_or_default();
    llvm.iter().any(|(name, path)| name.starts_with("llvm-") && has(&path.join("lib")))
}

/// `libclang-cpp`, which comes with LLVM alone, is another library.
fn is_libclang(name: &str) -> bool {
    (name.starts_with("libclang.so") || name.starts_with("libclang-")) && !name.starts_with("libclang-cpp")
}

/// PyPI's libclang, in an environment of its own: most builds need no more of ROS's.
fn venv_of_libclang() -> PathBuf {
    machine::target_dir().join("libclang")
}

/// PyPI's libclang, once it is there.
fn native() -> Option<PathBuf> {
    let pythons = entries(&venv_of_libclang().join("lib")).ok()?;
    let native = |(_, python): (String, PathBuf)| python.join("site-packages/clang/native");
    pythons.into_iter().map(native).find(|native| native.exists())
}

fn pypi_libclang() -> Result<[(&'static str, String); 2], String> {
    let venv = venv_of_libclang();
    ros::make_venv(&venv, &[LIBCLANG], || Ok("python3".to_owned()))?;
    let native = native().ok_or_else(|| format!("{}: {LIBCLANG} has no clang/native", venv.display()))?;
    // It comes without the compiler's own headers.
    let include = steps::stdout_of(Command::new("gcc").arg("-print-file-name=include"))?;
    let native = native.display().to_string();
    Ok([("LIBCLANG_PATH", native), ("BINDGEN_EXTRA_CLANG_ARGS", format!("-I{}", include.trim()))])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn llvms_cpp_library_is_no_libclang() {
        let found =
            ["libclang.so", "libclang-14.so.1", "libclang-cpp.so.14", "libLLVM-14.so"].map(is_libclang);
        assert_eq!(found, [true, true, false, false]);
    }

    #[test]
    fn a_prefix_has_every_library_and_stubs_for_those_that_need_python() {
        let folder = env::temp_dir().join(format!("taut_prefix_{}", std::process::id()));
        let (venv, prefix) = (folder.join("venv"), folder.join("prefix"));
        let bundled = venv.join("lib/python3.11/site-packages/ros_rcl.libs");
        fs::create_dir_all(&bundled).unwrap();
        for path in ["librcl.so", "liba__rosidl_generator_py.so", "notes.txt"] {
            fs::write(venv.join("lib").join(path), "wheel").unwrap();
        }
        fs::write(bundled.join("libssl-1.so.1"), "bundled").unwrap();
        make_prefix(&venv, &prefix).unwrap();
        let read = |name: &str| fs::read(prefix.join("lib").join(name));
        assert_eq!(read("librcl.so").unwrap(), b"wheel");
        assert_eq!(read("libssl-1.so.1").unwrap(), b"bundled");
        assert_eq!(&read("liba__rosidl_generator_py.so").unwrap()[1..4], b"ELF");
        assert_eq!(read("librmw_implementation.so").unwrap(), b"INPUT(-lrmw_fastrtps_cpp)\n");
        assert!(read("notes.txt").is_err());
        fs::remove_dir_all(folder).unwrap();
    }
}
