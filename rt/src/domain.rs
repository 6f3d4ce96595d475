// SPDX-License-Identifier: MIT OR Apache-2.0
//! The location of a domain's files: one folder in /dev/shm for each domain, user and scope.
//!
//! Processes of different scopes do not see each other: for example tests beside a running robot, or several simulated robots
//! on one host. The scope is `TAUT_SCOPE`, or the one set by [`set_scope`] before the first use; otherwise it is the default
//! scope.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Longest name of a scope, in bytes.
pub const MAX_SCOPE_BYTES: usize = 32;

/// The environment variable that names the scope.
const VARIABLE: &str = "TAUT_SCOPE";

static SCOPE: OnceLock<Result<Option<String>, ScopeError>> = OnceLock::new();

/// Why a scope cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ScopeError {
    /// The name is not valid as part of a file name.
    #[error(
        "'{name}' cannot be a scope (TAUT_SCOPE): it has 1 to {MAX_SCOPE_BYTES} letters, digits, '-' and '_'"
    )]
    Name {
        /// The name.
        name: String,
    },
    /// The process is already in another scope.
    #[error(
        "this process is already in the scope '{present}', not '{wanted}': set the scope before anything else"
    )]
    Fixed {
        /// The present scope; empty for the default scope.
        present: String,
        /// The requested scope.
        wanted: String,
    },
}

/// The scope of this process; `None` is the default one.
///
/// # Errors
/// [`ScopeError::Name`]: `TAUT_SCOPE` is not a valid scope.
pub fn scope() -> Result<Option<&'static str>, ScopeError> {
    let of_environment = || match std::env::var_os(VARIABLE) {
        // A name that is not UTF-8 gets a character that no scope has.
        Some(name) if !name.is_empty() => checked(&name.to_string_lossy()).map(Some),
        _ => Ok(None),
    };
    SCOPE.get_or_init(of_environment).as_ref().map(Option::as_deref).map_err(Clone::clone)
}

/// Puts this process into the scope `name`, in place of `TAUT_SCOPE`. Call it before any function that uses a domain.
///
/// # Errors
/// [`ScopeError`]: an invalid name, or the process is in another scope.
pub fn set_scope(name: &str) -> Result<(), ScopeError> {
    let wanted = checked(name)?;
    match SCOPE.get_or_init(|| Ok(Some(wanted.clone()))) {
        Ok(Some(present)) if *present == wanted => Ok(()),
        present => {
            let present = present.clone().ok().flatten().unwrap_or_default();
            Err(ScopeError::Fixed { present, wanted })
        }
    }
}

/// Puts a process of tests into the scope `name`, in which no user's programs are, unless `TAUT_SCOPE` is set. Returns the
/// process's scope.
///
/// # Panics
/// If the process is in the default scope.
#[doc(hidden)]
pub fn test_scope(name: &str) -> &'static str {
    if std::env::var_os(VARIABLE).is_none() {
        // Refused if the process is in another scope.
        let _ = set_scope(name);
    }
    scope().unwrap().unwrap()
}

fn checked(name: &str) -> Result<String, ScopeError> {
    let is_scope = (1..=MAX_SCOPE_BYTES).contains(&name.len())
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-' || byte == b'_');
    if is_scope { Ok(name.to_owned()) } else { Err(ScopeError::Name { name: name.to_owned() }) }
}

/// The name of a domain's folder in [`shm::DIRECTORY`](crate::shm::DIRECTORY), for this user and scope.
pub fn shared_folder(domain: u32) -> String {
    let user = rustix::process::geteuid().as_raw();
    match scope() {
        Ok(Some(scope)) => format!("taut_{domain}_{user}.{scope}"),
        _ => format!("taut_{domain}_{user}"),
    }
}

/// The names of this user's domains' folders, of all scopes, with the numbers of the domains.
///
/// # Errors
/// The folder of shared memory cannot be read.
pub fn all_shared_folders() -> std::io::Result<Vec<(u32, String)>> {
    let user = rustix::process::geteuid().as_raw();
    let entries = std::fs::read_dir(crate::shm::DIRECTORY)?.flatten();
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    let mut folders: Vec<_> = names.filter_map(|name| Some((domain_of(&name, user)?, name))).collect();
    folders.sort();
    Ok(folders)
}

/// The domain whose folder has this name, if it is this user's.
fn domain_of(name: &str, user: u32) -> Option<u32> {
    let (domain, rest) = name.strip_prefix("taut_")?.split_once('_')?;
    let (of, scope) = rest.split_once('.').map_or((rest, None), |(of, scope)| (of, Some(scope)));
    let is_own = of.parse() == Ok(user) && scope.is_none_or(|scope| checked(scope).is_ok());
    domain.parse().ok().filter(|_| is_own)
}

/// The path of a domain's folder, for this user and scope.
pub fn shared_path(domain: u32) -> PathBuf {
    Path::new(crate::shm::DIRECTORY).join(shared_folder(domain))
}

/// The folder for this user's files that outlive processes: definitions of message types.
pub fn kept_folder() -> PathBuf {
    let user = rustix::process::geteuid().as_raw();
    Path::new("/tmp").join(match scope() {
        Ok(Some(scope)) => format!("tautline_{user}.{scope}"),
        _ => format!("tautline_{user}"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_scopes() {
        for good in ["a", "robot-2", "CI_7", &"x".repeat(MAX_SCOPE_BYTES)] {
            assert_eq!(checked(good).as_deref(), Ok(good));
        }
        for bad in ["", ".", "a/b", "../x", "a b", "ä", &"x".repeat(MAX_SCOPE_BYTES + 1)] {
            assert_eq!(checked(bad), Err(ScopeError::Name { name: bad.to_owned() }));
        }
    }

    #[test]
    fn folders_of_domains_are_known_by_their_names() {
        for (name, domain) in [("taut_7_42", Some(7)), ("taut_0_42.sim-2", Some(0)), ("taut_7_421", None)] {
            assert_eq!(domain_of(name, 42), domain, "{name}");
        }
        for other in ["taut_7", "taut_x_42", "taut_7_42.", "taut_7_42.a b", "taut_7_42_p0", "other_7_42"] {
            assert_eq!(domain_of(other, 42), None, "{other}");
        }
    }

    #[test]
    fn a_process_is_in_one_scope() {
        set_scope("rt-test").unwrap();
        set_scope("rt-test").unwrap();
        let error = set_scope("other").unwrap_err().to_string();
        assert!(error.contains("'rt-test'") && error.contains("'other'"), "{error}");
        assert!(shared_folder(7).starts_with("taut_7_") && shared_folder(7).ends_with(".rt-test"));
        assert!(kept_folder().to_string_lossy().ends_with(".rt-test"));
    }
}
