// SPDX-License-Identifier: MIT OR Apache-2.0
//! Finds the definition of a type that is known by name.

use crate::bundled::Bundled;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use tautline_schema::{Layout, Packages, Schema, SchemaError, Size, TypeName};
use tautline_transport::{ClaimedSchema, SchemaStore, TopicType};

/// No definition, or one that cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the names of the fields say it")]
pub enum DefinitionError {
    /// The stored definition of a topic's type is not its definition.
    #[error(
        "the definition in {} cannot be used: {reason}; remove the file, then restart a process that has the type: it writes the file anew",
        path.display()
    )]
    Stored { path: PathBuf, reason: String },
    /// No definition of a message type was found.
    #[error(
        "topic '{topic}': the definition of '{type_name}' was found neither beside the topic ({stored}), nor in AMENT_PREFIX_PATH, nor among the bundled packages: source the ROS 2 workspace that has it, or start a process first whose type has a definition, as those of tautline-build have"
    )]
    Unknown {
        topic: String,
        type_name: String,
        /// What the topic itself provided.
        stored: String,
    },
    /// A definition, or a type's name, is not valid.
    #[error(transparent)]
    Schema(#[from] SchemaError),
}

type Result<T> = std::result::Result<T, DefinitionError>;

/// The definition of the type `name`, with all types of which it consists, for `topic`, which exists with the type
/// `existing` or does not exist yet. It is the definition stored for the topic's hash, after the hash has been recomputed;
/// otherwise that of the packages in `AMENT_PREFIX_PATH`; otherwise the bundled one.
///
/// Of the latter two, the definition with the topic's hash is used. If none has this hash, the first one is used: an
/// endpoint created with it then matches no other endpoint, and a warning names both hashes. But if there is a stored definition and it
/// cannot be used, that is the error.
///
/// # Errors
/// [`DefinitionError::Unknown`] if there is none; [`Stored`](DefinitionError::Stored) or [`Schema`](DefinitionError::Schema) if it cannot
/// be used.
pub fn find_schema(topic: &str, name: &TypeName, existing: Option<&TopicType>) -> Result<Arc<Schema>> {
    find(&SchemaStore::of_user(), &mut Packages::from_env(), topic, name, existing)
}

fn find(
    store: &SchemaStore,
    installed: &mut Packages,
    topic: &str,
    name: &TypeName,
    existing: Option<&TopicType>,
) -> Result<Arc<Schema>> {
    // If the topic has another type, its hash is not the one to look for.
    let existing = existing.filter(|existing| existing.name == name.as_str());
    let hash = existing.and_then(|existing| existing.hash.as_deref());
    // If the store cannot be read, or its definition not be used, the other places are searched nevertheless.
    let (mut unread, mut unusable) = (None, None);
    if let Some(hash) = hash {
        match store.read(hash) {
            Ok(Some(claimed)) => match checked(claimed, name, hash) {
                Ok(schema) => return Ok(schema.into()),
                Err(error) => unusable = Some(error),
            },
            Ok(None) => {}
            Err(error) if error.kind() == io::ErrorKind::InvalidData => {
                let (path, reason) = (store.path().join(hash), error.to_string());
                unusable = Some(DefinitionError::Stored { path, reason });
            }
            Err(error) => unread = Some(error),
        }
    }
    let mut bundled = Bundled::default();
    let first = known(Schema::resolve(name, &mut |name| match installed.definition(name)? {
        Some(definition) => Ok(Some(definition)),
        None => bundled.definition(name),
    }))?;
    let agrees = |schema: &Schema| hash.is_none_or(|hash| schema.hash().to_string() == hash);
    if let Some(first) = first {
        if agrees(&first) {
            return Ok(first.into());
        }
        let second = known(Schema::resolve(name, &mut |name| bundled.definition(name)))?;
        if let Some(second) = second.filter(agrees) {
            return Ok(second.into());
        }
        if unusable.is_none() {
            return Ok(first.into());
        }
    }
    Err(unusable.unwrap_or_else(|| DefinitionError::Unknown {
        topic: topic.to_owned(),
        type_name: name.to_string(),
        stored: match (existing, hash) {
            (None, _) => "it has no publisher or subscription of this type yet".to_owned(),
            (Some(_), None) => "its type has no hash".to_owned(),
            (Some(_), Some(hash)) => {
                let path = store.path().join(hash);
                match unread {
                    None => format!("nothing is kept as {}", path.display()),
                    Some(error) => format!("{} cannot be read: {error}", path.display()),
                }
            }
        },
    }))
}

/// Parses a stored definition and checks its hash: it is untrusted, because anybody who can write the folder may have written it.
fn checked(claimed: ClaimedSchema, name: &TypeName, hash: &str) -> Result<Schema> {
    let ClaimedSchema { path, text } = claimed;
    let reason = match Schema::from_text(name, &text) {
        Ok(schema) if schema.hash().to_string() == hash => return Ok(schema),
        Ok(schema) => format!("read as '{name}', its hash is {}", schema.hash()),
        Err(error) => error.to_string(),
    };
    Err(DefinitionError::Stored { path, reason })
}

/// `None` for a type that is defined nowhere. A type that uses an undefined type is an error.
fn known(
    schema: std::result::Result<Schema, SchemaError>,
) -> std::result::Result<Option<Schema>, SchemaError> {
    match schema {
        Err(SchemaError::Missing { .. }) => Ok(None),
        schema => schema.map(Some),
    }
}

/// Everything that a topic can know about a type: its name, its hash, its definition, and its size if that is
/// fixed.
pub fn type_of(schema: &Schema) -> TopicType {
    let topic_type = TopicType::new(schema.name().to_string())
        .with_hash(schema.hash().to_string())
        .with_definition(schema.to_text());
    match Layout::of(schema).size {
        Size::Fixed(body_bytes) => topic_type.with_body_bytes(body_bytes),
        Size::Formula(_) => topic_type,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use tautline_transport::MAX_SCHEMA_BYTES;

    const TEXT: &str = "uint8 x\n";
    const NAME: &str = "demo_msgs/msg/A";

    /// A store, an installed package, and what is found in them for a topic of this hash.
    struct Fixture {
        folder: tempfile::TempDir,
        store: SchemaStore,
        installed: bool,
    }

    impl Fixture {
        fn new() -> Self {
            let folder = tempfile::tempdir().unwrap();
            let store = SchemaStore::at(folder.path().join("root"));
            Fixture { folder, store, installed: false }
        }

        fn install(&mut self, package: &str, name: &str, text: &str) {
            let file = self.folder.path().join(format!("prefix/share/{package}/msg/{name}.msg"));
            fs::create_dir_all(file.parent().unwrap()).unwrap();
            fs::write(file, text).unwrap();
            self.installed = true;
        }

        fn find(&self, name: &str, hash: Option<&str>) -> Result<Arc<Schema>> {
            let mut installed = Packages::new();
            if self.installed {
                installed.add_folder(self.folder.path().join("prefix"));
            }
            let existing = TopicType::new(name.to_owned());
            let existing = hash.map(|hash| existing.with_hash(hash.to_owned()));
            find(&self.store, &mut installed, "/t", &name.parse().unwrap(), existing.as_ref())
        }
    }

    fn hash_of(name: &str, text: &str) -> String {
        Schema::from_text(&name.parse().unwrap(), text).unwrap().hash().to_string()
    }

    #[test]
    fn what_is_kept_wins_then_what_is_installed_then_what_is_bundled() {
        let mut fixture = Fixture::new();
        let hash = hash_of(NAME, TEXT);
        let error = fixture.find(NAME, Some(&hash)).unwrap_err().to_string();
        assert!(error.contains("nothing is kept as") && error.contains(&hash), "{error}");
        fixture.store.keep(&hash, TEXT).unwrap();
        assert_eq!(fixture.find(NAME, Some(&hash)).unwrap().hash().to_string(), hash);

        fixture.install("demo_msgs", "A", "uint16 x\n");
        assert_eq!(fixture.find(NAME, Some(&hash)).unwrap().hash().to_string(), hash);
        assert_eq!(fixture.find(NAME, None).unwrap().hash().to_string(), hash_of(NAME, "uint16 x\n"));

        // Two versions of one type: that of the topic, whoever has it, else the installed one.
        let bundled = fixture.find("std_msgs/msg/String", None).unwrap().hash().to_string();
        fixture.install("std_msgs", "String", "wstring data\n");
        let installed = hash_of("std_msgs/msg/String", "wstring data\n");
        for (topic, found) in [(Some(&bundled), &bundled), (Some(&installed), &installed), (None, &installed)]
        {
            let schema = fixture.find("std_msgs/msg/String", topic.map(String::as_str)).unwrap();
            assert_eq!(&schema.hash().to_string(), found);
        }
        let unknown = format!("RIHS01_{}", "a".repeat(64));
        assert_eq!(
            fixture.find("std_msgs/msg/String", Some(&unknown)).unwrap().hash().to_string(),
            installed
        );
    }

    #[test]
    fn a_file_that_lies_is_named() {
        let mut fixture = Fixture::new();
        let hash = hash_of(NAME, TEXT);
        fixture.store.keep(&hash, TEXT).unwrap();
        let file = fixture.store.path().join(&hash);
        let long = format!("{TEXT}#{}", "x".repeat(MAX_SCHEMA_BYTES));
        for (content, reason) in [
            ("uint16 x\n".as_bytes(), hash_of(NAME, "uint16 x\n")),
            (b"uint8 x\nuint", "uint".to_owned()),
            (b"Other x\n", "demo_msgs/msg/Other".to_owned()),
            (b"A x\n", "cannot contain itself".to_owned()),
            (b"\xff\xfe", "UTF-8".to_owned()),
            (long.as_bytes(), "longer than".to_owned()),
        ] {
            fs::write(&file, content).unwrap();
            let error = fixture.find(NAME, Some(&hash)).unwrap_err();
            assert!(matches!(error, DefinitionError::Stored { .. }), "{error}");
            let error = error.to_string();
            let path = file.to_string_lossy();
            assert!(error.contains(&*path) && error.contains(&reason) && error.contains("remove"), "{error}");
        }
        // That of another type.
        fs::write(&file, TEXT).unwrap();
        assert!(fixture.find("demo_msgs/msg/B", Some(&hash)).is_err());
        assert!(fixture.find(NAME, Some(&hash)).is_ok());
        // The other places may have the topic's type.
        fs::write(&file, "uint16 x\n").unwrap();
        fixture.install("demo_msgs", "A", TEXT);
        assert_eq!(fixture.find(NAME, Some(&hash)).unwrap().hash().to_string(), hash);
        fixture.install("demo_msgs", "A", "uint32 x\n");
        assert!(matches!(fixture.find(NAME, Some(&hash)), Err(DefinitionError::Stored { .. })));
    }

    #[test]
    fn without_a_folder_of_its_own_the_user_has_the_other_places() {
        use std::os::unix::fs::PermissionsExt;
        let fixture = Fixture::new();
        let hash = hash_of(NAME, TEXT);
        fixture.store.keep(&hash, TEXT).unwrap();
        fs::set_permissions(fixture.store.path(), fs::Permissions::from_mode(0o755)).unwrap();
        let error = fixture.find(NAME, Some(&hash)).unwrap_err().to_string();
        assert!(error.contains("open to other users"), "{error}");
        let bundled = fixture.find("std_msgs/msg/String", None).unwrap().hash().to_string();
        assert!(fixture.find("std_msgs/msg/String", Some(&bundled)).is_ok());
    }

    #[test]
    fn a_definition_that_is_wrong_is_an_error_with_its_place() {
        let mut fixture = Fixture::new();
        fixture.install("demo_msgs", "A", "uint8 x\nuint8\n");
        assert!(fixture.find(NAME, None).unwrap_err().to_string().contains("A.msg:2"));
        fixture.install("demo_msgs", "A", "uint8 x\nno_msgs/None none\n");
        let error = fixture.find(NAME, None).unwrap_err().to_string();
        assert!(error.contains("no_msgs/msg/None") && error.contains("A.msg:2"), "{error}");
    }
}
