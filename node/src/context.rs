// SPDX-License-Identifier: MIT OR Apache-2.0
//! The context: membership of a domain, a sampler, callback threads.

use crate::args::Arguments;
use crate::error::{Error, Result};
use crate::logging::{self, FlushOnDrop, Rosout};
use crate::reload::{CurrentSystem, Reload};
use crate::remap::RemapRules;
use crate::subscription::thread_parkers;
use crate::system::{CallbackJoin, join_of};
use crate::values::EventTopic;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tautline_executor::{
    Admitted, CallbackOptions, CallbackStats, CoreSet, Executor, Policy, ProcessInfo, Realtime,
    SamplerStatistics, StatisticsFile,
};
use tautline_rt::{IdleHold, MemoryLock, ThreadBuilder};
use tautline_sampler::{Events, Sampler, Sleep, Wait};
use tautline_system::{
    Admission, Gate, LoadedSystem, SystemError, admission_of_environment, admit_callbacks, admit_system,
    core_time_of_environment, environment, realtime_of_environment, switch_of_environment,
};
use tautline_trace::TraceSettings;
use tautline_transport::{Participant, Qos};

/// Membership of a domain, with the sampler and the callback threads of its nodes. A clone is the same context.
///
/// When the last clone and the last node have been dropped, every callback thread is stopped and joined. A callback
/// that owns a clone keeps the context, and thereby itself, alive. If it only needs to end spinning, give it
/// [`Context::events`].
///
/// ```
/// use std::time::Duration;
/// use tautline::{CallbackOptions, Context, Node, Realtime};
///
/// let ctx = Context::builder().domain(228).realtime(Realtime::Off).build()?;
/// let mut node = Node::create(ctx.clone(), "example", "")?;
/// let mut timer = node.create_wall_timer(Duration::from_millis(1))?;
/// let events = ctx.events().clone();
/// node.spawn_callback(CallbackOptions::fifo(20), async move {
///     timer.tick().await;
///     events.stop();
/// })?;
/// ctx.spin()?; // until the timer's first tick
/// # Ok::<(), tautline::Error>(())
/// ```
#[derive(Clone)]
pub struct Context {
    pub(crate) shared: Arc<ContextState>,
}

pub(crate) struct ContextState {
    // Dropped in this order: callbacks end before what they wait for.
    pub(crate) executor: Executor,
    _flush: FlushOnDrop,
    sampler_statistics: Option<SamplerStatistics>,
    /// Taken by the thread that spins.
    sampler: Mutex<Option<Sampler>>,
    pub(crate) events: Events,
    pub(crate) participant: Participant,
    realtime: Realtime,
    admission: Admission,
    sampler_priority: u8,
    /// Replaced when a changed text of its file is adopted.
    system: Option<Arc<CurrentSystem>>,
    pub(crate) arguments: Arguments,
    pub(crate) parameter_events: Arc<EventTopic>,
    pub(crate) rosout: Arc<Rosout>,
    pub(crate) settings: ContextBuilder,
}

/// The layer below messages, for tools: see the crate `tautline-transport`.
impl AsRef<Participant> for Context {
    fn as_ref(&self) -> &Participant {
        &self.shared.participant
    }
}

tautline_rt::debug_fields!(Context, |this| domain = this.domain());

/// The settings of a context.
#[derive(Clone, Debug, Default)]
#[must_use = "call build()"]
pub struct ContextBuilder {
    domain: Option<u32>,
    realtime: Option<Realtime>,
    sampler_priority: Option<u8>,
    sampler_cores: Option<CoreSet>,
    wait: Option<Wait>,
    lock_memory: Option<bool>,
    hold_idle: Option<bool>,
    system: Option<PathBuf>,
    host: Option<String>,
    admission: Option<Admission>,
    share_statistics: Option<bool>,
    core_time: Option<Option<Duration>>,
    trace: Option<TraceSettings>,
    pub(crate) remap: RemapRules,
    args: Vec<String>,
}

impl ContextBuilder {
    /// The sampler's priority if neither this builder nor a system file sets one: above the priority of every callback,
    /// with room for the kernel's own threads above it.
    pub const SAMPLER_PRIORITY: u8 = 90;

    /// The shortest time taken from one job that is recorded, if the environment enables it (`TAUT_CORE_TIME=on`).
    pub const CORE_TIME_PIECE: Duration = tautline_system::CORE_TIME_PIECE;

    /// The domain, 0 to 232. Otherwise `TAUT_DOMAIN`, else `ROS_DOMAIN_ID`, else 0.
    pub fn domain(self, domain: u32) -> Self {
        ContextBuilder { domain: Some(domain), ..self }
    }

    /// Whether threads get their real-time policies. Otherwise [`Realtime::Required`], unless `TAUT_REALTIME=off`.
    pub fn realtime(self, realtime: Realtime) -> Self {
        ContextBuilder { realtime: Some(realtime), ..self }
    }

    /// `SCHED_FIFO` priority of the sampler, 1 to 99; must be above the callbacks' for their response times to hold.
    pub fn sampler_priority(self, priority: u8) -> Self {
        ContextBuilder { sampler_priority: Some(priority), ..self }
    }

    /// The core on which the sampler runs.
    pub fn sampler_core(self, core: usize) -> Self {
        ContextBuilder { sampler_cores: Some(CoreSet::one(core)), ..self }
    }

    /// How the sampler waits.
    pub fn wait(self, wait: Wait) -> Self {
        ContextBuilder { wait: Some(wait), ..self }
    }

    /// Whether spinning in real time locks the process's memory first (as pages are touched). On by default.
    pub fn lock_memory(self, lock: bool) -> Self {
        ContextBuilder { lock_memory: Some(lock), ..self }
    }

    /// Whether spinning in real time keeps all cores out of idle states, by `/dev/cpu_dma_latency`: wake-ups become several times faster,
    /// power consumption rises, and a hypervisor that limits its guests by a quota stops this guest for milliseconds when the quota is used
    /// up. On by default, unless `TAUT_HOLD_IDLE=off`. If the file cannot be opened, a warning is logged.
    pub fn hold_idle(self, hold: bool) -> Self {
        ContextBuilder { hold_idle: Some(hold), ..self }
    }

    /// Takes the priorities, cores and queue depths of callbacks, and the sampler's priority, from a system file: the
    /// values with which `taut check` computed its bounds. See [`Context::callback`].
    pub fn system(self, path: impl Into<PathBuf>) -> Self {
        ContextBuilder { system: Some(path.into()), ..self }
    }

    /// Which of the system file's hosts this is. Otherwise `TAUT_HOST`, else the only one.
    pub fn host(self, name: impl Into<String>) -> Self {
        ContextBuilder { host: Some(name.into()), ..self }
    }

    /// Whether this process is checked against the load that runs in the domain: its system file when the context is built, and each
    /// real-time callback that is not in the file when it is spawned. Otherwise `TAUT_ADMISSION=check`, `force` or `off`, else
    /// [`Admission::Check`] with a system file and [`Admission::Off`] without one. Without real-time priorities no real-time thread
    /// is delayed, and nothing is checked.
    ///
    /// ```
    /// use tautline::{Admission, Context, Realtime};
    /// let context = Context::builder().domain(66).realtime(Realtime::Off).admission(Admission::Force).build()?;
    /// # Ok::<(), tautline::Error>(())
    /// ```
    pub fn admission(self, admission: Admission) -> Self {
        ContextBuilder { admission: Some(admission), ..self }
    }

    /// Whether the statistics of callbacks lie in a file of `/dev/shm`, where other processes read them
    /// (`tautline_system::shared_statistics`): `taut report` does this, if there is a system file. On by default; it costs
    /// callbacks nothing.
    pub fn share_statistics(self, share: bool) -> Self {
        ContextBuilder { share_statistics: Some(share), ..self }
    }

    /// Whether time that the host takes from the callbacks' cores is accounted for, so that `taut report` can state why a job was late:
    /// steal on a virtual machine, interrupts, timers that were served late. It costs six short system calls (some 3 µs) per job and per
    /// wake-up of the sampler. Time taken from one job counts if it is at least `least`. Otherwise `TAUT_CORE_TIME=on`, which means 100 µs,
    /// or `off`, else off.
    pub fn account_core_time(self, least: Option<Duration>) -> Self {
        ContextBuilder { core_time: Some(least), ..self }
    }

    /// Whether this process can be traced, and how much each thread keeps. Otherwise `TAUT_TRACE` and `TAUT_TRACE_EVENTS`,
    /// else [`TraceMode::Ready`](crate::TraceMode::Ready). This setting applies to the whole process: the first context's
    /// setting counts.
    pub fn trace(self, settings: impl Into<TraceSettings>) -> Self {
        ContextBuilder { trace: Some(settings.into()), ..self }
    }

    /// Rules that give every node of this context, and its topics and services, other names; a node's own, in
    /// [`NodeOptions`](crate::NodeOptions), come first.
    pub fn remap(self, rules: RemapRules) -> Self {
        ContextBuilder { remap: rules, ..self }
    }

    /// A command line, with or without the program's name. The arguments between `--ros-args` and `--`, or the end,
    /// are ROS 2's arguments; the others are the program's ([`Context::non_ros_args`]). [`Context::create`] uses the
    /// command line of the process.
    ///
    /// | argument | does |
    /// |---|---|
    /// | `-p [NODE:]NAME:=VALUE`, `--param` | gives a parameter a value, read as YAML |
    /// | `--params-file FILE` | gives parameters the values in a YAML file; as for `NODE`, a name without `/` at its start is one of the root namespace, and later values count |
    /// | `-r FROM:=TO`, `--remap` | see [`RemapRules`]; come before those of [`remap`](Self::remap) |
    /// | `--log-level [LOGGER:=]LEVEL` | `debug`, `info`, `warn`, `error` or `fatal`; all loggers, or one and those below |
    /// | `--disable-stdout-logs`, `--disable-rosout-logs` | lines are not printed, not published; also `--enable-...` |
    /// | `-e PATH`, `--enclave` | of the nodes, as others see it; it selects no security |
    pub fn args(self, args: impl IntoIterator<Item = impl Into<String>>) -> Self {
        ContextBuilder { args: args.into_iter().map(Into::into).collect(), ..self }
    }

    /// Joins the domain.
    ///
    /// # Errors
    /// [`Error::Argument`], [`Error::Remap`] and [`Error::Parameter`] for an invalid command line; [`SystemError::Environment`] for an invalid
    /// variable; [`Error::System`] and [`SystemError::Host`] for a system file that cannot be used; [`SystemError::NotAdmitted`] for a file whose load
    /// does not fit beside the running load; [`Error::Transport`], [`SystemError::Unreadable`] and [`SystemError::Statistics`] if shared memory is
    /// not available.
    pub fn build(mut self) -> Result<Context> {
        let arguments = Arguments::parse(std::mem::take(&mut self.args))?;
        self.remap = arguments.remap.clone().then(&self.remap);
        let host = self.host.clone().or_else(|| environment("TAUT_HOST"));
        let system =
            self.system.as_deref().map(|path| LoadedSystem::read(path, host.as_deref())).transpose()?;
        let of_file = system.as_ref().map(|system| system.sampler_priority);
        let sampler_priority = self.sampler_priority.or(of_file).unwrap_or(Self::SAMPLER_PRIORITY);
        let domain = match self.domain {
            Some(domain) => domain,
            None => Context::domain_of_environment()?,
        };
        let realtime = match self.realtime {
            Some(realtime) => realtime,
            None => realtime_of_environment()?,
        };
        if let Some(settings) = self.trace {
            tautline_trace::configure(settings);
        }
        let admission = match (self.admission, &system) {
            _ if realtime == Realtime::Off => Admission::Off,
            (Some(admission), _) => admission,
            (None, system) => admission_of_environment(system.is_some())?,
        };
        let participant = Participant::new(domain)?;
        let (_gate, admitted) = match &system {
            Some(system) if admission != Admission::Off => {
                let (gate, admitted) = admit_system(domain, admission, system)?;
                (Some(gate), admitted)
            }
            _ => (None, Admitted::Unchecked),
        };
        let sampler = Sampler::new(&participant)?.with_wait(self.wait.unwrap_or(Wait::Block));
        let core_time = match self.core_time {
            Some(core_time) => core_time,
            None => core_time_of_environment()?,
        };
        if self.hold_idle.is_none() {
            self.hold_idle = switch_of_environment("TAUT_HOLD_IDLE")?;
        }
        let mut executor =
            Executor::new(realtime).with_parkers(thread_parkers(&participant)).account_core_time(core_time);
        executor = executor.enforcer_priority(sampler_priority);
        if self.share_statistics != Some(false) {
            let mut about = ProcessInfo {
                realtime: realtime == Realtime::Required,
                sampler_priority: Some(sampler_priority),
                admitted,
                ..ProcessInfo::of_this()
            };
            if let Some(system) = &system {
                system.describe(&mut about);
            }
            let prefix = StatisticsFile::prefix(domain);
            let file = StatisticsFile::create(&prefix, &about).map_err(SystemError::Statistics)?;
            executor = executor.with_statistics(file);
        }
        let sampler_statistics = executor.sampler_statistics()?;
        logging::configure(&arguments.log_levels, arguments.outputs.console);
        let system = system.map(|system| Arc::new(CurrentSystem::new(system)));
        if let (Some(system), Some(statistics)) = (&system, executor.statistics()) {
            let reload = Reload::new(domain, statistics.orders(), executor.settings(), Arc::clone(system));
            participant.attend(move || reload.serve_request());
        }
        let shared = ContextState {
            executor,
            _flush: FlushOnDrop,
            events: sampler.events().clone(),
            sampler_statistics,
            sampler: Mutex::new(Some(sampler)),
            arguments,
            parameter_events: Arc::new(EventTopic::new(participant.clone())),
            rosout: Arc::new(Rosout::new(participant.clone())),
            participant,
            realtime,
            admission,
            sampler_priority,
            system,
            settings: self,
        };
        Ok(Context { shared: Arc::new(shared) })
    }
}

impl Context {
    /// A context with every default, and the [arguments](ContextBuilder::args) of the process.
    ///
    /// # Errors
    /// As [`ContextBuilder::build`].
    pub fn create() -> Result<Context> {
        let args = std::env::args_os().map(|arg| arg.to_string_lossy().into_owned());
        Context::builder().args(args).build()
    }

    /// A context with settings.
    pub fn builder() -> ContextBuilder {
        ContextBuilder::default()
    }

    /// The domain that a context joins unless its builder names one: `TAUT_DOMAIN`, else `ROS_DOMAIN_ID`, else 0.
    ///
    /// # Errors
    /// [`SystemError::Environment`] for an invalid variable.
    pub fn domain_of_environment() -> Result<u32> {
        let expected = "a domain is a number from 0 to 232";
        for variable in ["TAUT_DOMAIN", "ROS_DOMAIN_ID"] {
            if let Some(value) = environment(variable) {
                let domain = value.parse().ok().filter(|&domain| domain <= tautline_transport::MAX_DOMAIN);
                return Ok(domain.ok_or(SystemError::Environment { variable, value, expected })?);
            }
        }
        Ok(0)
    }

    /// The domain.
    pub fn domain(&self) -> u32 {
        self.shared.participant.domain()
    }

    /// Whether threads get their real-time policies.
    pub fn realtime(&self) -> Realtime {
        self.shared.realtime
    }

    /// The options of the callback `name` from the system file: its thread's priority and core, its period, its deadline,
    /// and its budget. The budget is what the analysis charges for a job: the wcet, and the overheads of one job that the
    /// file states. For [`Node::spawn_callback`](crate::Node::spawn_callback), or for
    /// [`CallbackGroup::add`](crate::CallbackGroup::add) if the callback shares its thread.
    ///
    /// # Errors
    /// [`Error::NoSystem`] without a system file; [`SystemError::UnknownCallback`] if it lacks the callback on this host.
    pub fn callback(&self, name: &str) -> Result<CallbackOptions> {
        Ok(self.system_for(name)?.options(name)?)
    }

    /// The thread options of the group `name` from the system file: priority and core, for
    /// [`Node::spawn_group`](crate::Node::spawn_group).
    ///
    /// # Errors
    /// [`Error::NoSystem`] without a system file; [`SystemError::UnknownGroup`] if it lacks the group on this host.
    pub fn group(&self, name: &str) -> Result<CallbackOptions> {
        Ok(self.system_for(name)?.group(name)?)
    }

    /// The queue of the callback `name`: keep-last with the depth that the system file states, else with the capacity at
    /// which, as computed, no message is lost.
    ///
    /// # Errors
    /// As [`callback`](Self::callback); [`SystemError::NoCapacity`] if the callback has no bound.
    pub fn callback_qos(&self, name: &str) -> Result<Qos> {
        Ok(Qos::keep_last(self.system_for(name)?.depth(name)?))
    }

    /// The join settings of the callback `name`, which waits for several topics (`all`), from the system file: its window, and how
    /// many messages must be queued.
    ///
    /// ```no_run
    /// # fn f(context: &tautline::Context, node: &mut tautline::Node) -> Result<(), Box<dyn std::error::Error>> {
    /// use futures::StreamExt;
    /// use tautline::join::Synchronizer;
    /// use tautline::sensor_msgs::msg::{Image, PointCloud2};
    /// let (join, qos) = (context.callback_join("fuse")?, context.callback_qos("fuse")?);
    /// for topic in ["/image", "/cloud"] {
    ///     node.set_topic_limits(topic, join.limits())?;
    /// }
    /// let inputs = (node.subscribe::<Image>("/image", qos)?, node.subscribe::<PointCloud2>("/cloud", qos)?);
    /// let pairs = Synchronizer::new(join.approximate_time(), inputs)?;
    /// node.spawn_callback(context.callback("fuse")?, pairs.for_each(|(image, cloud)| async move {
    ///     let _ = (image.view().width(), cloud.view().width());
    /// }))?;
    /// # Ok(()) }
    /// ```
    ///
    /// # Errors
    /// As [`callback`](Self::callback); [`Error::NoJoin`] if it waits for one topic only; [`SystemError::NoCapacity`] if it has no bound.
    pub fn callback_join(&self, name: &str) -> Result<CallbackJoin> {
        join_of(&*self.system_for(name)?, name)
    }

    /// The arguments of the command line that are not ROS 2's, with the program's name.
    pub fn non_ros_args(&self) -> &[String] {
        &self.shared.arguments.others
    }

    fn system_for(&self, name: &str) -> Result<Arc<LoadedSystem>> {
        let system = self.shared.system.as_ref().map(|system| system.get());
        system.ok_or_else(|| Error::NoSystem { name: name.into() })
    }

    /// False after [`shutdown`](Self::shutdown) was called.
    pub fn is_valid(&self) -> bool {
        !self.shared.events.is_stopped()
    }

    /// Ends spinning, permanently; callbacks end with the context. May be called from any thread and from a signal
    /// handler.
    ///
    /// # Real-time
    /// Wait-free; at most one futex wake.
    pub fn shutdown(&self) {
        self.shared.events.stop();
    }

    /// The time taken from the sampler's core, and the time that it used to serve events, while it
    /// [spins](Self::spin). `None` without [`account_core_time`](ContextBuilder::account_core_time).
    pub fn sampler_statistics(&self) -> Option<&Arc<CallbackStats>> {
        self.shared.sampler_statistics.as_ref().map(SamplerStatistics::stats)
    }

    /// Timers and guard conditions served by this context's sampler.
    pub fn events(&self) -> &Events {
        &self.shared.events
    }

    /// Turns the calling thread into the sampler until [`shutdown`](Self::shutdown): locks the process's memory, makes malloc keep freed
    /// memory (permanently, for the whole process), sets the thread's policy, priority and cores, reads them back, and serves events. After
    /// that the thread has its former policy and cores again; the memory stays locked.
    ///
    /// With [`Realtime::Off`] it serves events under the policy that the thread has, on the sampler's core if one is set.
    ///
    /// # Real-time
    /// After the set-up, per wake-up: O(ready), no allocation, no lock; six system calls if core time is accounted
    /// for.
    ///
    /// # Errors
    /// [`Error::AlreadySpinning`]; [`Error::Realtime`] with the fix if a setting is refused; [`Error::Executor`] if a
    /// busy-polling callback would starve the sampler. The thread then has its former settings.
    pub fn spin(&self) -> Result<()> {
        let mut sampler = self.borrow_sampler()?;
        let _settings = self.become_sampler()?;
        match &self.shared.sampler_statistics {
            None => sampler.get().spin(),
            Some(statistics) => {
                let account = statistics.account()?;
                sampler.get().spin_told(|sleep| match sleep {
                    Sleep::Begins => account.sleeps(),
                    Sleep::Ends { due_ns } => account.woke(due_ns),
                });
            }
        }
        Ok(())
    }

    /// Serves ready tasks; waits up to `timeout` for something to become ready. Changes no real-time setting.
    ///
    /// If another thread spins this context, this function only waits.
    pub fn spin_once(&self, timeout: Duration) {
        match self.borrow_sampler() {
            Ok(mut sampler) => {
                sampler.get().spin_once(Some(timeout));
            }
            Err(_) => std::thread::sleep(timeout),
        }
    }

    fn sampler(&self) -> MutexGuard<'_, Option<Sampler>> {
        self.shared.sampler.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn borrow_sampler(&self) -> Result<BorrowedSampler<'_>> {
        self.shared.participant.check_process()?;
        let sampler = self.sampler().take().ok_or(Error::AlreadySpinning)?;
        Ok(BorrowedSampler { context: self, sampler: Some(sampler) })
    }

    pub(crate) fn warn_if_above_sampler(&self, options: &CallbackOptions) {
        let sampler = self.shared.sampler_priority;
        // A reservation preempts the sampler, too, but never for longer than its budget.
        let priority = options.policy.realtime_priority().filter(|priority| *priority < Policy::RESERVATION);
        if self.realtime() == Realtime::Required && priority >= Some(sampler) {
            let (name, policy) = (&options.name, options.policy);
            tracing::warn!(
                "callback '{name}' at {policy} is not below the sampler at {sampler}: while it runs, nothing is woken"
            );
        }
    }

    /// Checks callbacks that are to be spawned on a thread with the settings `thread`. The caller keeps the result until they are spawned.
    pub(crate) fn admit<'o>(
        &self,
        thread: &CallbackOptions,
        callbacks: impl Iterator<Item = &'o CallbackOptions>,
    ) -> Result<Option<Gate>> {
        let (mode, system) = (self.shared.admission, self.shared.system.as_ref().map(|system| system.get()));
        if mode == Admission::Off || thread.policy.realtime_priority().is_none() {
            return Ok(None);
        }
        let (gate, admitted) = admit_callbacks(self.domain(), mode, system.as_deref(), thread, callbacks)?;
        if let (Admitted::Forced(_), Some(file)) = (&admitted, self.shared.executor.statistics()) {
            file.set_admitted(&admitted);
        }
        Ok(Some(gate))
    }

    fn become_sampler(&self) -> Result<SamplerSettings> {
        let settings = &self.shared.settings;
        let former = (tautline_rt::current_policy()?, tautline_rt::current_affinity()?);
        let mut held = SamplerSettings { policy: None, cores: None, _idle: None, _seat: None };
        if self.realtime() == Realtime::Required {
            let policy = Policy::Fifo(self.shared.sampler_priority);
            let cores = settings.sampler_cores.unwrap_or(former.1);
            // Checked before anything is set: on a busy poller's core this thread might not get as far as this check.
            held._seat = Some(self.shared.executor.register_thread("sampler", policy, cores)?);
            tautline_rt::tune_malloc();
            if settings.lock_memory != Some(false) {
                tautline_rt::lock_memory(MemoryLock::OnFault)?;
            }
            tautline_rt::prefault_stack(ThreadBuilder::STACK_BYTES / 4);
            if settings.hold_idle != Some(false) {
                held._idle = IdleHold::new().inspect_err(|error| tracing::warn!("{error}")).ok();
            }
            held.policy = Some(former.0);
            tautline_rt::set_policy(policy)?;
        }
        // The cores are set last, for the same reason.
        if let Some(cores) = settings.sampler_cores {
            held.cores = Some(former.1);
            tautline_rt::set_affinity(cores)?;
        }
        Ok(held)
    }
}

/// Puts the sampler back when its thread is done.
struct BorrowedSampler<'c> {
    context: &'c Context,
    sampler: Option<Sampler>,
}

impl BorrowedSampler<'_> {
    fn get(&mut self) -> &mut Sampler {
        self.sampler.as_mut().expect("taken only by drop")
    }
}

impl Drop for BorrowedSampler<'_> {
    fn drop(&mut self) {
        *self.context.sampler() = self.sampler.take();
    }
}

/// What the sampler's thread holds while it spins, and its former policy and cores, where they were changed.
struct SamplerSettings {
    policy: Option<Policy>,
    cores: Option<CoreSet>,
    _idle: Option<IdleHold>,
    _seat: Option<tautline_executor::ThreadRegistration>,
}

impl Drop for SamplerSettings {
    fn drop(&mut self) {
        // The cores first: without its priority the thread might never leave a core that a busy poller holds.
        let restored = [self.cores.map(tautline_rt::set_affinity), self.policy.map(tautline_rt::set_policy)];
        for error in restored.into_iter().flatten().filter_map(std::result::Result::err) {
            tracing::warn!("the sampler's thread keeps a setting: {error}");
        }
    }
}
