// SPDX-License-Identifier: MIT OR Apache-2.0
//! A node's parameters, to be declared and set from any thread.

use super::events::{Change, ParameterEvents};
use super::reader::Feed;
use super::{
    Parameter, ParameterDescriptor, ParameterError, ParameterReader, ParameterType, ParameterValue,
    ParameterVariant, RosParams, WrongParameterType,
};
use crate::error::Result;
#[cfg(feature = "rosgraph_msgs")]
use crate::time::TimeSource;
use indexmap::IndexMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::thread::ThreadId;

/// Every node has it, if it has clocks.
const USE_SIM_TIME: &str = "use_sim_time";

/// By name, in the order in which they were given or declared.
pub(crate) type ParameterMap = IndexMap<String, Parameter>;

/// A node's parameters: a handle for any thread. A clone is of the same parameters.
///
/// A node that declares parameters refuses to set others; one that declares none lets any be set, as one of r2r's does.
#[derive(Clone)]
pub struct Parameters {
    shared: Arc<Shared>,
}

struct Shared {
    /// Held only to look or to put, so that those that check a change can look.
    map: Arc<Mutex<ParameterMap>>,
    /// Held during all of a change: one after the other.
    hooks: Mutex<Hooks>,
    /// The thread in which callbacks check a change, or follow it.
    changing: Mutex<Option<ThreadId>>,
}

type Check = Arc<dyn Fn(&[(String, ParameterValue)]) -> std::result::Result<(), String> + Send + Sync>;
type SharedStruct = Arc<Mutex<dyn RosParams + Send>>;

struct Hooks {
    checks: Vec<(u64, Check)>,
    next_check: u64,
    feeds: Vec<(String, Feed)>,
    of_struct: Option<OfStruct>,
    events: ParameterEvents,
}

/// A struct, and which parameters are its fields.
struct OfStruct {
    fields: Vec<String>,
    value: SharedStruct,
}

/// A callback that checks changes; dropping this ends it.
#[must_use = "dropping it ends the callback"]
pub struct OnSetParameters {
    shared: Weak<Shared>,
    number: u64,
}

fn lock<T: ?Sized>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Parameters {
    pub(crate) fn new(map: Arc<Mutex<ParameterMap>>, events: ParameterEvents) -> Parameters {
        let hooks = Hooks { checks: Vec::new(), next_check: 0, feeds: Vec::new(), of_struct: None, events };
        let shared = Shared { map, hooks: Mutex::new(hooks), changing: Mutex::new(None) };
        Parameters { shared: Arc::new(shared) }
    }

    /// Declares a parameter. It starts with the value from the command line or a parameter file, else with `default`.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`ParameterError`]: declared already; a value that was given is of another type, or out of range, or refused.
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
        self.run_checks(hooks, &change)?;
        let first = T::from_value(given.clone()).map_err(|_| {
            // Dynamically typed, and given as another type than that of the default, which the reader is of.
            ParameterError::wrong_type(name, default.parameter_type(), &given)
        })?;
        let parameter = Parameter { value: given, descriptor, declared: true };
        lock(&self.shared.map).insert(name.to_owned(), parameter);
        hooks.events.publish(Change::New, &change);
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
        let follow = move |value: &ParameterValue| {
            if let Err(error) = source.set_enabled(*value == ParameterValue::Bool(true)) {
                tracing::warn!("the clock shows the time that it has shown: {error}");
            }
            true
        };
        lock(&self.shared.hooks).feeds.push((USE_SIM_TIME.into(), Box::new(follow)));
        Ok(enabled)
    }

    /// A further reader of a parameter.
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
        // Not through `hooks`: a callback that checks a change may look.
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

    /// Sets all these parameters or, if one is refused, none.
    ///
    /// # Real-time
    /// Not for real-time callbacks: takes locks, allocates.
    ///
    /// # Errors
    /// As [`set`](Self::set), for the first one that is refused.
    pub fn set_atomically(&self, values: impl IntoIterator<Item = (String, ParameterValue)>) -> Result<()> {
        self.change(values.into_iter().collect()).map(drop)
    }

    /// Sets all or none, and says which have another value now.
    pub(super) fn change(
        &self,
        mut values: Vec<(String, ParameterValue)>,
    ) -> Result<Vec<(String, ParameterValue)>> {
        let Some((first, _)) = values.first() else { return Ok(Vec::new()) };
        let hooks = &mut *self.hooks(first)?;
        let mut new = Vec::new();
        {
            let map = lock(&self.shared.map);
            let mut others = map.iter().filter(|(name, _)| *name != USE_SIM_TIME);
            let takes_any = !others.any(|(_, parameter)| parameter.declared);
            for (name, value) in &mut values {
                let Some(parameter) = map.get(name) else {
                    if !takes_any {
                        return Err(ParameterError::NotDeclared { name: name.clone() }.into());
                    }
                    new.push(name.clone());
                    continue;
                };
                *value = std::mem::take(value).of_type(parameter.value.parameter_type());
                parameter.check(name, value)?;
            }
        }
        if let Some(of_struct) = &hooks.of_struct {
            let (fields, checked) = (of_struct.among(&values), lock(&of_struct.value));
            fields.into_iter().try_for_each(|(name, value)| checked.check_parameter(name, value))?;
        }
        self.run_checks(hooks, &values)?;
        if let Some(of_struct) = &hooks.of_struct {
            let (fields, mut set) = (of_struct.among(&values), lock(&of_struct.value));
            fields.into_iter().try_for_each(|(name, value)| set.set_parameter(name, value))?;
        }
        let mut changed = Vec::new();
        {
            let mut map = lock(&self.shared.map);
            for (name, value) in &values {
                let parameter = map.entry(name.clone()).or_insert_with(Parameter::empty);
                if parameter.value != *value {
                    parameter.value = value.clone();
                    changed.push((name.clone(), value.clone()));
                }
            }
        }
        *lock(&self.shared.changing) = Some(std::thread::current().id());
        hooks.feed(&changed);
        *lock(&self.shared.changing) = None;
        let (new, old): (Vec<_>, Vec<_>) = values.into_iter().partition(|(name, _)| new.contains(name));
        hooks.events.publish(Change::New, &new);
        hooks.events.publish(Change::Changed, &old);
        Ok(changed)
    }

    /// Forgets a parameter; its readers keep the last value.
    ///
    /// # Errors
    /// [`ParameterError`]: not declared, read-only.
    pub fn undeclare(&self, name: &str) -> Result<()> {
        let hooks = &mut *self.hooks(name)?;
        let mut map = lock(&self.shared.map);
        let name = name.to_owned();
        match map.get(&name) {
            None => return Err(ParameterError::NotDeclared { name }.into()),
            Some(parameter) if parameter.descriptor.read_only => {
                return Err(ParameterError::ReadOnly { name }.into());
            }
            Some(_) => {}
        }
        let former = map.shift_remove(&name).map(|parameter| parameter.value).unwrap_or_default();
        drop(map);
        hooks.feeds.retain(|(of, _)| *of != name);
        hooks.events.publish(Change::Deleted, &[(name, former)]);
        Ok(())
    }

    /// Whether there is such a parameter, declared or given.
    pub fn has(&self, name: &str) -> bool {
        lock(&self.shared.map).contains_key(name)
    }

    /// What was said about a parameter, and its type now.
    ///
    /// # Errors
    /// [`ParameterError::NotDeclared`].
    pub fn describe(&self, name: &str) -> Result<(ParameterType, ParameterDescriptor)> {
        let map = lock(&self.shared.map);
        let parameter = map.get(name).ok_or_else(|| ParameterError::NotDeclared { name: name.into() })?;
        Ok((parameter.value.parameter_type(), parameter.descriptor.clone()))
    }

    /// The names of all parameters, in the order in which they were given or declared.
    pub fn names(&self) -> Vec<String> {
        lock(&self.shared.map).keys().cloned().collect()
    }

    /// Calls `check` before parameters are declared or set; if it gives a reason, none of them is.
    ///
    /// It may read parameters, and not set any.
    pub fn on_set(
        &self,
        check: impl Fn(&[(String, ParameterValue)]) -> std::result::Result<(), String> + Send + Sync + 'static,
    ) -> OnSetParameters {
        let mut hooks = lock(&self.shared.hooks);
        let number = hooks.next_check;
        hooks.next_check += 1;
        hooks.checks.push((number, Arc::new(check)));
        OnSetParameters { shared: Arc::downgrade(&self.shared), number }
    }

    /// Declares the fields of a struct. From now on it is changed with them, and what is changed in it is what others get.
    ///
    /// # Errors
    /// [`ParameterError`]: declared already, or a value that was given does not fit.
    pub fn declare_struct(&self, of_struct: Arc<Mutex<dyn RosParams + Send>>) -> Result<()> {
        let mut hooks = self.hooks("")?;
        let before = self.names();
        lock(&of_struct).register_parameters("", None, &mut lock(&self.shared.map))?;
        let map = lock(&self.shared.map);
        let new = map.iter().filter(|(name, _)| !before.contains(name));
        let new: Vec<_> = new.map(|(name, parameter)| (name.clone(), parameter.value.clone())).collect();
        drop(map);
        hooks.events.publish(Change::New, &new);
        let given = before.into_iter().filter(|name| lock(&of_struct).get_parameter(name).is_ok());
        let fields = given.chain(new.into_iter().map(|(name, _)| name)).collect();
        hooks.of_struct = Some(OfStruct { fields, value: of_struct });
        Ok(())
    }

    fn value(&self, hooks: &Hooks, name: &str) -> Option<ParameterValue> {
        let of_struct = hooks.of_struct.as_ref();
        let in_struct = of_struct.and_then(|of_struct| lock(&of_struct.value).get_parameter(name).ok());
        in_struct.or_else(|| lock(&self.shared.map).get(name).map(|parameter| parameter.value.clone()))
    }

    /// For a change of `name`.
    fn hooks(&self, name: &str) -> Result<MutexGuard<'_, Hooks>> {
        if *lock(&self.shared.changing) == Some(std::thread::current().id()) {
            return Err(ParameterError::InCallback { name: name.to_owned() }.into());
        }
        Ok(lock(&self.shared.hooks))
    }

    fn run_checks(
        &self,
        hooks: &Hooks,
        values: &[(String, ParameterValue)],
    ) -> std::result::Result<(), ParameterError> {
        *lock(&self.shared.changing) = Some(std::thread::current().id());
        let refused = hooks.checks.iter().find_map(|(_, check)| check(values).err());
        *lock(&self.shared.changing) = None;
        refused.map_or(Ok(()), |reason| Err(ParameterError::Rejected { reason }))
    }
}

impl OfStruct {
    fn among<'v>(&self, values: &'v [(String, ParameterValue)]) -> Vec<&'v (String, ParameterValue)> {
        values.iter().filter(|(name, _)| self.fields.contains(name)).collect()
    }
}

impl Hooks {
    fn reader<T: ParameterVariant>(&mut self, name: &str, first: T) -> ParameterReader<T> {
        let (reader, feed) = ParameterReader::new(name, first);
        self.feeds.push((name.to_owned(), feed));
        reader
    }

    fn feed(&mut self, changed: &[(String, ParameterValue)]) {
        self.feeds.retain_mut(|(name, feed)| {
            let mut to_it = changed.iter().filter(|(of, _)| of == name);
            to_it.all(|(_, value)| feed(value))
        });
    }
}

impl Drop for OnSetParameters {
    fn drop(&mut self) {
        if let Some(shared) = self.shared.upgrade() {
            lock(&shared.hooks).checks.retain(|(number, _)| *number != self.number);
        }
    }
}

impl std::fmt::Debug for Parameters {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Parameters").field("names", &self.names()).finish_non_exhaustive()
    }
}

impl std::fmt::Debug for OnSetParameters {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("OnSetParameters").finish_non_exhaustive()
    }
}
