// SPDX-License-Identifier: MIT OR Apache-2.0
//! The folders with a project's packages.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::{fs, io};

use tautline_schema::{Packages, TypeName};

use crate::Error;

const KINDS: [&str; 3] = ["action", "msg", "srv"];

/// A folder that is a package or holds packages.
pub struct Folder {
    path: PathBuf,
    /// The name of the package, if it is one.
    package: Option<String>,
}

impl Folder {
    /// Opens a folder, and finds out whether it is a package.
    pub fn open(path: &Path) -> Result<Self, Error> {
        let path = fs::canonicalize(path).map_err(|source| Error::Io { path: path.to_owned(), source })?;
        let manifest = path.join("package.xml");
        let package = match fs::read_to_string(&manifest) {
            Ok(text) => Some(name_in(&text).ok_or(Error::Manifest { path: manifest })?),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                let is_package = KINDS.iter().any(|kind| path.join(kind).is_dir());
                let name = path.file_name().map(|name| name.to_string_lossy().into_owned());
                name.filter(|_| is_package)
            }
            Err(source) => return Err(Error::Io { path: manifest, source }),
        };
        Ok(Self { path, package })
    }

    pub fn add_to(&self, packages: &mut Packages) {
        match &self.package {
            Some(package) => packages.add_package(package, &self.path),
            None => packages.add_folder(&self.path),
        }
    }

    /// The types that it has definitions of.
    pub fn types(&self) -> BTreeSet<TypeName> {
        let mut packages = Packages::new();
        self.add_to(&mut packages);
        packages.list()
    }

    /// The paths that cargo has to watch. Cargo watches everything in a folder, so only the relevant parts of a package are
    /// named if the crate lies in it: its folder then contains the build output.
    pub fn watched(&self, crate_folder: &Path) -> Vec<PathBuf> {
        if self.package.is_none() || !crate_folder.starts_with(&self.path) {
            return vec![self.path.clone()];
        }
        let parts = KINDS.into_iter().chain(["package.xml"]).map(|part| self.path.join(part));
        parts.filter(|path| path.exists()).collect()
    }

    pub fn path(&self) -> &Path {
        &self.path
    }
}

/// The content of the first `<name>` that is a package's name.
fn name_in(manifest: &str) -> Option<String> {
    let (_, rest) = manifest.split_once("<name>")?;
    let (name, _) = rest.split_once("</name>")?;
    let name = name.trim();
    format!("{name}/msg/A").parse::<TypeName>().ok().map(|_| name.to_owned())
}
