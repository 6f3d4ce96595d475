// SPDX-License-Identifier: MIT OR Apache-2.0
//! Statistics of this process's callbacks, and their entries in the system file of `TAUT_SYSTEM`.

use crate::error::{Error, Result};
use crate::thread::{self, ThreadPlan};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;
use tautline_analysis::file::{CheckedCallback, Client};
use tautline_executor::{
    Admitted, CallbackOptions, ForeignCallback, ForeignExecutor, ProcessInfo, Realtime, StatisticsFile,
};
use tautline_rt::clock::monotonic_ns;
use tautline_system::{
    Admission, Gate, LoadedSystem, admission_of_environment, admit_callbacks, admit_system,
    core_time_of_environment, realtime_of_environment,
};
use tautline_transport::{History, Qos, Reliability};

/// Topics that ROS's client libraries subscribe to for a node.
const OF_EVERY_NODE: [&str; 2] = ["/parameter_events", "/clock"];
/// Topics for which client libraries have threads of their own.
const OF_OTHER_THREADS: [&str; 3] = ["/clock", "/tf", "/tf_static"];
/// Beginnings of names of nodes that client libraries create for another node.
const OF_HELPERS: [&str; 2] = ["transform_listener_impl_", "launch_ros_"];
/// Services that client libraries create for a node, below its name.
const SERVICES_OF_EVERY_NODE: [&str; 9] = [
    "describe_parameters",
    "get_logger_levels",
    "get_parameter_types",
    "get_parameters",
    "get_type_description",
    "list_parameters",
    "set_logger_levels",
    "set_parameters",
    "set_parameters_atomically",
];

/// The system file as this process has loaded it, if there is one, and this process's callback statistics.
pub(crate) struct System {
    domain: u32,
    /// `None` also if the file has no ROS callbacks of this host.
    file: Option<LoadedSystem>,
    /// The ROS callbacks of this host.
    callbacks: Vec<CheckedCallback>,
    /// The threads of these callbacks, each once; none with `TAUT_REALTIME=off`.
    threads: Vec<Option<Arc<ThreadPlan>>>,
    admission: Admission,
    /// `None`: it could not be created, and there is no file.
    statistics: Option<StatisticsFile>,
    overheads: Option<Overheads>,
    /// The shortest interval without the core that is recorded for a job, if any is.
    core_time: Option<Duration>,
    /// By name.
    made: Mutex<BTreeMap<String, Weak<ForeignCallback>>>,
}

/// A timer of ROS's, which an RMW recognises only by what it publishes.
pub(crate) struct Timer {
    measured: Arc<ForeignCallback>,
    thread: Option<Arc<ThreadPlan>>,
}

impl Timer {
    /// Records that the timer has published in this thread.
    ///
    /// # Real-time
    /// As [`govern`](thread::govern) and [`ForeignCallback::publish`].
    pub(crate) fn publish(&self) {
        if let Some(plan) = &self.thread {
            thread::govern_runner(plan);
        }
        self.measured.publish(monotonic_ns());
    }
}

/// Executors whose overheads are measured.
struct Overheads {
    /// Whether callbacks do nothing.
    is_alone: bool,
    /// By client library.
    executors: Mutex<BTreeMap<&'static str, Arc<ForeignExecutor>>>,
}

impl Overheads {
    /// `TAUT_OVERHEADS`.
    fn of_environment() -> Result<Option<Self>> {
        let is_alone = match tautline_system::environment("TAUT_OVERHEADS").as_deref() {
            None | Some("off") => return Ok(None),
            Some("on") => false,
            Some("empty") => true,
            Some(value) => {
                return Err(Error::other(format!(
                    "TAUT_OVERHEADS={value} is not understood: it may be 'on', 'empty' (for callbacks that do nothing) or 'off'"
                )));
            }
        };
        Ok(Some(Overheads { is_alone, executors: Mutex::default() }))
    }
}

/// The callbacks of a file that ROS 2's executors run on this host, with the names of their topics as ROS 2 states them.
fn of_ros(file: &LoadedSystem) -> impl Iterator<Item = CheckedCallback> {
    let callbacks = file.callbacks().filter(|callback| callback.entry.client != Client::Tautline).cloned();
    callbacks.map(|mut callback| {
        let topics = callback.entry.topics.iter_mut().chain(&mut callback.entry.publishes);
        topics.for_each(|topic| *topic = absolute(topic));
        callback
    })
}

/// A topic's name with its `/`, which a file may leave out; that of a service begins with what it is, such as `request:`.
fn absolute(topic: &str) -> String {
    if topic.starts_with('/') || topic.contains(':') { topic.to_owned() } else { format!("/{topic}") }
}

impl System {
    /// Loads the environment's system file. It is admitted together with what runs in the domain, which this process has joined.
    pub(crate) fn of_environment(domain: u32) -> Result<Self> {
        let path = std::env::var_os("TAUT_SYSTEM").filter(|path| !path.is_empty());
        let file = path.map(|path| Self::read(path.as_ref())).transpose()?.flatten();
        let callbacks: Vec<_> = file.iter().flat_map(of_ros).collect();
        // Read also without a file: an unusable value is an error.
        let (realtime, admission) = (realtime_of_environment()?, admission_of_environment(true)?);
        let is_governed = file.is_some() && realtime == Realtime::Required;
        let admission = if is_governed { admission } else { Admission::Off };
        let (_gate, admitted) = match &file {
            Some(file) if admission != Admission::Off => {
                let (gate, admitted) = admit_system(domain, admission, file)?;
                (Some(gate), admitted)
            }
            _ => (None, Admitted::Unchecked),
        };
        let highest = callbacks.iter().map(|callback| callback.entry.priority).max().unwrap_or(1);
        // Without a file the program sets its priorities itself, if it may.
        let realtime =
            (file.is_none() || is_governed) && tautline_rt::permission::realtime_permitted(highest).is_ok();
        let mut about = ProcessInfo { realtime, admitted, ..ProcessInfo::of_this() };
        if let Some(file) = &file {
            file.describe(&mut about);
        }
        let threads = if is_governed { plans(&callbacks) } else { vec![None; callbacks.len()] };
        let statistics = match StatisticsFile::create(&StatisticsFile::prefix(domain), &about) {
            Ok(made) => Some(made),
            Err(error) if file.is_some() => {
                return Err(Error::other(format!("statistics in /dev/shm: {error}")));
            }
            Err(error) => {
                tracing::warn!("`taut top` will not show this process's callbacks: /dev/shm: {error}");
                None
            }
        };
        let (made, overheads) = (Mutex::default(), Overheads::of_environment()?);
        let core_time = core_time_of_environment()?;
        Ok(System { domain, file, callbacks, threads, admission, statistics, overheads, core_time, made })
    }

    /// A system file; `None` if it has no ROS callbacks of this host.
    fn read(path: &Path) -> Result<Option<LoadedSystem>> {
        let host = tautline_system::environment("TAUT_HOST");
        let file = LoadedSystem::read(path, host.as_deref())
            .map_err(|error| Error::other(format!("TAUT_SYSTEM: {error}")))?;
        if file.callbacks().any(|callback| callback.entry.client != Client::Tautline) {
            return Ok(Some(file));
        }
        let (path, host) = (path.display(), &file.host);
        tracing::warn!(
            "TAUT_SYSTEM: `{path}` has no callback of host `{host}` whose node has `client = \"rclcpp\"` or \"rclpy\""
        );
        Ok(None)
    }

    /// Whether processor time of callbacks is measured, which costs a system call for each, or for several in a row.
    pub(crate) fn measures_execution(&self) -> bool {
        self.file.is_some() || self.overheads.is_some()
    }

    /// The record of the executor's overhead with the callback of `node` for messages of `topic`; `None` if it is not measured.
    pub(crate) fn executor(&self, node: &str, topic: &str) -> Result<Option<Arc<ForeignExecutor>>> {
        let (Some(overheads), Some(statistics)) = (&self.overheads, &self.statistics) else {
            return Ok(None);
        };
        let client = self.entry(node, topic).map(|index| self.callbacks[index].entry.client);
        let is_python = || ProcessInfo::of_this().program.starts_with("python");
        let library = match client {
            Some(Client::Rclpy) => "rclpy",
            None if is_python() => "rclpy",
            _ => "rclcpp",
        };
        let mut executors = overheads.executors.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(executor) = executors.get(library) {
            return Ok(Some(executor.clone()));
        }
        let executor = ForeignExecutor::new(statistics, library, overheads.is_alone)
            .map_err(|error| Error::other(format!("statistics of {library}'s executor: {error}")))?;
        Ok(Some(executors.entry(library).or_insert(Arc::new(executor)).clone()))
    }

    /// The index of the file's entry for the callback of `node`, a full name, for messages of `topic`.
    fn entry(&self, node: &str, topic: &str) -> Option<usize> {
        let short = node.rsplit('/').next().unwrap_or(node);
        let of = |name: &str| {
            let is_it = |callback: &CheckedCallback| {
                callback.entry.node == name && callback.entry.topics.iter().any(|of| of == topic)
            };
            self.callbacks.iter().position(is_it)
        };
        of(node).or_else(|| of(short))
    }

    /// The thread of a callback, if the callback or its node's timers are in the file, and its rank, if the thread runs the highest first.
    pub(crate) fn place(&self, node: &str, topic: &str) -> (Option<Arc<ThreadPlan>>, Option<u8>) {
        match self.entry(node, topic) {
            Some(index) => (self.threads[index].clone(), self.callbacks[index].entry.rank),
            None if OF_OTHER_THREADS.contains(&topic) => (None, None),
            None => (self.thread_of_timers(node).cloned(), None),
        }
    }

    /// The thread of `node`, a full name, if the file has only timers of it, all in this thread: a thread that waits for any endpoint of
    /// the node, except [`OF_OTHER_THREADS`], runs them.
    fn thread_of_timers(&self, node: &str) -> Option<&Arc<ThreadPlan>> {
        let all = || self.callbacks.iter().zip(&self.threads).filter(|(of, _)| Self::is_of(of, node));
        let (first, thread) = all().next()?;
        let is_alike =
            |of: &CheckedCallback| of.entry.topics.is_empty() && of.entry.thread == first.entry.thread;
        thread.as_ref().filter(|_| all().all(|(of, _)| is_alike(of)))
    }

    /// Warns of, or refuses, a callback that the file does not list although it lists the node: its execution time is in no bound.
    ///
    /// # Errors
    /// The file says that it is refused.
    fn check_callback_is_listed(&self, node: &str, topic: &str) -> Result {
        let is_known = || self.callbacks.iter().any(|callback| Self::is_of(callback, node));
        let own =
            topic.strip_prefix("request:").and_then(|service| service.strip_prefix(node)?.strip_prefix('/'));
        let is_usual =
            OF_EVERY_NODE.contains(&topic) || own.is_some_and(|name| SERVICES_OF_EVERY_NODE.contains(&name));
        if is_usual || !self.is_governing() || !is_known() {
            return Ok(());
        }
        self.warn_or_refuse(&format!(
            "the system file has no callback of node `{node}` with `topic = \"{topic}\"`: the bounds of callbacks whose executor also runs \
             that one do not hold; add it to the file, or give it an executor of its own"
        ))
    }

    /// Warns of what the file does not list, or refuses it, as the file says.
    fn warn_or_refuse(&self, text: &str) -> Result {
        if let Some(file) = self.file.as_ref().filter(|file| file.refuses_unlisted) {
            let host = &file.host;
            return Err(Error::other(format!(
                "{text}; host `{host}` of the file has `unlisted = \"refuse\"`"
            )));
        }
        tracing::warn!("{text}");
        Ok(())
    }

    /// Sets the depth of a reliable subscription's keep-last queue to that of the file, if stated. Logs a warning if a keep-last queue is
    /// shorter than the analysis needs.
    pub(crate) fn set_depth(&self, node: &str, topic: &str, qos: &mut Qos) {
        let (Some(file), Some(index)) = (&self.file, self.entry(node, topic)) else { return };
        if qos.history != History::KeepLast {
            return;
        }
        let is_set = qos.reliability == Reliability::Reliable;
        let callback = &self.callbacks[index];
        let (name, capacity) = (&callback.entry.name, callback.capacity.map(|capacity| capacity.max(1)));
        let stated = file.file.topics().iter().find(|of| absolute(&of.name) == topic);
        let number = stated.and_then(|of| usize::try_from(of.depth?).ok());
        let wanted = number.or_else(|| capacity.filter(|_| stated.is_some_and(|of| of.is_auto)));
        if let Some(depth) = wanted.filter(|depth| is_set && *depth != qos.depth) {
            tracing::info!(
                "callback `{name}`: `{topic}` has depth {depth}, as the system file says, not {}",
                qos.depth
            );
            qos.depth = depth;
        }
        if let Some(capacity) = capacity.filter(|capacity| *capacity > qos.depth) {
            let fix = if is_set { "`depth = \"auto\"` for the topic in the system file, or " } else { "" };
            tracing::warn!(
                "callback `{name}`: `{topic}` has depth {}, but {capacity} messages may wait: set {fix}depth {capacity} in the node",
                qos.depth
            );
        }
    }

    /// Checks a callback of the file before it is created: that its thread may have its priority, and that the domain admits it.
    fn admit(&self, plan: &ThreadPlan, name: &str) -> Result<Option<Gate>> {
        plan.check_permission()?;
        let Some(file) = self.file.as_ref().filter(|_| self.admission != Admission::Off) else {
            return Ok(None);
        };
        let options = file.options(name)?;
        let (gate, admitted) =
            admit_callbacks(self.domain, self.admission, Some(file), &options, std::iter::once(&options))?;
        if let (Admitted::Forced(_), Some(statistics)) = (&admitted, &self.statistics) {
            statistics.set_admitted(&admitted);
        }
        Ok(Some(gate))
    }

    /// Whether threads get the priority and core that the file states.
    pub(crate) fn is_governing(&self) -> bool {
        self.threads.iter().any(Option::is_some)
    }

    /// Whether a callback belongs to `node`, a full name.
    fn is_of(callback: &CheckedCallback, node: &str) -> bool {
        let short = node.rsplit('/').next().unwrap_or(node);
        [node, short].contains(&callback.entry.node.as_str())
    }

    /// The callbacks of the file that publish on `topic` in `node`, a full name.
    fn publishers<'s>(&'s self, node: &'s str, topic: &'s str) -> impl Iterator<Item = usize> {
        let publishes = move |callback: &CheckedCallback| {
            Self::is_of(callback, node) && callback.entry.publishes.iter().any(|of| of == topic)
        };
        self.callbacks.iter().enumerate().filter(move |(_, of)| publishes(of)).map(|(index, _)| index)
    }

    /// Whether a callback is a timer that publishes `topic` first, as the only one in `node`, a full name: an RMW sees nothing else of it.
    fn identifies(&self, index: usize, node: &str, topic: &str) -> bool {
        let entry = &self.callbacks[index].entry;
        let is_first = entry.topics.is_empty() && entry.publishes.first().is_some_and(|of| of == topic);
        is_first && self.publishers(node, topic).eq([index])
    }

    /// The timer of the file that is recognised by the messages of `node`, a full name, on `topic`.
    pub(crate) fn timer(&self, node: &str, topic: &str) -> Result<Option<Timer>> {
        let (Some(file), Some(statistics)) = (&self.file, &self.statistics) else { return Ok(None) };
        let Some(index) = self.publishers(node, topic).find(|index| self.identifies(*index, node, topic))
        else {
            return Ok(None);
        };
        let thread = self.threads[index].clone();
        let options = file.options(&self.callbacks[index].entry.name)?;
        // Without a thread of the file it is only measured.
        let policy = thread.as_ref().map_or(CallbackOptions::other().policy, |_| options.policy);
        let options = CallbackOptions { policy, ..options }.execution_time(false);
        let measured = self.find_or_create(&options.name, || {
            let _gate = thread.as_ref().map(|plan| self.admit(plan, &options.name)).transpose()?;
            ForeignCallback::by_publications(statistics, &options)
                .map_err(|error| unshared(&options.name, &error))
        })?;
        Ok(Some(Timer { measured, thread }))
    }

    /// Warns of, or refuses, what the file lacks for `node`, a full name: the whole node, or how to recognise threads that run only timers.
    ///
    /// # Errors
    /// The file says that a node which it does not list is refused.
    pub(crate) fn check_node(&self, node: &str) -> Result {
        if self.is_governing() && !self.callbacks.iter().any(|callback| Self::is_of(callback, node)) {
            return self.check_node_is_listed(node);
        }
        if self.thread_of_timers(node).is_some() {
            return Ok(());
        }
        let threads = self.callbacks.iter().zip(&self.threads).enumerate();
        for (index, (callback, thread)) in threads {
            let (entry, Some(thread)) = (&callback.entry, thread) else { continue };
            let is_told = |(index, of): (usize, &CheckedCallback)| {
                let topic = of.entry.publishes.first();
                of.entry.thread == entry.thread
                    && (!of.entry.topics.is_empty()
                        || topic.is_some_and(|topic| self.identifies(index, node, topic)))
            };
            let is_first = self.callbacks[..index].iter().all(|of| of.entry.thread != entry.thread);
            if is_first && Self::is_of(callback, node) && !self.callbacks.iter().enumerate().any(is_told) {
                tracing::warn!(
                    "thread '{}' of the system file runs timers alone, and an RMW sees none of them: give it SCHED_FIFO {} and core {} in the \
                     node, or state in the file what a timer `publishes`, alone in its node",
                    thread.name,
                    thread.priority,
                    callback.core
                );
            }
        }
        Ok(())
    }

    /// Warns of, or refuses, a node that the file does not list, unless its name says that it helps another one or a tool.
    ///
    /// # Errors
    /// The file says that it is refused.
    fn check_node_is_listed(&self, node: &str) -> Result {
        let name = node.rsplit('/').next().unwrap_or(node);
        if name.starts_with('_') || OF_HELPERS.iter().any(|prefix| name.starts_with(prefix)) {
            return Ok(());
        }
        let mut all = self.file.iter().flat_map(LoadedSystem::callbacks);
        if let Some(callback) = all.find(|callback| Self::is_of(callback, node)) {
            return self.warn_or_refuse(&format!(
                "node `{node}` runs in an executor of ROS, but callback `{}` of the system file is one of Tautline: nothing governs its threads; \
                 state `client = \"rclcpp\"` or \"rclpy\" for its callbacks",
                callback.entry.name
            ));
        }
        let known: BTreeSet<&str> = self.callbacks.iter().map(|callback| &*callback.entry.node).collect();
        let known = Vec::from_iter(known).join("`, `");
        self.warn_or_refuse(&format!(
            "node `{node}` is not in the system file, which has `{known}` on this host: nothing governs its threads; list its callbacks, \
             or correct its name there"
        ))
    }

    /// The statistics of this name, which are created if there are none.
    fn find_or_create(
        &self,
        name: &str,
        make: impl FnOnce() -> Result<ForeignCallback>,
    ) -> Result<Arc<ForeignCallback>> {
        let mut made = self.made.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(callback) = made.get(name).and_then(Weak::upgrade) {
            return Ok(callback);
        }
        made.retain(|_, callback| callback.strong_count() > 0);
        let callback = Arc::new(make()?);
        made.insert(name.to_owned(), Arc::downgrade(&callback));
        Ok(callback)
    }

    /// The statistics of the callback of `node`, a full name, for messages of `topic`, under its name in the file. Equal names there
    /// are one callback, even with several topics.
    ///
    /// Without a file, services and clients are not measured, because that takes memory and most nodes have seven unused ones;
    /// and failures to measure are not errors.
    pub(crate) fn callback(
        &self,
        node: &str,
        topic: &str,
        is_topic: bool,
    ) -> Result<(String, Option<Arc<ForeignCallback>>)> {
        let (entry, is_named) = (self.entry(node, topic), self.file.is_some());
        let plan = entry.and_then(|index| self.threads[index].as_deref());
        let options = match (&self.file, entry) {
            (Some(file), Some(index)) => {
                let options = file.options(&self.callbacks[index].entry.name)?;
                // Without a thread of the file it is only measured.
                let policy = plan.map_or(CallbackOptions::other().policy, |_| options.policy);
                CallbackOptions { policy, ..options }
            }
            _ => CallbackOptions::other().name(format!("{node} {topic}")),
        }
        .execution_time(is_named);
        if entry.is_none() {
            self.check_callback_is_listed(node, topic)?;
        }
        let Some(statistics) = self.statistics.as_ref().filter(|_| is_named || is_topic) else {
            return Ok((options.name, None));
        };
        let callback = self.find_or_create(&options.name, || {
            let _gate = plan.map(|plan| self.admit(plan, &options.name)).transpose()?;
            ForeignCallback::new(statistics, &options)
                .and_then(|callback| callback.account_core_time(self.core_time))
                .map_err(|error| unshared(&options.name, &error))
        });
        match callback {
            Err(error) if !is_named => {
                tracing::warn!("`taut top` will not show a callback: {error:?}");
                Ok((options.name, None))
            }
            made => made.map(|callback| (options.name, Some(callback))),
        }
    }
}

fn unshared(name: &str, error: &std::io::Error) -> Error {
    Error::other(format!("statistics of '{name}' in /dev/shm: {error}"))
}

/// The thread of each callback: those of a group share it.
fn plans(callbacks: &[CheckedCallback]) -> Vec<Option<Arc<ThreadPlan>>> {
    let mut plans: Vec<Option<Arc<ThreadPlan>>> = Vec::new();
    for callback in callbacks {
        let known = plans.iter().flatten().find(|known| known.name == callback.entry.thread).cloned();
        plans.push(Some(known.unwrap_or_else(|| Arc::new(ThreadPlan::of(callback, callbacks)))));
    }
    plans
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_topic_is_found_with_and_without_its_slash() {
        let path = std::env::temp_dir().join(format!("tautline-rmw-topics-{}.toml", std::process::id()));
        let text = "[hosts.robot]\ncores = 1\n[nodes.n]\nclient = \"rclcpp\"\n[topics]\nscan = { period = \"10ms\" }\n\
                    \"/joy\" = { period = \"10ms\" }\n\"request:/reset\" = { period = \"1s\" }\n\
                    [callbacks.drive]\ntopic = [\"scan\", \"/joy\", \"request:/reset\"]\nwcet = \"1ms\"\npublishes = \"front/path\"\n";
        std::fs::write(&path, text).unwrap();
        let file = LoadedSystem::read(&path, None).unwrap();
        std::fs::remove_file(&path).unwrap();
        let drive = of_ros(&file).next().unwrap().entry;
        assert_eq!(drive.topics, ["/scan", "/joy", "request:/reset"]);
        assert_eq!(drive.publishes, ["/front/path"]);
    }
}
