// SPDX-License-Identifier: MIT OR Apache-2.0
//! Starts and ends callback threads.

use std::cell::Cell;
use std::future::Future;
use std::pin::Pin;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use futures::executor::LocalPool;
use futures::future::LocalFutureObj;
use futures::task::LocalSpawn;
use tautline_rt::{
    BudgetTimer, CoreSet, CoreTime, OwnPriority, Policy, Realtime, RtError, ThreadBuilder, clock,
    current_affinity, current_policy, prove_enforcement,
};

use crate::account::{CoreTimeAccount, SamplerStatistics};
use crate::callback::{CallbackShared, Completion, CompletionGuard, Thread};
use crate::group::{CallbackGroup, MemberInfo};
use crate::hot::{
    self, BudgetEnforcer, CallbackThread, Controlled, GroupFuture, Measured, Parker, Stopwatch, TaskControl,
    WaitMode,
};
use crate::registry::{RegisteredThread, Registry};
use crate::settings::{CallbackSettings, Callbacks};
use crate::sleep::ThreadSleep;
use crate::stats::kind;
use crate::{
    CallbackHandle, CallbackOptions, CallbackStats, ExecutorError, OverrunPolicy, StatisticsFile,
    ThreadRegistration,
};

/// The longest spin before a thread sleeps. The registry, which prevents starvation, considers only busy-polling threads.
const MAX_SPIN: Duration = Duration::from_millis(1);

/// Creates the parker on which a callback thread sleeps.
type MakeParker = Box<dyn Fn() -> Result<Arc<dyn Parker>, Refusal> + Send + Sync>;

/// Why a parker could not be created.
type Refusal = Box<dyn std::error::Error + Send + Sync>;

/// Owns the callback threads of a process; dropping it ends them.
pub struct Executor {
    realtime: Realtime,
    registry: Registry,
    statistics: Option<StatisticsFile>,
    parkers: Option<MakeParker>,
    accounts: Option<Duration>,
    enforcer_priority: u8,
    spawned: AtomicUsize,
    callbacks: Callbacks,
}

impl Executor {
    /// An executor without threads. With [`Realtime::Off`] policies are not applied; everything else is.
    pub fn new(realtime: Realtime) -> Executor {
        let (registry, spawned, callbacks) = Default::default();
        let (statistics, parkers, accounts, enforcer_priority) = (None, None, None, 0);
        Executor { realtime, registry, statistics, parkers, accounts, enforcer_priority, spawned, callbacks }
    }

    /// Sets the priority of the thread that enforces budgets where timers do not reach a busy thread (PREEMPT_RT): above all callbacks of
    /// its cores, also those of other processes, and at most the sampler's. By default it is one above the highest callback with a budget
    /// to enforce; it is never lower than that.
    #[must_use = "it returns the changed executor"]
    pub fn enforcer_priority(mut self, priority: u8) -> Executor {
        self.enforcer_priority = priority;
        self
    }

    /// Provides the objects on which threads sleep that publishers wake directly: `make` is called for each
    /// callback with [`CallbackOptions::direct_wake`].
    #[must_use = "it returns the changed executor"]
    pub fn with_parkers(
        mut self,
        make: impl Fn() -> Result<Arc<dyn Parker>, Refusal> + Send + Sync + 'static,
    ) -> Executor {
        self.parkers = Some(Box::new(make));
        self
    }

    /// Keeps the statistics of all callbacks in `file`, where other processes can read them.
    #[must_use = "it returns the changed executor"]
    pub fn with_statistics(mut self, file: StatisticsFile) -> Executor {
        self.statistics = Some(file);
        self
    }

    /// Records the time that the hypervisor or interrupts took from each callback's core among its
    /// [moments](crate::CallbackSnapshot::moments), if at least `least` was taken from one job. It costs three system calls before each
    /// job and three after it. It applies to callbacks that are spawned from now on, but not to busy-polling ones. For the sampler see
    /// [`sampler_statistics`](Self::sampler_statistics).
    #[must_use = "it returns the changed executor"]
    pub fn account_core_time(mut self, least: Option<Duration>) -> Executor {
        self.accounts = least;
        self
    }

    /// Statistics of the sampler; `None` where core time is not accounted for.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`ExecutorError::Statistics`] if there is no memory for them.
    pub fn sampler_statistics(&self) -> Result<Option<SamplerStatistics>, ExecutorError> {
        let Some(least) = self.accounts else { return Ok(None) };
        let stats = Arc::new(CallbackStats::new("sampler"));
        let no_statistics = |source| ExecutorError::Statistics { name: stats.name().into(), source };
        stats.place(self.statistics.as_ref(), kind::SAMPLER).map_err(no_statistics)?;
        stats.describe_account();
        Ok(Some(SamplerStatistics::new(stats, clock::nanoseconds(least))))
    }

    /// Access to its callbacks, to change how they run.
    pub fn settings(&self) -> CallbackSettings {
        CallbackSettings::new(Arc::clone(&self.callbacks))
    }

    /// The file of [`with_statistics`](Self::with_statistics).
    pub fn statistics(&self) -> Option<&StatisticsFile> {
        self.statistics.as_ref()
    }

    /// Runs a future on its own thread. On return the kernel has confirmed the thread's policy and cores.
    ///
    /// A future that is not `Send` must be created in its thread: see [`Executor::spawn_local`].
    ///
    /// # Errors
    /// [`ExecutorError::Thread`] with the fix if a setting is refused, or budgets are to be enforced and a trial shows that they are not;
    /// [`ExecutorError::Starved`] and the
    /// `BusyPoll` errors if busy polling would starve other threads. In these cases there is no thread.
    pub fn spawn_callback(
        &self,
        options: CallbackOptions,
        future: impl Future<Output = ()> + Send + 'static,
    ) -> Result<CallbackHandle, ExecutorError> {
        self.spawn_local(options, move || future)
    }

    /// Runs a future on its own thread, and creates it there before the thread becomes real-time. The future need not
    /// be `Send`.
    ///
    /// # Errors
    /// As [`Executor::spawn_callback`]; a panic of `make` is an [`ExecutorError::Thread`].
    pub fn spawn_local<M, F>(
        &self,
        options: CallbackOptions,
        make: M,
    ) -> Result<CallbackHandle, ExecutorError>
    where
        M: FnOnce() -> F + Send + 'static,
        F: Future<Output = ()> + 'static,
    {
        self.start(options, Vec::new(), move |measured| (Some(measured), Box::pin(make())))
    }

    /// Runs a group of callbacks on one thread. The handle's statistics cover all members. A deadline, a budget and
    /// handlers in `options` apply to the jobs of all members, in addition to the members' own.
    ///
    /// # Errors
    /// As [`Executor::spawn_callback`].
    pub fn spawn_group(
        &self,
        options: CallbackOptions,
        mut group: CallbackGroup,
    ) -> Result<CallbackHandle, ExecutorError> {
        let members = group.take_members();
        self.start(options, members, move |total| {
            // No jobs of the thread itself: the group measures its members.
            let (members, kept) = group.into_members();
            (None, Box::pin(GroupFuture { members, running: None, total, _kept: kept }))
        })
    }

    /// Registers a thread that the executor did not start, such as the sampler, so that no busy-polling callback
    /// starves it.
    ///
    /// # Errors
    /// [`ExecutorError::Starved`] if a busy-polling callback would starve it.
    pub fn register_thread(
        &self,
        name: &str,
        policy: Policy,
        cores: CoreSet,
    ) -> Result<ThreadRegistration, ExecutorError> {
        let thread = RegisteredThread {
            name: name.to_owned(),
            priority: policy.realtime_priority(),
            cores,
            busy: false,
        };
        self.registry.claim(thread, CoreSet::MAX)
    }

    /// Requests every callback to end and waits until all their threads have exited. A callback that computes
    /// without ever waiting blocks this function.
    ///
    /// # Errors
    /// [`ExecutorError::Panicked`] names every callback that has panicked since the executor was made;
    /// [`ExecutorError::JoinsItself`] on a callback's thread, which then continues until it waits.
    pub fn shutdown(self) -> Result<(), ExecutorError> {
        self.end_all()
    }

    fn end_all(&self) -> Result<(), ExecutorError> {
        let callbacks = std::mem::take(&mut *self.callbacks.lock().unwrap_or_else(PoisonError::into_inner));
        callbacks.iter().for_each(|callback| callback.control.stop());
        let (mut panics, mut joins_itself) = (Vec::new(), None);
        for callback in callbacks {
            match callback.join() {
                Ok(panic) => panics.extend(panic),
                Err(error) => joins_itself = Some(error),
            }
        }
        match joins_itself {
            _ if !panics.is_empty() => Err(ExecutorError::Panicked { callbacks: panics }),
            Some(error) => Err(error),
            None => Ok(()),
        }
    }

    /// Starts a callback's thread. `members`: the members of a group; empty for a single callback.
    fn start<M>(
        &self,
        mut options: CallbackOptions,
        members: Vec<MemberInfo>,
        make: M,
    ) -> Result<CallbackHandle, ExecutorError>
    where
        M: FnOnce(Measured) -> (Option<Measured>, Pin<Box<dyn Future<Output = ()>>>) + Send + 'static,
    {
        let number = self.spawned.fetch_add(1, Ordering::Relaxed);
        if options.name.is_empty() {
            options.name = format!("#{number}");
        }
        check_handlers(&options, &members)?;
        check_overruns(&options, &members)?;
        let (overrun_policy, period) = (options.overrun_policy, options.period);
        let holds = overrun_policy != OverrunPolicy::Tell && self.realtime == Realtime::Required;
        let parker = self.parker(&options)?;
        let refused = |source| ExecutorError::Thread { name: options.name.clone(), source };
        if holds {
            let priority = options.policy.realtime_priority().unwrap_or(0);
            prove_enforcement(self.enforcer_priority.max(priority.saturating_add(1))).map_err(refused)?;
        }
        let (thread, usable) = self.thread(&options).map_err(refused)?;
        let registration = self.registry.claim(thread, usable)?;

        let stats = Arc::new(CallbackStats::new(options.name.as_str()));
        stats.set_limits(&options);
        let no_statistics = |source| ExecutorError::Statistics { name: options.name.clone(), source };
        let kind = if members.is_empty() { kind::CALLBACK } else { kind::GROUP };
        stats.place(self.statistics.as_ref(), kind).map_err(no_statistics)?;
        for member in &members {
            member.stats.place(self.statistics.as_ref(), kind::CALLBACK).map_err(no_statistics)?;
        }
        let (control, end) = (Arc::<TaskControl>::default(), Arc::<Completion>::default());
        let all_stats = members.iter().map(|member| &member.stats).chain([&stats]).cloned().collect();
        let guard = CompletionGuard { end: Arc::clone(&end), stats: all_stats, _registration: registration };
        // A thread that waits for the next period of its reservation cannot be distinguished from one whose core was taken.
        let reserved = matches!(options.policy, Policy::Deadline { .. });
        let accounts = self.accounts.filter(|_| !options.busy_poll && !reserved).map(clock::nanoseconds);
        let (busy, spin, execution_time, thread_control) =
            (options.busy_poll, options.spin.min(MAX_SPIN), options.execution_time, Arc::clone(&control));
        let (thread_stats, watch) = (Arc::clone(&stats), options.watch.clone());
        let trouble = Arc::<Mutex<Option<RtError>>>::default();
        let priority = Arc::new(OwnPriority::new(options.policy));
        let thread_priority = Arc::clone(&priority);
        let thread_trouble = Arc::clone(&trouble);
        let mut builder =
            ThreadBuilder::new(format!("cb:{}", options.thread_name.as_ref().unwrap_or(&options.name)))
                .policy(options.policy)
                .stack_bytes(options.stack_bytes)
                .realtime(self.realtime);
        builder.cores = options.cores;
        let thread = builder.spawn(move || {
            tautline_trace::register_thread();
            let trace = tautline_trace::callback_init(thread_stats.name());
            let stopwatch = execution_time.then(|| Stopwatch::new(busy));
            let spins = parker.is_some() && !spin.is_zero() && !busy;
            let failed = |error| {
                // The callback is stopped before its first poll.
                thread_control.stop();
                *thread_trouble.lock().unwrap_or_else(PoisonError::into_inner) = Some(error);
            };
            let timer = holds.then(|| BudgetTimer::new(thread_priority).map_err(failed).ok()).flatten();
            let account = accounts.and_then(|least_ns| {
                Some(CoreTimeAccount::new(CoreTime::new().map_err(failed).ok()?, least_ns))
            });
            let ends = (overrun_policy == OverrunPolicy::End).then(|| Arc::clone(&thread_control));
            let enforcer = timer.map(|timer| match (overrun_policy, period) {
                (OverrunPolicy::Suspend, Some(period)) => BudgetEnforcer::suspending(timer, period),
                _ => BudgetEnforcer::demoting(timer, ends),
            });
            let (measured, future) =
                make(Measured { stats: thread_stats, watch, stopwatch, spins, enforcer, account });
            let (control, queue) = (Arc::clone(&thread_control), Cell::default());
            hot::enter(CallbackThread {
                measured,
                control,
                busy,
                parker: parker.clone(),
                queue,
                input_size: Cell::default(),
                trace,
                announced: Cell::default(),
            });
            let mut pool = LocalPool::new();
            let waiting = if busy {
                WaitMode::Busy
            } else {
                let parker = parker.unwrap_or_else(|| Arc::new(ThreadSleep::new()));
                let waker = hot::waker_of(&parker);
                WaitMode::On(parker, waker, spin)
            };
            let future = Controlled { future, control: Arc::clone(&thread_control), waiting };
            let spawned = pool.spawner().spawn_local_obj(LocalFutureObj::new(Box::new(future)));
            debug_assert!(spawned.is_ok(), "the pool lives");
            // This first poll does not reach the callback; it makes the pool allocate its memory.
            pool.run_until_stalled();
            move || {
                let _guard = guard;
                let mut pool = pool;
                thread_control.start();
                pool.run();
            }
        });
        let thread = thread.map_err(refused)?;
        if let Some(source) = trouble.lock().unwrap_or_else(PoisonError::into_inner).take() {
            // The thread ends by itself, and `source` is the error to report.
            let _ = thread.join();
            return Err(refused(source));
        }

        let info = thread.info().clone();
        stats.describe(&info, options.period, execution_time);
        members.iter().for_each(|member| member.stats.describe(&info, member.options.period, execution_time));
        if accounts.is_some() {
            members
                .iter()
                .map(|member| &member.stats)
                .chain([&stats])
                .for_each(|stats| stats.describe_account());
        }
        let thread = Mutex::new(Thread { running: Some(thread), panic: None });
        let members = members.into_iter().map(|member| member.stats).collect();
        let callback = Arc::new(CallbackShared { stats, members, priority, control, end, info, thread });
        self.keep(Arc::clone(&callback));
        Ok(CallbackHandle::new(callback))
    }

    /// Returns the parker on which publishers wake the thread, if they do.
    fn parker(&self, options: &CallbackOptions) -> Result<Option<Arc<dyn Parker>>, ExecutorError> {
        if !options.direct_wake || options.busy_poll {
            return Ok(None);
        }
        let refused = |source| ExecutorError::DirectWake { name: options.name.clone(), source };
        let make = self.parkers.as_ref().ok_or_else(|| refused("see Executor::with_parkers".into()))?;
        match make() {
            Err(_) if options.is_direct_wake_optional => Ok(None),
            made => made.map(Some).map_err(refused),
        }
    }

    /// Returns the thread's registry entry, as far as it is known before the thread runs, and, for a busy-polling one, the number of cores
    /// that the process may use.
    fn thread(&self, options: &CallbackOptions) -> Result<(RegisteredThread, usize), RtError> {
        let policy = match self.realtime {
            Realtime::Required => options.policy,
            Realtime::Off => current_policy()?,
        };
        let cores = match options.cores {
            Some(cores) => {
                cores.check()?;
                cores
            }
            None if matches!(policy, Policy::Deadline { .. }) => CoreSet::allowed()?,
            None => current_affinity()?,
        };
        let (priority, busy) = (policy.realtime_priority(), options.busy_poll);
        let usable = if busy { CoreSet::allowed()?.len() } else { CoreSet::MAX };
        Ok((RegisteredThread { name: options.name.clone(), priority, cores, busy }, usable))
    }

    /// Adds a callback to the list and removes those that ended without a panic, so that the list does not grow for ever.
    fn keep(&self, callback: Arc<CallbackShared>) {
        let mut callbacks = self.callbacks.lock().unwrap_or_else(PoisonError::into_inner);
        callbacks.retain(|old| !(old.end.has_ended() && matches!(old.join(), Ok(None))));
        callbacks.push(callback);
    }
}

/// Refuses overrun handlers that would never be called: whether execution times are measured is a setting of the thread, not of a member.
fn check_handlers(options: &CallbackOptions, members: &[MemberInfo]) -> Result<(), ExecutorError> {
    if options.execution_time {
        return Ok(());
    }
    let own = options.watch.on_overrun.as_ref().map(|_| options.name.as_str());
    let of_member = || {
        members
            .iter()
            .find(|member| member.options.watch.on_overrun.is_some())
            .map(|member| member.stats.name())
    };
    match own.or_else(of_member) {
        Some(name) => Err(ExecutorError::UnmeasuredBudget { name: name.to_owned() }),
        None => Ok(()),
    }
}

/// Refuses budget enforcement where it is not possible.
fn check_overruns(options: &CallbackOptions, members: &[MemberInfo]) -> Result<(), ExecutorError> {
    let problem = match options {
        _ if options.overrun_policy == OverrunPolicy::Tell => return Ok(()),
        _ if !options.execution_time => "its execution times are not measured: drop `.execution_time(false)`",
        _ if options.busy_poll => "it polls busily, and uses its core all the time: drop `.busy_poll()`",
        _ if matches!(options.policy, Policy::Deadline { .. }) => {
            "the kernel holds its thread to the reservation already: drop `.demote_on_overrun()` and the like"
        }
        _ if options.overrun_policy == OverrunPolicy::Suspend && !members.is_empty() => {
            "it is a group, whose members have periods of their own: demote it instead"
        }
        _ if options.overrun_policy == OverrunPolicy::Suspend
            && options.period.is_none_or(|period| period.is_zero()) =>
        {
            "it has no period to wait for: state it with `.period(..)`"
        }
        _ if options.policy.realtime_priority().is_none() => {
            "it has no real-time priority to lose: use `CallbackOptions::fifo`"
        }
        _ if options.budget.is_none() && members.iter().all(|member| member.stats.budget().is_none()) => {
            "it has none: state it with `.budget(..)`"
        }
        _ => return Ok(()),
    };
    Err(ExecutorError::CannotHold { name: options.name.clone(), problem })
}

tautline_rt::debug_fields!(Executor, |this| callbacks = this.callbacks);

impl Drop for Executor {
    /// As [`Executor::shutdown`]; panics have been printed by the threads they ended.
    fn drop(&mut self) {
        let _ = self.end_all();
    }
}
