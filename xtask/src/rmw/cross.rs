// SPDX-License-Identifier: MIT OR Apache-2.0
//! rmw_tautline for machines of another architecture, for which PyPI has no ROS 2: with this machine's headers, and libraries that have the
//! names in ROS 2's and nothing else. Where it runs it finds the real ones.

use super::LIBRARY;
use crate::build;
use crate::debian::{self, Architecture};
use crate::steps::{Outcome, cargo, execute, stdout_of};
use crate::{files, packages, r2r, ros};
use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

/// What `rmw/build.rs` links with.
const LINKED: [&str; 4] = ["librmw", "librcutils", "librosidl_runtime_c", "libfastcdr"];

/// A minute from cold, into the folder of the guests' builds.
pub fn build(architecture: Architecture) -> Result<(), String> {
    let triple = architecture.triple();
    let compiler = [format!("g++-{}-linux-gnu", architecture.name().replace('_', "-"))];
    let is_there = || match packages::runs(&architecture.tool("g++"), &["--version"]) {
        true => Ok(()),
        false => Err("a C++ compiler"),
    };
    if let Outcome::Failed(reason) | Outcome::Skipped(reason) =
        packages::prepare(&compiler.each_ref().map(|package| &**package), is_there)
    {
        return Err(reason);
    }
    let prefix = make_prefix(architecture)?;
    let mut command = cargo(&format!("build --release {LIBRARY}"));
    debian::cross(&mut command, architecture)?.envs(r2r::libclang()?);
    command.env("AMENT_PREFIX_PATH", prefix).env("ROS_DISTRO", ros::distribution()).env_remove(r2r::RPATH);
    // Where Debian has the other machine's headers, and its compiler its own.
    let own = stdout_of(Command::new(architecture.tool("gcc")).arg("-print-file-name=include"))?;
    let includes = format!("-I{} -I/usr/{}-linux-gnu/include", own.trim(), architecture.name());
    command.env(format!("BINDGEN_EXTRA_CLANG_ARGS_{}", triple.replace('-', "_")), includes);
    build::build(&mut command)
}

/// What a machine without ROS 2 needs to load the library: a program `load`, which does it, and the libraries beside it, by their names there. It
/// shows that the library is whole, and not what it does in a node.
pub fn loaded(library: &Path, architecture: Architecture) -> Result<Vec<(String, PathBuf)>, String> {
    const LOAD: &str = "
#include <dlfcn.h>
#include <stdio.h>
int main(void) {
    void *library = dlopen(\"librmw_tautline.so\", RTLD_NOW);
    const char *(*name)(void) = library ? (const char *(*)(void))dlsym(library, \"rmw_get_implementation_identifier\") : 0;
    puts(name ? name() : dlerror());
    return !name;
}
";
    let (gcc, prefix) = (architecture.tool("gcc"), make_prefix(architecture)?);
    let (source, load) = (prefix.join("load.c"), prefix.join("load"));
    files::write(&source, LOAD)?;
    execute(Command::new(&gcc).arg("-o").arg(&load).arg(&source).arg("-Wl,-rpath,$ORIGIN"))?;
    let cpp = stdout_of(Command::new(&gcc).arg("-print-file-name=libstdc++.so.6"))?;
    let mut all = vec![
        ("load".to_owned(), load),
        ("librmw_tautline.so".to_owned(), library.to_owned()),
        ("libstdc++.so.6".to_owned(), cpp.trim().into()),
    ];
    let stubs = fs::read_dir(prefix.join("lib")).map_err(|error| error.to_string())?.flatten();
    let stubs = stubs.map(|stub| (stub.file_name().to_string_lossy().into_owned(), stub.path()));
    all.extend(stubs.filter(|(name, _)| !name.ends_with(".s")));
    Ok(all)
}

fn make_prefix(architecture: Architecture) -> Result<PathBuf, String> {
    let (here, prefix) = (r2r::wheels()?, ros::folder().join(format!("prefix-{architecture}")));
    let lib = prefix.join("lib");
    let say = files::at(&prefix);
    files::remove(&prefix).and_then(|()| fs::create_dir_all(&lib)).map_err(say)?;
    symlink(here.join("include"), prefix.join("include")).map_err(say)?;
    for name in LINKED {
        let library = here.join("lib").join(name).with_extension("so");
        let names = stdout_of(
            Command::new("nm").args(["--dynamic", "--defined-only", "--format=posix"]).arg(&library),
        )?;
        let source = lib.join(name).with_extension("s");
        files::write(&source, assembly(&names))?;
        let said = stdout_of(Command::new("objdump").arg("-p").arg(&library))?;
        let soname = said.lines().find_map(|line| line.trim().strip_prefix("SONAME")).unwrap_or_default();
        let soname = soname.trim();
        let mut linker = Command::new(architecture.tool("gcc"));
        linker.args(["-shared", "-nostdlib", &format!("-Wl,-soname,{soname}"), "-o"]).arg(lib.join(soname));
        execute(linker.arg(&source))?;
        let short = lib.join(name).with_extension("so");
        if !short.exists() {
            symlink(soname, short).map_err(say)?;
        }
    }
    Ok(prefix)
}

/// What `nm` lists, as functions that return at once and data of zeros: each line is a name, a kind, a value and perhaps a size.
fn assembly(names: &str) -> String {
    let symbol = |line: &str| {
        let mut words = line.split(' ');
        let (name, kind) = (words.next()?.split('@').next()?, words.next()?);
        let size = words.nth(1).and_then(|size| usize::from_str_radix(size, 16).ok()).unwrap_or(0);
        Some(match kind {
            "T" | "W" | "i" => format!(".text\n.globl {name}\n.type {name},%function\n{name}: ret\n"),
            _ => format!(
                ".data\n.globl {name}\n.type {name},%object\n.size {name},{size}\n{name}: .zero {size}\n"
            ),
        })
    };
    names.lines().filter_map(symbol).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_become_functions_and_data() {
        let text = assembly("rmw_init T 1a0 2b\nrmw_names@@V1 R 10 18\n");
        assert!(text.contains(".type rmw_init,%function\nrmw_init: ret\n"), "{text}");
        assert!(text.contains(".size rmw_names,24\nrmw_names: .zero 24\n"), "{text}");
    }
}
