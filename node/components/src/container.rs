// SPDX-License-Identifier: MIT OR Apache-2.0
//! A process's components: loads libraries, creates components with their nodes, ends them.

use crate::entry::{Library, Plugin};
use crate::error::ComponentError;
use crate::stamp::{self, SYMBOL};
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::time::SystemTime;
use tautline::{
    CallbackHandle, Context, LogSeverity, Logger, Node, NodeCallbacks, NodeOptions, ParameterValue,
    RemapRules,
};

/// Loads components into this process. They share its context, and therefore one sampler. Messages between them are read where
/// they were written.
///
/// A loaded library stays in memory, because it is not known when its code has run for the last time. Unloading a component ends
/// its callbacks, and drops the objects that they own.
pub struct Container {
    context: Context,
    libraries: BTreeMap<PathBuf, (&'static Library, Version)>,
    loaded: BTreeMap<u64, Loaded>,
    last_id: u64,
}

/// The version of a file: its device, its number, and when it was written.
type Version = (u64, u64, Option<SystemTime>);

struct Loaded {
    full_name: String,
    /// The callbacks that the component returned; they may belong to several nodes.
    handed: Vec<CallbackHandle>,
    of_node: NodeCallbacks,
    /// Its node's logger, if a level was set.
    logger: Option<(Logger, LogSeverity)>,
}

/// A component to load.
#[derive(Clone, Debug, Default)]
pub struct Load {
    /// The shared library.
    pub library: PathBuf,
    /// The component in it; may be empty if the library has only one.
    pub component: String,
    /// The node's name; if empty, the last part of the component's name, in lower case.
    pub name: String,
    /// The node's namespace.
    pub namespace: String,
    /// Remapping rules for this node only.
    pub remap: RemapRules,
    /// Values of parameters that the component declares.
    pub parameters: Vec<(String, ParameterValue)>,
    /// The level of its logger.
    pub log_level: Option<LogSeverity>,
    /// Whether the rules and parameters of the process's command line also apply to this node; no by default, as in ROS 2's
    /// containers.
    pub use_global_arguments: bool,
}

impl Container {
    /// A container without components.
    pub fn new(context: Context) -> Self {
        Container { context, libraries: BTreeMap::new(), loaded: BTreeMap::new(), last_id: 0 }
    }

    /// Loads a component; returns its number, from 1. A library with another build than this process is refused before any of
    /// its code runs.
    ///
    /// # Errors
    /// [`ComponentError`]; nothing was created.
    pub fn load(&mut self, load: &Load) -> Result<u64, ComponentError> {
        let library = self.library(&load.library)?;
        let plugin = find(library.plugins, load)?;
        let short = plugin.name.rsplit("::").next().unwrap_or(plugin.name).to_lowercase();
        let name = if load.name.is_empty() { short } else { load.name.clone() };
        let component = || plugin.name.to_owned();
        let not_made = |source: tautline::Error| ComponentError::Create {
            component: component(),
            source: source.into(),
        };
        let options = NodeOptions::default()
            .remap(load.remap.clone())
            .parameter_overrides(load.parameters.clone())
            .use_global_arguments(load.use_global_arguments);
        let node = Node::create_with_options(self.context.clone(), &name, &load.namespace, options);
        let node = node.map_err(not_made)?;
        let full_name = node.fully_qualified_name().to_owned();
        let logger = load.log_level.map(|level| {
            let logger = node.logger().clone();
            let before = logger.level();
            logger.set_level(level);
            (logger, before)
        });
        let of_node = node.callbacks().clone();
        let made = catch_unwind(AssertUnwindSafe(|| (plugin.create)(node)))
            .map_err(|_| ComponentError::Panicked { component: component() })
            .and_then(|made| made.map_err(not_made));
        let handed = made.inspect_err(|_| {
            // Ends what it had started before it failed. A panic of one of them, too, adds no information.
            let _ = of_node.end();
            restore_level(logger.as_ref());
        })?;
        self.last_id += 1;
        self.loaded.insert(self.last_id, Loaded { full_name, handed, of_node, logger });
        Ok(self.last_id)
    }

    fn library(&mut self, path: &Path) -> Result<&'static Library, ComponentError> {
        let unreadable = |source| ComponentError::Read { path: path.into(), source };
        let path = path.canonicalize().map_err(unreadable)?;
        let version = version(&path).map_err(unreadable)?;
        if let Some((library, loaded)) = self.libraries.get(&path) {
            // The library's code stays in memory; a second library beside it would have the same name, and other types.
            return if *loaded == version { Ok(library) } else { Err(ComponentError::Replaced { path }) };
        }
        stamp::check(&path)?;
        let library = open(&path)?;
        self.libraries.insert(path, (library, version));
        Ok(library)
    }

    /// Ends a component's callbacks, those that it returned and those of its node, and waits until they have ended. A running
    /// callback delays this.
    ///
    /// # Errors
    /// [`ComponentError::NoSuchId`]; [`ComponentError::Callback`] if one had panicked.
    pub fn unload(&mut self, id: u64) -> Result<(), ComponentError> {
        let Loaded { handed, of_node, logger, .. } =
            self.loaded.remove(&id).ok_or(ComponentError::NoSuchId { id })?;
        handed.iter().for_each(CallbackHandle::stop);
        let mut ended = of_node.end().map_err(|error| error.to_string());
        for callback in handed {
            ended = callback.join().map_err(|error| error.to_string()).and(ended);
        }
        restore_level(logger.as_ref());
        ended.map_err(|reason| ComponentError::Callback { id, reason })
    }

    /// The components' numbers and the full names of their nodes.
    pub fn list(&self) -> impl Iterator<Item = (u64, &str)> {
        self.loaded.iter().map(|(id, loaded)| (*id, loaded.full_name.as_str()))
    }

    /// The full name of a component's node.
    pub fn full_name(&self, id: u64) -> Option<&str> {
        self.loaded.get(&id).map(|loaded| loaded.full_name.as_str())
    }
}

impl Drop for Container {
    fn drop(&mut self) {
        let ids: Vec<_> = self.loaded.keys().copied().collect();
        for id in ids {
            let _ = self.unload(id);
        }
    }
}

/// Restores the logger's level, so that the next node of this name has the level that it would have had.
fn restore_level(logger: Option<&(Logger, LogSeverity)>) {
    if let Some((logger, before)) = logger {
        logger.set_level(*before);
    }
}

fn version(path: &Path) -> std::io::Result<Version> {
    use std::os::unix::fs::MetadataExt;
    let file = path.metadata()?;
    Ok((file.dev(), file.ino(), file.modified().ok()))
}

fn find<'l>(plugins: &'l [Plugin], load: &Load) -> Result<&'l Plugin, ComponentError> {
    let found = match plugins {
        [only] if load.component.is_empty() => Some(only),
        _ => plugins.iter().find(|plugin| plugin.name == load.component),
    };
    found.ok_or_else(|| {
        let known: Vec<_> = plugins.iter().map(|plugin| plugin.name).collect();
        let (path, wanted) = (load.library.clone(), load.component.clone());
        ComponentError::NoComponent { path, wanted, known: known.join(", ") }
    })
}

/// Loads a library whose stamp was checked.
fn open(path: &Path) -> Result<&'static Library, ComponentError> {
    let refuse =
        |error: libloading::Error| ComponentError::Load { path: path.into(), reason: error.to_string() };
    use libloading::os::unix;
    // All symbols are bound now: a missing one is an error here, not a crash later.
    let flags = unix::RTLD_NOW | unix::RTLD_LOCAL;
    // SAFETY: its stamp says that it was built by this process's compiler with this process's Tautline; what runs while it is
    // loaded is what its author links, as in any program.
    let library = unsafe { unix::Library::open(Some(path), flags) }.map_err(refuse)?;
    // SAFETY: the symbol begins with the stamp of this version, whose layout is Library's.
    let entry: *const Library = unsafe { *library.get::<*const Library>(SYMBOL.as_bytes()).map_err(refuse)? };
    // Never closed: see Container.
    std::mem::forget(library);
    // SAFETY: a static of a library that stays in memory, of this type by its stamp.
    let entry = unsafe { &*entry };
    // The file may have been replaced since it was read.
    if *entry.stamp() != stamp::STAMP {
        return Err(ComponentError::NoEntryPoint { path: path.into() });
    }
    if !entry.shares_copy() {
        return Err(ComponentError::OtherCopy { path: path.into() });
    }
    Ok(entry)
}

impl std::fmt::Debug for Container {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Container").field("components", &self.loaded.len()).finish_non_exhaustive()
    }
}
