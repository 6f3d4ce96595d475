// SPDX-License-Identifier: MIT OR Apache-2.0

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::{env, fs};

use tautline_gen::{Options, generate};
use tautline_schema::{Base, Packages};

use crate::folder::Folder;
use crate::{Error, bundled};

/// The file that `include_packages!` includes from `OUT_DIR`.
const FILE: &str = "tautline_packages.rs";

/// Generates all packages of a folder, or the package that the folder is: a [`Builder`] with all other
/// options at their defaults.
///
/// # Errors
/// As [`Builder::generate`].
pub fn packages(folder: impl AsRef<Path>) -> Result<(), Error> {
    Builder::new().folder(folder).generate()
}

/// What to generate, and for which crate.
///
/// ```no_run
/// // build.rs of a crate that uses the messages without the runtime
/// fn main() -> Result<(), tautline_build::Error> {
///     tautline_build::Builder::new()
///         .folder("msgs")
///         .folder("../vendor/arm_msgs") // a package by itself
///         .only(["demo_msgs", "arm_msgs"])
///         .msgs("::tautline_msgs")
///         .bundled("::tautline_ros_msgs")
///         .generate()
/// }
/// ```
#[derive(Clone, Debug)]
#[must_use = "call `generate`"]
pub struct Builder {
    folders: Vec<PathBuf>,
    only: BTreeSet<String>,
    msgs: String,
    bundled: String,
    external: BTreeMap<String, String>,
    file: Option<PathBuf>,
}

impl Default for Builder {
    fn default() -> Self {
        Self::new()
    }
}

impl Builder {
    /// No folder yet; for a crate that depends on `tautline`.
    pub fn new() -> Self {
        Self {
            folders: Vec::new(),
            only: BTreeSet::new(),
            msgs: "::tautline::msgs".to_owned(),
            bundled: "::tautline".to_owned(),
            external: BTreeMap::new(),
            file: None,
        }
    }

    /// Searches this folder too: a package (with `package.xml`, or `msg`, `srv`, `action` in it) or one that holds packages.
    /// Relative to the crate's `Cargo.toml`. Of two folders with the same package the first wins. If the crate lies in the package itself, cargo
    /// does not notice the package's first `msg`, `srv` or `action` folder: `touch build.rs`.
    pub fn folder(mut self, folder: impl AsRef<Path>) -> Self {
        self.folders.push(folder.as_ref().to_owned());
        self
    }

    /// Only these packages, and those that they need; all of the folders if this is not called.
    pub fn only<S: Into<String>>(mut self, packages: impl IntoIterator<Item = S>) -> Self {
        self.only.extend(packages.into_iter().map(Into::into));
        self
    }

    /// Where the generated code finds `tautline-msgs`; `::tautline::msgs` if this is not called.
    pub fn msgs(mut self, path: impl Into<String>) -> Self {
        self.msgs = path.into();
        self
    }

    /// Where the generated code finds the modules of the bundled packages, `std_msgs` and others; `::tautline` if this is
    /// not called. The cargo features of those that are needed must be on.
    pub fn bundled(mut self, path: impl Into<String>) -> Self {
        self.bundled = path.into();
        self
    }

    /// A package that another crate has generated, and the path of its module there: `arm_msgs` at `::arm::arm_msgs`. One of
    /// the folders, or `AMENT_PREFIX_PATH`, must still have its definitions.
    pub fn external(mut self, package: impl Into<String>, path: impl Into<String>) -> Self {
        self.external.insert(package.into(), path.into());
        self
    }

    /// The file to write; `tautline_packages.rs` in `OUT_DIR`, where `include_packages!` finds it, if this is not called.
    pub fn file(mut self, file: impl Into<PathBuf>) -> Self {
        self.file = Some(file.into());
        self
    }

    /// Writes the modules, and tells cargo when to do it again.
    ///
    /// # Errors
    /// [`Error`]: a folder without definitions, a definition that is missing or not valid (with file and line), a file that
    /// cannot be read or written.
    pub fn generate(self) -> Result<(), Error> {
        let base = env::var_os("CARGO_MANIFEST_DIR").map(PathBuf::from).unwrap_or_default();
        println!("cargo::rerun-if-changed=build.rs");
        println!("cargo::rerun-if-env-changed=AMENT_PREFIX_PATH");
        let folders: Vec<_> =
            self.folders.iter().map(|folder| Folder::open(&base.join(folder))).collect::<Result<_, _>>()?;
        let crate_folder = fs::canonicalize(&base).unwrap_or(base);
        for path in folders.iter().flat_map(|folder| folder.watched(&crate_folder)) {
            println!("cargo::rerun-if-changed={}", path.display());
        }

        let mut own = BTreeSet::new();
        for folder in &folders {
            let types = folder.types();
            if types.is_empty() {
                return Err(Error::Empty { folder: folder.path().to_owned() });
            }
            own.extend(types.iter().map(|name| name.package().to_owned()));
        }
        let wanted = self.wanted(&own)?;

        let mut packages = Packages::new();
        folders.iter().for_each(|folder| folder.add_to(&mut packages));
        for folder in Packages::from_env().folders() {
            packages.add_folder(folder);
        }
        let provided: BTreeSet<_> =
            bundled::packages().into_iter().filter(|package| !own.contains(*package)).collect();
        bundled::add(&mut packages, |package| provided.contains(package))?;

        let mut options = Options { msgs: self.msgs.clone(), external: self.external.clone() };
        for package in provided {
            let path = || format!("{}::{package}", self.bundled);
            options.external.entry(package.to_owned()).or_insert_with(path);
        }
        let names = with_needed(&mut packages, wanted, &options)?;
        watch_installed(names.difference(&own));
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let code = generate(&mut packages, &names, &options)?;
        let file = self.output()?;
        fs::write(&file, code).map_err(|source| Error::Io { path: file, source })
    }

    fn wanted(&self, own: &BTreeSet<String>) -> Result<BTreeSet<String>, Error> {
        if let Some(package) = self.only.difference(own).next() {
            let found = own.iter().cloned().collect::<Vec<_>>().join(", ");
            return Err(Error::Missing { package: package.clone(), found });
        }
        let all = if self.only.is_empty() { own } else { &self.only };
        Ok(all.iter().filter(|package| !self.external.contains_key(*package)).cloned().collect())
    }

    fn output(&self) -> Result<PathBuf, Error> {
        if let Some(file) = &self.file {
            return Ok(file.clone());
        }
        let folder = env::var_os("OUT_DIR").ok_or(Error::NotCargo { variable: "OUT_DIR" })?;
        Ok(Path::new(&folder).join(FILE))
    }
}

/// Tells cargo where these packages lie in an installed ROS 2.
fn watch_installed<'a>(names: impl Iterator<Item = &'a String>) {
    let installed = Packages::from_env();
    for name in names {
        let folders = installed.folders().iter().map(|folder| folder.join("share").join(name));
        for folder in folders.filter(|folder| folder.exists()) {
            println!("cargo::rerun-if-changed={}", folder.display());
        }
    }
}

/// These packages and all whose types they need, without the external ones.
fn with_needed(
    packages: &mut Packages,
    wanted: BTreeSet<String>,
    options: &Options,
) -> Result<BTreeSet<String>, Error> {
    let all = packages.list();
    let mut needed = BTreeSet::new();
    let mut todo: Vec<_> = wanted.into_iter().collect();
    while let Some(package) = todo.pop() {
        if options.external.contains_key(&package) || !needed.insert(package.clone()) {
            continue;
        }
        for name in all.iter().filter(|name| name.package() == package) {
            let schema = packages.schema(name)?;
            let parts = schema.referenced().chain([schema.definition()]);
            let fields = parts.filter(|part| part.name.package() == package).flat_map(|part| &part.fields);
            todo.extend(fields.filter_map(|field| match &field.ty.base {
                Base::Nested(name) => Some(name.package().to_owned()),
                _ => None,
            }));
        }
    }
    Ok(needed)
}
