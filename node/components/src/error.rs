// SPDX-License-Identifier: MIT OR Apache-2.0

use std::io;
use std::path::PathBuf;

/// Why a component was not loaded or unloaded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the names of the fields say it")]
pub enum ComponentError {
    /// The file cannot be read.
    #[error(
        "{} cannot be read: {source}; a library (package_name in a request to load) is the path of a file here, absolute or from the folder in which the container was started: no other place is searched",
        path.display()
    )]
    Read { path: PathBuf, source: io::Error },
    /// The file cannot be loaded as a library.
    #[error("{} is not a shared library: {reason}", path.display())]
    NoLibrary { path: PathBuf, reason: String },
    /// The library has no components.
    #[error(
        "{} has no entry point for components: export it with tautline_components::components!, in a crate of type cdylib",
        path.display()
    )]
    NoEntryPoint { path: PathBuf },
    /// The library was built by another compiler, with another Tautline, or for another target. None of its code has
    /// run.
    #[error(
        "{} was built with {found}; this process with {own}: build both with the same compiler and Tautline",
        path.display()
    )]
    OtherBuild { path: PathBuf, found: String, own: String },
    /// The system did not load the library: it needs another build of Tautline, or a library that is missing.
    #[error(
        "{} cannot be loaded: {reason}; was it built together with this process, with the same features?",
        path.display()
    )]
    Load { path: PathBuf, reason: String },
    /// The library and this process do not use the same copy of Tautline: each would have its own log, trace and scope.
    #[error(
        "{} and this process each have their own copy of Tautline: link both against tautline-dylib, as taut-container is",
        path.display()
    )]
    OtherCopy { path: PathBuf },
    /// The file has been replaced since its components were loaded; the old code is still in memory.
    #[error("{} was replaced since it was loaded: restart the process to load the new one", path.display())]
    Replaced { path: PathBuf },
    /// The library has no such component.
    #[error("{} has no component '{wanted}'; it has: {known}", path.display())]
    NoComponent {
        path: PathBuf,
        /// The requested name; empty if no name was given and there are several components.
        wanted: String,
        known: String,
    },
    /// The component could not be created.
    #[error("component '{component}' was not created: {source}")]
    Create { component: String, source: Box<tautline::Error> },
    /// The component panicked while it was created.
    #[error("component '{component}' panicked while it was created")]
    Panicked { component: String },
    /// No component has this number.
    #[error("no component has number {id}; `list` prints the existing ones")]
    NoSuchId {
        /// The number.
        id: u64,
    },
    /// A callback of the component panicked.
    #[error("component {id} is unloaded, but its callback had ended badly: {reason}")]
    Callback {
        /// The component's number.
        id: u64,
        /// How.
        reason: String,
    },
}
