// SPDX-License-Identifier: MIT OR Apache-2.0
//! A node's parameters, which any thread may declare and set.

use super::descriptor::ParameterDescriptor;
use super::parameter::Parameter;
use super::reader::{Feed, ParameterReader};
use super::ros_params::RosParams;
use crate::error::Result;
#[cfg(feature = "rosgraph_msgs")]
use crate::time::TimeSource;
use crate::values::{
    Changes, ParameterError, ParameterEvents, ParameterType, ParameterValue, ParameterVariant,
    WrongParameterType,
};
use indexmap::IndexMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::thread::ThreadId;

/// The parameter that every node with a clock has.
const USE_SIM_TIME: &str = "use_sim_time";

/// By name, in the order in which they were given or declared.
pub(crate) type ParameterMap = IndexMap<String, Parameter>;

/// A handle to a node's parameters, for any thread. A clone refers to the same parameters.
///
/// A node that declares parameters refuses to set others; on a node that declares none, any parameter can be
/// set.
#[derive(Clone)]
pub struct Parameters {
    shared: Arc<ParameterStore>,
}

struct ParameterStore {
    /// Held only for a read or a write, so that callbacks that check a change can read.
    map: Arc<Mutex<ParameterMap>>,
    /// Held during a whole change, so that changes are made one after the other.
    hooks: Mutex<Hooks>,
    /// Held only for a read or a write, so that callbacks may add and end callbacks.
    checks: Mutex<Checks>,
    /// The thread in which callbacks check a change, or are notified of it.
    changing: Mutex<Option<ThreadId>>,
}

type Check = Arc<dyn Fn(&[(String, ParameterValue)]) -> Result<(), String> + Send + Sync>;
type SharedStruct = Arc<Mutex<dyn RosParams + Send>>;

#[derive(Default)]
struct Checks {
    list: Vec<(u64, Check)>,
    next: u64,
}

struct Hooks {
    feeds: Vec<(String, Feed)>,
    structs: Vec<OfStruct>,
    events: ParameterEvents,
}

/// A struct, and the names of the parameters that are its fields.
struct OfStruct {
    fields: Vec<String>,
    value: SharedStruct,
}

/// A callback that checks changes; dropping this ends it.
#[must_use = "dropping it ends the callback"]
pub struct OnSetParameters {
    shared: Weak<ParameterStore>,
    number: u64,
}

fn lock<T: ?Sized>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Parameters {
    pub(crate) fn new(map: ParameterMap, events: ParameterEvents) -> Parameters {
        let map = Arc::new(Mutex::new(map));
        let hooks = Hooks { feeds: Vec::new(), structs: Vec::new(), events };
        let shared = ParameterStore {
            map,
            hooks: Mutex::new(hooks),
            checks: Mutex::default(),
            changing: Mutex::new(None),
        };
        Parameters { shared: Arc::new(shared) }
    }

    /// The map itself. What is put there directly is neither checked nor seen by readers.
    pub(crate) fn map(&self) -> Arc<Mutex<ParameterMap>> {
        self.shared.map.clone()
    }

    /// Declares a parameter. It starts with the value from the command line or a parameter file, else with `default`.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`ParameterError`]: already declared; a given value is of another type, out of range, or refused.
    pub fn declare<T: ParameterVariant>(
        &self,
        name: &str,
        default: T,
        descriptor: ParameterDescriptor,
    ) -> Result<ParameterReader<T>> {
        let hooks = &mut *self.hooks(name)?;
        if name.is_empty() {
            return Err(ParameterError::InvalidName { name: name.into(), reason: "it is empty" }.into());
        }
        let default: ParameterValue = default.into();
        let given = match lock(&self.shared.map).get(name) {
            Some(parameter) if parameter.declared => {
                return Err(ParameterError::AlreadyDeclared { name: name.into() }.into());
            }
            Some(parameter) => parameter.value.clone().of_type(default.parameter_type()),
            None => default.clone(),
        };
        let any_type = descriptor.dynamic_typing || default == ParameterValue::NotSet;
        if !any_type && given.parameter_type() != default.parameter_type() {
            return Err(ParameterError::wrong_type(name, default.parameter_type(), &given).into());
        }
        descriptor.check(name, &given)?;
        let change = [(name.to_owned(), given.clone())];
        self.run_checks(&change)?;
        let first = T::from_value(given.clone()).map_err(|_| {
            // Dynamically typed, and given with another type than the default's, which is the reader's type.
            ParameterError::wrong_type(name, default.parameter_type(), &given)
        })?;
        let parameter = Parameter { value: given, descriptor, declared: true };
        lock(&self.shared.map).insert(name.to_owned(), parameter);
        hooks.events.publish(&Changes { new: &change, ..Changes::default() });
        Ok(hooks.reader(name, first))
    }

    /// Declares `use_sim_time`, which every node has and follows, and gives its value.
    #[cfg(feature = "rosgraph_msgs")]
    pub(crate) fn declare_use_sim_time(&self, source: &TimeSource) -> Result<bool> {
        let given = lock(&self.shared.map).get(USE_SIM_TIME).map(|parameter| parameter.value.clone());
        let value = given.unwrap_or(ParameterValue::Bool(false));
        let ParameterValue::Bool(enabled) = value else {
            return Err(ParameterError::wrong_type(USE_SIM_TIME, ParameterType::Bool, &value).into());
        };
        let descriptor =
            ParameterDescriptor::new().description("Whether the ROS clock shows the time of /clock");
        let parameter = Parameter { value, descriptor, declared: true };
        lock(&self.shared.map).insert(USE_SIM_TIME.into(), parameter);
        let source = source.clone();
        let follow = move |value: Option<&ParameterValue>| {
            let enable = |value: &ParameterValue| source.set_enabled(*value == ParameterValue::Bool(true));
            if let Some(Err(error)) = value.map(enable) {
                tracing::warn!("the clock shows the time that it has shown: {error}");
            }
            true
        };
        lock(&self.shared.hooks).feeds.push((USE_SIM_TIME.into(), Box::new(follow)));
        Ok(enabled)
    }

    /// Another reader of a parameter.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`ParameterError`]: not declared, another type.
    pub fn reader<T: ParameterVariant>(&self, name: &str) -> Result<ParameterReader<T>> {
        let hooks = &mut *self.hooks(name)?;
        let value = self.value(hooks, name);
        let value = value.ok_or_else(|| ParameterError::NotDeclared { name: name.into() })?;
        let wrong = |_| ParameterError::wrong_type(name, T::TYPE.unwrap_or_default(), &value);
        let first = T::from_value(value.clone()).map_err(wrong)?;
        Ok(hooks.reader(name, first))
    }

    /// A parameter's value, declared or given. An `Option` is `None` if there is none.
    ///
    /// # Errors
    /// [`ParameterError`]: there is none, or it is of another type.
    pub fn get<T>(&self, name: &str) -> Result<T>
    where
        ParameterValue: TryInto<T, Error = WrongParameterType>,
    {
        // Not through `hooks`, so that a callback that checks a change may read.
        let value = lock(&self.shared.map).get(name).map(|parameter| parameter.value.clone());
        let known = value.clone().unwrap_or_default();
        known.try_into().map_err(|error| {
            let name = name.to_owned();
            match value {
                None => ParameterError::NotDeclared { name }.into(),
                Some(value) => ParameterError::WrongType {
                    name,
                    expected: error.expected_type_name,
                    actual: error.actual_type_name,
                    value,
                    hint: None,
                }
                .into(),
            }
        })
    }

    /// Sets a parameter.
    ///
    /// # Real-time
    /// Not for real-time callbacks: takes locks, allocates.
    ///
    /// # Errors
    /// [`ParameterError`]: not declared, another type, out of range, read-only, refused by a callback.
    pub fn set(&self, name: &str, value: impl Into<ParameterValue>) -> Result<()> {
        self.set_atomically([(name.to_owned(), value.into())])
    }

    /// Sets all these parameters, or none if one is refused.
    ///
    /// # Real-time
    /// Not for real-time callbacks: takes locks, allocates.
    ///
    /// # Errors
    /// As [`set`](Self::set), for the first one that is refused.
    pub fn set_atomically(&self, values: impl IntoIterator<Item = (String, ParameterValue)>) -> Result<()> {
        self.change(values.into_iter().collect()).map(drop)
    }

    /// Sets all or none. Returns the parameters with a new value.
    pub(super) fn change(
        &self,
        mut values: Vec<(String, ParameterValue)>,
    ) -> Result<Vec<(String, ParameterValue)>> {
        let Some((first, _)) = values.first() else { return Ok(Vec::new()) };
        let hooks = &mut *self.hooks(first)?;
        let (mut new, mut deleted) = (Vec::new(), Vec::new());
        {
            let map = lock(&self.shared.map);
            let mut others = map.iter().filter(|(name, _)| *name != USE_SIM_TIME);
            let takes_any = !others.any(|(_, parameter)| parameter.declared);
            for (index, (name, value)) in values.iter_mut().enumerate() {
                match map.get(name) {
                    Some(parameter) if parameter.declared || takes_any => {
                        *value = std::mem::take(value).of_type(parameter.value.parameter_type());
                        parameter.check(name, value)?;
                        if parameter.is_ended_by(value) {
                            deleted.push(index);
                        }
                    }
                    None if takes_any && *value != ParameterValue::NotSet => new.push(index),
                    // A value that was given, but not declared, counts when the parameter is declared later.
                    _ => return Err(ParameterError::NotDeclared { name: name.clone() }.into()),
                }
            }
        }
        for of_struct in &hooks.structs {
            let (mut fields, checked) = (of_struct.among(&values), lock(&of_struct.value));
            fields.try_for_each(|(name, value)| checked.check_parameter(name, value))?;
        }
        self.run_checks(&values)?;
        // Fields that the program has changed to another value, which readers may have.
        let mut moved = Vec::new();
        for of_struct in &hooks.structs {
            let (mut fields, mut set) = (of_struct.among(&values), lock(&of_struct.value));
            fields.try_for_each(|(name, value)| {
                if set.get_parameter(name).is_ok_and(|now| now != *value) {
                    moved.push(name.as_str());
                }
                set.set_parameter(name, value)
            })?;
        }
        let mut changed = Vec::new();
        {
            let mut map = lock(&self.shared.map);
            for (name, value) in &values {
                let parameter = match map.get_mut(name) {
                    Some(parameter) => parameter,
                    None => map.entry(name.clone()).or_insert_with(Parameter::empty),
                };
                if parameter.value != *value || moved.contains(&name.as_str()) {
                    parameter.value.clone_from(value);
                    changed.push((name.clone(), value.clone()));
                }
            }
            // Except parameters that a later value of the same change has set again.
            for (name, _) in deleted.iter().map(|index| &values[*index]) {
                if map.get(name).is_some_and(|parameter| parameter.value == ParameterValue::NotSet) {
                    map.shift_remove(name);
                }
            }
        }
        {
            let _changing = self.changing();
            hooks.feed(&changed);
        }
        if hooks.events.are_wanted() {
            let (mut of_new, mut of_changed, mut of_deleted) = (Vec::new(), Vec::new(), Vec::new());
            for (index, value) in values.into_iter().enumerate() {
                match index {
                    // Sorted, because they were found in this order.
                    _ if new.binary_search(&index).is_ok() => of_new.push(value),
                    _ if deleted.binary_search(&index).is_ok() => of_deleted.push(value),
                    _ => of_changed.push(value),
                }
            }
            hooks.events.publish(&Changes { new: &of_new, changed: &of_changed, deleted: &of_deleted });
        }
        Ok(changed)
    }

    /// Removes a parameter; its readers keep the last value. As in ROS 2, only a parameter with dynamic typing can be removed,
    /// because readers rely on other parameters.
    ///
    /// # Errors
    /// [`ParameterError`]: not declared, read-only, of one type.
    pub fn undeclare(&self, name: &str) -> Result<()> {
        let hooks = &mut *self.hooks(name)?;
        let mut map = lock(&self.shared.map);
        let name = name.to_owned();
        match map.get(&name) {
            None => return Err(ParameterError::NotDeclared { name }.into()),
            Some(parameter) if parameter.descriptor.read_only => {
                return Err(ParameterError::ReadOnly { name }.into());
            }
            Some(parameter) if parameter.declared && !parameter.descriptor.dynamic_typing => {
                return Err(ParameterError::StaticType { name }.into());
            }
            Some(_) => {}
        }
        let former = map.shift_remove(&name).map(|parameter| parameter.value).unwrap_or_default();
        drop(map);
        hooks.feeds.retain(|(of, _)| *of != name);
        hooks.events.publish(&Changes { deleted: &[(name, former)], ..Changes::default() });
        Ok(())
    }

    /// Whether there is such a parameter, declared or given.
    pub fn has(&self, name: &str) -> bool {
        lock(&self.shared.map).contains_key(name)
    }

    /// The description of a parameter, and its present type.
    ///
    /// # Errors
    /// [`ParameterError::NotDeclared`].
    pub fn describe(&self, name: &str) -> Result<(ParameterType, ParameterDescriptor)> {
        let map = lock(&self.shared.map);
        let parameter = map.get(name).ok_or_else(|| ParameterError::NotDeclared { name: name.into() })?;
        Ok((parameter.value.parameter_type(), parameter.descriptor.clone()))
    }

    /// The names of all parameters, in the order in which they were given a value or declared.
    pub fn names(&self) -> Vec<String> {
        lock(&self.shared.map).keys().cloned().collect()
    }

    /// Calls `check` before parameters are declared or set; if it returns a reason, none of them is declared
    /// or set.
    ///
    /// It may read parameters, and add and end callbacks, but not set parameters. If it panics, the panic propagates to the caller
    /// that sets the parameters; nothing is set then.
    pub fn on_set(
        &self,
        check: impl Fn(&[(String, ParameterValue)]) -> Result<(), String> + Send + Sync + 'static,
    ) -> OnSetParameters {
        let mut checks = lock(&self.shared.checks);
        let number = checks.next;
        checks.next += 1;
        checks.list.push((number, Arc::new(check)));
        OnSetParameters { shared: Arc::downgrade(&self.shared), number }
    }

    /// Declares the fields of a struct as parameters. From now on, setting such a parameter changes the struct, and readers get
    /// values that were changed in the struct. Setting parameters, also by service, locks the struct: do not set any parameter
    /// while you hold its lock.
    ///
    /// # Errors
    /// [`ParameterError`]: already declared, a given value does not fit, or a callback refuses it; nothing is declared then.
    pub fn declare_struct(&self, of_struct: Arc<Mutex<dyn RosParams + Send>>) -> Result<()> {
        let mut hooks = self.hooks("")?;
        // The values before given ones are set, for a refusal.
        let mut present = IndexMap::new();
        lock(&of_struct).register_parameters("", None, &mut present)?;
        let before = lock(&self.shared.map).clone();
        let mut after = before.clone();
        let mut fill = || -> Result<Vec<_>> {
            lock(&of_struct).register_parameters("", None, &mut after)?;
            let is_new = |name: &str| before.get(name).is_none_or(|parameter| !parameter.declared);
            let mut fields = Vec::new();
            for (name, Parameter { value, descriptor, declared }) in &after {
                if *declared && is_new(name) {
                    descriptor.check(name, value)?;
                    fields.push((name.clone(), value.clone()));
                }
            }
            self.run_checks(&fields)?;
            Ok(fields)
        };
        let filled = fill();
        if filled.is_err() {
            let mut of_struct = lock(&of_struct);
            for (name, parameter) in &present {
                of_struct.set_parameter(name, &parameter.value)?;
            }
        }
        let fields = filled?;
        *lock(&self.shared.map) = after;
        hooks.events.publish(&Changes { new: &fields, ..Changes::default() });
        let fields = fields.into_iter().map(|(name, _)| name).collect();
        hooks.structs.push(OfStruct { fields, value: of_struct });
        Ok(())
    }

    /// The current values of these parameters; fields of a struct have the struct's values.
    #[cfg(feature = "rcl_interfaces")]
    pub(super) fn values(&self, names: &[String]) -> Vec<ParameterValue> {
        let hooks = lock(&self.shared.hooks);
        names.iter().map(|name| self.value(&hooks, name).unwrap_or_default()).collect()
    }

    fn value(&self, hooks: &Hooks, name: &str) -> Option<ParameterValue> {
        let of_struct =
            hooks.structs.iter().find(|of_struct| of_struct.fields.iter().any(|field| field == name));
        let in_struct = of_struct.and_then(|of_struct| lock(&of_struct.value).get_parameter(name).ok());
        in_struct.or_else(|| lock(&self.shared.map).get(name).map(|parameter| parameter.value.clone()))
    }

    /// Locks the hooks for a change of `name`; an error in a callback of a change.
    fn hooks(&self, name: &str) -> Result<MutexGuard<'_, Hooks>> {
        if *lock(&self.shared.changing) == Some(std::thread::current().id()) {
            return Err(ParameterError::InCallback { name: name.to_owned() }.into());
        }
        Ok(lock(&self.shared.hooks))
    }

    fn run_checks(&self, values: &[(String, ParameterValue)]) -> Result<(), ParameterError> {
        let checks: Vec<Check> = {
            let checks = lock(&self.shared.checks);
            checks.list.iter().map(|(_, check)| check.clone()).collect()
        };
        let _changing = self.changing();
        let refused = checks.iter().find_map(|check| check(values).err());
        refused.map_or(Ok(()), |reason| Err(ParameterError::Rejected { reason }))
    }

    /// Marks this thread as the one in which callbacks run, until the result is dropped, also by a panic.
    fn changing(&self) -> Changing<'_> {
        *lock(&self.shared.changing) = Some(std::thread::current().id());
        Changing(&self.shared.changing)
    }
}

struct Changing<'s>(&'s Mutex<Option<ThreadId>>);

impl Drop for Changing<'_> {
    fn drop(&mut self) {
        *lock(self.0) = None;
    }
}

impl OfStruct {
    fn among<'v>(
        &self,
        values: &'v [(String, ParameterValue)],
    ) -> impl Iterator<Item = &'v (String, ParameterValue)> {
        values.iter().filter(|(name, _)| self.fields.contains(name))
    }
}

impl Hooks {
    fn reader<T: ParameterVariant>(&mut self, name: &str, first: T) -> ParameterReader<T> {
        // Removes feeds of dropped readers, whose parameter may never be set again.
        self.feeds.retain_mut(|(_, feed)| feed(None));
        let (reader, feed) = ParameterReader::new(name, first);
        self.feeds.push((name.to_owned(), feed));
        reader
    }

    fn feed(&mut self, changed: &[(String, ParameterValue)]) {
        self.feeds.retain_mut(|(name, feed)| {
            let mut to_it = changed.iter().filter(|(of, _)| of == name);
            to_it.all(|(_, value)| feed(Some(value)))
        });
    }
}

impl Drop for OnSetParameters {
    fn drop(&mut self) {
        if let Some(shared) = self.shared.upgrade() {
            let ended = {
                let mut checks = lock(&shared.checks);
                let index = checks.list.iter().position(|(number, _)| *number == self.number);
                index.map(|index| checks.list.remove(index))
            };
            // Dropped without the lock, because it may own another callback.
            drop(ended);
        }
    }
}

tautline_rt::debug_fields!(Parameters, |this| names = this.names());

tautline_rt::debug_fields!(OnSetParameters);
