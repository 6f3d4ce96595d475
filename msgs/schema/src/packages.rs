// SPDX-License-Identifier: MIT OR Apache-2.0
//! Finds definitions on disk: in ROS 2 installations, in workspaces, in any folder of packages.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::{env, fs, io};

use crate::{Definition, Kind, Schema, SchemaError, TypeName, derived, parse, well_known};

/// Folders with packages, and the definitions read from them so far.
///
/// A folder is searched as a prefix (`<folder>/share/<package>/msg/Name.msg`), as a folder of packages
/// (`<folder>/<package>/msg/Name.msg`) and as a package (`<folder>/msg/Name.msg`, the package named as the folder).
/// The first folder that has a type wins. Files are read when their types are requested.
#[derive(Debug, Default)]
pub struct Packages {
    folders: Vec<PathBuf>,
    /// Packages whose folders may be named otherwise.
    named: Vec<(String, PathBuf)>,
    known: BTreeMap<TypeName, Arc<Definition>>,
}

impl Packages {
    /// Without folders: only the messages that the derived types of services and actions consist of are
    /// known.
    pub fn new() -> Self {
        Self::default()
    }

    /// The prefixes of a sourced ROS 2 installation: those in `AMENT_PREFIX_PATH`.
    pub fn from_env() -> Self {
        let paths = env::var_os("AMENT_PREFIX_PATH").unwrap_or_default();
        let folders = env::split_paths(&paths).filter(|path| !path.as_os_str().is_empty()).collect();
        Self { folders, ..Self::default() }
    }

    /// Searches this folder too, after those that are there.
    pub fn add_folder(&mut self, folder: impl Into<PathBuf>) {
        self.folders.push(folder.into());
    }

    /// Searches this folder for this package, before all others: `<folder>/msg/Name.msg`.
    pub fn add_package(&mut self, package: impl Into<String>, folder: impl Into<PathBuf>) {
        self.named.push((package.into(), folder.into()));
    }

    /// The folders, in the order in which they are searched.
    pub fn folders(&self) -> &[PathBuf] {
        &self.folders
    }

    /// Adds a definition and all that is derived from it, as if a folder had it. `file` is what errors call it.
    ///
    /// # Errors
    /// [`SchemaError`] if the text is not valid.
    pub fn add_text(&mut self, name: &TypeName, file: &str, text: &str) -> Result<(), SchemaError> {
        for definition in parse::parse(name, file, text)? {
            self.known.insert(definition.name.clone(), Arc::new(definition));
        }
        Ok(())
    }

    /// A type with all types it consists of. A service or action is a type as well; so are those derived from it, such
    /// as `std_srvs/srv/SetBool_Request`.
    ///
    /// # Errors
    /// [`SchemaError`] if a definition is missing or not valid, or a file cannot be read.
    pub fn schema(&mut self, name: &TypeName) -> Result<Schema, SchemaError> {
        Schema::resolve(name, &mut |name| self.definition(name))
            .map_err(|error| error.searched(&self.searched()))
    }

    /// The definition of a type; `None` if no folder has it.
    ///
    /// # Errors
    /// [`SchemaError`] if the definition is not valid or its file cannot be read.
    pub fn definition(&mut self, name: &TypeName) -> Result<Option<Arc<Definition>>, SchemaError> {
        if !self.known.contains_key(name) {
            for origin in derived::origins(name) {
                // Types are derived only from services and actions.
                if origin.kind() != Kind::Msg || origin == *name {
                    self.load(&origin)?;
                }
                if self.known.contains_key(name) {
                    break;
                }
            }
        }
        match self.known.get(name) {
            Some(definition) => Ok(Some(definition.clone())),
            None => Ok(well_known::definition(name)?.map(Arc::new)),
        }
    }

    /// The messages, services and actions that the folders have, without those that are derived. Only looks at names.
    pub fn list(&self) -> BTreeSet<TypeName> {
        let mut names = BTreeSet::new();
        for (package, folder) in &self.named {
            for kind in [Kind::Action, Kind::Msg, Kind::Srv] {
                names.extend(types_in(folder, package, kind));
            }
        }
        for folder in &self.folders {
            let inside = folders_in(&folder.join("share")).into_iter().chain(folders_in(folder));
            for package in inside.chain([folder.clone()]) {
                let Some(name) = package.file_name().and_then(|name| name.to_str()) else { continue };
                for kind in [Kind::Action, Kind::Msg, Kind::Srv] {
                    names.extend(types_in(&package, name, kind));
                }
            }
        }
        names
    }

    /// Reads the file of a type, if there is one.
    fn load(&mut self, name: &TypeName) -> Result<(), SchemaError> {
        let kind = name.kind().as_str();
        let file = Path::new(kind).join(format!("{}.{kind}", name.name()));
        let package = name.package();
        let paths = self.folders.iter().flat_map(|folder| {
            let itself = folder.file_name().is_some_and(|last| last == package).then(|| folder.clone());
            [folder.join("share").join(package), folder.join(package)].into_iter().chain(itself)
        });
        let named = self.named.iter().filter(|(named, _)| named == package).map(|(_, folder)| folder.clone());
        for path in named.chain(paths).map(|package| package.join(&file)).collect::<Vec<_>>() {
            match fs::read_to_string(&path) {
                Ok(text) => return self.add_text(name, &path.to_string_lossy(), &text),
                Err(error)
                    if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {}
                Err(source) => return Err(SchemaError::Io { path, source }),
            }
        }
        Ok(())
    }

    /// The folders, for error messages.
    fn searched(&self) -> String {
        let folders: Vec<_> = self.named.iter().map(|(_, folder)| folder).chain(&self.folders).collect();
        match &folders[..] {
            [] => "any folder, since none is searched".to_owned(),
            folders => {
                folders.iter().map(|folder| folder.display().to_string()).collect::<Vec<_>>().join(", ")
            }
        }
    }
}

fn folders_in(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).filter(|path| path.is_dir()).collect()
}

/// The types that a package's folder of this kind has files of.
fn types_in(folder: &Path, package: &str, kind: Kind) -> Vec<TypeName> {
    let entries = fs::read_dir(folder.join(kind.as_str())).into_iter().flatten().flatten();
    let files = entries.map(|entry| entry.path());
    let files = files.filter(|path| path.extension().is_some_and(|extension| extension == kind.as_str()));
    files.filter_map(|path| TypeName::new(package, kind, path.file_stem()?.to_str()?).ok()).collect()
}
