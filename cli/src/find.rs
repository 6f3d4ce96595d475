// SPDX-License-Identifier: MIT OR Apache-2.0
//! Finds the schema of a type that the user named.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::{env, fs, io};
use tautline::TransportError;
use tautline_definitions::{Bundled, DefinitionError, find_schema};
use tautline_schema::{HashedTypeDescription, Kind, Packages, Schema, SchemaError, TypeName};
use tautline_transport::graph_of;

/// Why a type was not found.
#[derive(Debug, thiserror::Error)]
pub enum FindError {
    #[error("{0}")]
    Schema(#[from] SchemaError),
    #[error("{0}")]
    Known(DefinitionError),
    #[error("{} cannot be read: {source}", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("`{}` is not a file with a type: give a .msg, .srv or .action file, or a .json of a ROS package", path.display())]
    File { path: PathBuf },
}

impl FindError {
    /// Whether no definition of this type was found.
    pub fn is_missing(&self, type_name: &str) -> bool {
        matches!(self, FindError::Schema(SchemaError::Missing { name, .. }) if name == type_name)
    }
}

/// The folders that are searched.
pub struct Finder {
    packages: Packages,
    bundled: Bundled,
    /// The domain whose cached types are searched, too.
    domain: Option<u32>,
}

impl Finder {
    /// The user's folders first, then a sourced ROS 2, then the one under `target/`.
    pub fn new(folders: &[PathBuf]) -> Self {
        let mut packages = Packages::new();
        let env = Packages::from_env();
        let target = env::current_exe().ok().and_then(|path| Some(path.ancestors().nth(2)?.to_owned()));
        let targets =
            target.into_iter().chain([PathBuf::from("target")]).map(|target| target.join("ros/venv"));
        let found = targets.filter(|folder| folder.is_dir());
        folders
            .iter()
            .chain(env.folders())
            .cloned()
            .chain(found)
            .for_each(|folder| packages.add_folder(folder));
        Self { packages, bundled: Bundled::default(), domain: None }
    }

    /// Also searches the types of this domain.
    pub fn in_domain(self, domain: u32) -> Self {
        Self { domain: Some(domain), ..self }
    }

    /// All known types: of the folders, of this program, and of the domain.
    ///
    /// # Errors
    /// The domain cannot be read.
    pub fn list(&self) -> Result<BTreeSet<TypeName>, TransportError> {
        let mut types = self.packages.list();
        types.extend(Bundled::names().filter_map(|name| name.parse().ok()));
        if let Some(domain) = self.domain {
            let graph = graph_of(domain)?;
            let topics = graph.endpoints.iter().map(|end| &*end.topic_type.name);
            let services = graph.services.iter().map(|end| &*end.type_name);
            types.extend(topics.chain(services).filter_map(|name| name.parse::<TypeName>().ok()));
            // Types that are derived from services and actions have no definition of their own.
            types.retain(|name| !(name.name().contains('_') && name.kind() != Kind::Msg));
        }
        Ok(types)
    }

    /// The schema of a type or of a file.
    pub fn schema(&mut self, name: &str) -> Result<Schema, FindError> {
        let path = Path::new(name);
        if path.extension().is_some() || path.is_file() {
            self.file(path)
        } else {
            self.named_or_known(&name.parse()?)
        }
    }

    /// The schema of a type from the folders or from this program.
    fn named(&mut self, name: &TypeName) -> Result<Schema, SchemaError> {
        let Self { packages, bundled, .. } = self;
        let resolved = Schema::resolve(name, &mut |name| match packages.definition(name)? {
            Some(definition) => Ok(Some(definition)),
            None => bundled.definition(name),
        });
        // The error lists the searched folders.
        resolved.or_else(|_| packages.schema(name))
    }

    /// The schema of a type that may be known only in the domain, whose processes cache their definitions.
    fn named_or_known(&mut self, name: &TypeName) -> Result<Schema, FindError> {
        let missing = match self.named(name) {
            Err(error @ SchemaError::Missing { .. }) => error,
            found => return Ok(found?),
        };
        let graph = self.domain.and_then(|domain| graph_of(domain).ok());
        let types = graph.iter().flat_map(|graph| graph.endpoints.iter().map(|end| &end.topic_type));
        for known in types.filter(|known| known.name == name.as_str()) {
            match find_schema("", name, Some(known)) {
                Ok(schema) => return Ok(Arc::unwrap_or_clone(schema)),
                Err(DefinitionError::Unknown { .. }) => {}
                Err(error) => return Err(FindError::Known(error)),
            }
        }
        Err(missing.into())
    }

    fn file(&mut self, path: &Path) -> Result<Schema, FindError> {
        let no_type = || FindError::File { path: path.to_owned() };
        let extension = path.extension().and_then(|extension| extension.to_str()).unwrap_or_default();
        let kind = Kind::from_name(extension);
        if kind.is_none() && extension != "json" {
            return Err(no_type());
        }
        let text =
            fs::read_to_string(path).map_err(|source| FindError::Read { path: path.to_owned(), source })?;
        let Some(kind) = kind else {
            let description: HashedTypeDescription = serde_json::from_str(&text).map_err(|_| no_type())?;
            return Ok(Schema::from_description(&description.type_description_msg)?);
        };
        let stem = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
        let full = fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
        let name = TypeName::new(&package_of(&full), kind, stem)?;
        if kind == Kind::Msg && text.lines().any(|line| line.starts_with("===")) {
            return Ok(Schema::from_text(&name, &text)?);
        }
        // Also searches the other types of its package, and the packages beside it.
        if let Some(beside) = full.ancestors().nth(3) {
            self.packages.add_folder(beside);
        }
        self.packages.add_text(&name, &path.to_string_lossy(), &text)?;
        Ok(self.named(&name)?)
    }
}

/// The package of `.../package/msg/Name.msg`; for a file in another place, the name of its folder.
fn package_of(file: &Path) -> String {
    let folders: Vec<_> =
        file.ancestors().skip(1).filter_map(|folder| folder.file_name()?.to_str()).take(2).collect();
    let folder = match folders[..] {
        [kind, package] if Kind::from_name(kind).is_some() => package,
        [folder, ..] => folder,
        [] => "",
    };
    match TypeName::new(folder, Kind::Msg, "Name") {
        Ok(_) => folder.to_owned(),
        Err(_) => "local_msgs".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_belong_to_packages() {
        assert_eq!(package_of(Path::new("/ws/demo_msgs/msg/Tick.msg")), "demo_msgs");
        assert_eq!(package_of(Path::new("/ws/demo/Tick.msg")), "demo");
        assert_eq!(package_of(Path::new("/ws/My Files/Tick.msg")), "local_msgs");
        assert_eq!(package_of(Path::new("Tick.msg")), "local_msgs");
    }
}
