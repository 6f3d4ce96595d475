// SPDX-License-Identifier: MIT OR Apache-2.0
//! Types of messages, found at run time: no type is compiled in.

use libloading::Library;
use r2r_rcl::*;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The type support of a message type, to carry its bytes. Clones share it.
#[derive(Clone)]
pub struct MessageSupport {
    raw: *const rosidl_message_type_support_t,
    hash: Option<String>,
    _library: Arc<Library>,
}

// SAFETY: constant data of a library that stays loaded.
unsafe impl Send for MessageSupport {}
// SAFETY: as above.
unsafe impl Sync for MessageSupport {}

/// Why a type cannot be carried, with the fix.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum TypeSupportError {
    #[error("'{name}' is not a type of messages: write package/msg/Name, such as std_msgs/msg/String")]
    Name { name: String },
    #[error("'{name}' is not a type of services: write package/srv/Name, such as std_srvs/srv/SetBool")]
    ServiceName { name: String },
    #[error(
        "ROS 2 package '{package}' is not installed in any of AMENT_PREFIX_PATH ({}): install it (apt install \
         ros-$ROS_DISTRO-{}), or source the workspace that has it", prefixes(.searched), package.replace('_', "-")
    )]
    Package { package: String, searched: Vec<PathBuf> },
    #[error(
        "package '{package}' is installed in {}, but its lib{package}__{library}.so cannot be loaded: {reason}; \
         install or build the package with rosidl_default_generators, and source it", at.display()
    )]
    Library { package: String, at: PathBuf, library: &'static str, reason: String },
    #[error(
        "package '{package}' in {} has no {kind} '{name}': correct the name, or rebuild the package if the type is new \
         (ros2 interface package {package} lists its interfaces)", at.display()
    )]
    Unknown { package: String, kind: &'static str, name: String, at: PathBuf },
}

fn prefixes(searched: &[PathBuf]) -> String {
    match searched {
        [] => "which is empty: source ROS 2".to_owned(),
        some => some.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(":"),
    }
}

impl MessageSupport {
    /// Finds the type `name`, such as `std_msgs/msg/String`, in `AMENT_PREFIX_PATH`.
    ///
    /// # Errors
    /// [`TypeSupportError`].
    pub fn load(name: &str) -> Result<Self, TypeSupportError> {
        let InstalledType { full, library, unknown, .. } = find(name, "msg")?;
        // SAFETY: rosidl generated the library for this type.
        let raw = unsafe { message_handle(&library, &full) }.ok_or(unknown)?;
        // SAFETY: constant data of the library; the library's function takes the handle itself.
        let hash = unsafe {
            let hash = (*raw).get_type_hash_func.and_then(|get| get(raw).as_ref());
            hash.and_then(|hash| super::graph::hash_text(hash.version, &hash.value))
        };
        Ok(MessageSupport { raw, hash, _library: library })
    }

    /// `RIHS01_...`, of the installed definition.
    pub fn hash(&self) -> Option<&str> {
        self.hash.as_deref()
    }

    pub(crate) fn raw(&self) -> *const rosidl_message_type_support_t {
        self.raw
    }
}

/// A type whose package is installed.
pub(super) struct InstalledType<'n> {
    pub(super) package: &'n str,
    /// Its name in C: `std_msgs__msg__String`.
    pub(super) full: String,
    pub(super) library: Arc<Library>,
    pub(super) unknown: TypeSupportError,
}

/// Finds the type `name` of a `kind`, `msg` or `srv`.
pub(super) fn find<'n>(name: &'n str, kind: &'static str) -> Result<InstalledType<'n>, TypeSupportError> {
    // Messages and services of an action are in its package's folder `action`.
    let in_folder = |folder| split(name, folder).map(|(package, base)| (package, folder, base));
    let Some((package, folder, base)) = in_folder(kind).or_else(|| in_folder("action")) else {
        let name = name.to_owned();
        return Err(match kind {
            "msg" => TypeSupportError::Name { name },
            _ => TypeSupportError::ServiceName { name },
        });
    };
    let (library, at) = load_library(package, "rosidl_typesupport_c")?;
    let full = format!("{package}__{folder}__{base}");
    let unknown = TypeSupportError::Unknown { package: package.to_owned(), kind, name: base.to_owned(), at };
    Ok(InstalledType { package, full, library, unknown })
}

/// The type support of the message `full` in `library`.
///
/// # Safety
/// rosidl generated the library for this type.
pub(super) unsafe fn message_handle(
    library: &Library,
    full: &str,
) -> Option<*const rosidl_message_type_support_t> {
    type Get = unsafe extern "C" fn() -> *const rosidl_message_type_support_t;
    let symbol = format!("rosidl_typesupport_c__get_message_type_support_handle__{full}");
    // SAFETY: rosidl generates functions of this name and type.
    let raw = unsafe { library.get::<Get>(symbol.as_bytes()).ok()?() };
    (!raw.is_null()).then_some(raw)
}

/// Whether `name` is like `std_msgs/msg/String`.
pub fn is_message_type(name: &str) -> bool {
    split(name, "msg").is_some()
}

/// Whether `name` is like `std_srvs/srv/SetBool`.
pub fn is_service_type(name: &str) -> bool {
    split(name, "srv").is_some()
}

/// Package and base name of `package/kind/Name`.
fn split<'a>(name: &'a str, kind: &str) -> Option<(&'a str, &'a str)> {
    let (package, rest) = name.split_once('/')?;
    let base = rest.strip_prefix(kind)?.strip_prefix('/')?;
    let is_word =
        |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_');
    (is_word(package) && is_word(base)).then_some((package, base))
}

/// One of the package's C libraries, and the prefix where the package is installed.
pub(super) fn load_library(
    package: &str,
    library: &'static str,
) -> Result<(Arc<Library>, PathBuf), TypeSupportError> {
    let paths = std::env::var_os("AMENT_PREFIX_PATH").unwrap_or_default();
    let searched: Vec<PathBuf> =
        std::env::split_paths(&paths).filter(|path| !path.as_os_str().is_empty()).collect();
    let has = |prefix: &&PathBuf| prefix.join("share").join(package).is_dir();
    let Some(at) = searched.iter().find(has).cloned() else {
        return Err(TypeSupportError::Package { package: package.to_owned(), searched });
    };
    let file = format!("lib{package}__{library}.so");
    let beside = at.join("lib").join(&file);
    let path = if beside.exists() { beside.as_path() } else { Path::new(&file) };
    // SAFETY: generated code, whose initialisers register types.
    let loaded = unsafe { Library::new(path) };
    let loaded = loaded.map_err(|error| TypeSupportError::Library {
        package: package.to_owned(),
        at: at.clone(),
        library,
        reason: error.to_string(),
    })?;
    Ok((Arc::new(loaded), at))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(name: &str) -> String {
        MessageSupport::load(name).err().unwrap().to_string()
    }

    #[test]
    fn what_is_missing_is_named_with_its_fix() {
        for name in ["", "String", "std_msgs/String", "std_msgs/srv/String", "std_msgs/msg/", "../msg/A"] {
            assert!(message(name).contains("write package/msg/Name"), "{name}");
        }
        let unknown = message("no_such_msgs/msg/A");
        assert!(
            unknown.contains("'no_such_msgs'") && unknown.contains("ros-$ROS_DISTRO-no-such-msgs"),
            "{unknown}"
        );
        let unknown = message("std_msgs/msg/Sting");
        assert!(unknown.contains("no msg 'Sting'") && unknown.contains("'std_msgs'"), "{unknown}");
        // A package without a library to load.
        let unloadable = message("rclpy/msg/A");
        assert!(unloadable.contains("rosidl_default_generators"), "{unloadable}");
    }

    #[test]
    fn hashes_are_those_of_the_definitions() {
        let string = MessageSupport::load("std_msgs/msg/String").unwrap();
        assert_eq!(
            string.hash(),
            Some("RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18")
        );
    }
}
