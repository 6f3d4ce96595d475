// SPDX-License-Identifier: MIT OR Apache-2.0
//! Mutually exclusive callbacks.

use std::future::Future;
use std::sync::Arc;

use futures::Stream;

use crate::hot::{GroupGuard, GroupMember, StreamMember};
use crate::{CallbackOptions, CallbackStats};

/// Several callbacks on one thread. They run one at a time, to completion, in order of release (ROS 2's mutually
/// exclusive callback group). Give it a thread with [`Executor::spawn_group`](crate::Executor::spawn_group).
///
/// # Order
/// The group is one FIFO of (callback, message). Before each job it checks the next message of every member and runs
/// the one released first; among equals, that of the member added first. After one message it checks again: it never
/// drains a stream. So the bound for a FIFO of jobs holds for every member: with request bound functions `rbf_j`,
///
/// ```text
/// R = max over A of (sum over j of rbf_j(A + epsilon)) - A
/// ```
///
/// and `ceil(R / T_i)` messages of depth suffice for member `i`. A `for_each` over merged or joined streams does not
/// have this bound: it empties one stream before it checks the next, regardless of the messages waiting there. The
/// only bound that it shares with every work-conserving order is the busy period, the least `L` with `L = sum ceil(L
/// / T_j) C_j`.
///
/// Each job costs one poll of every member's stream. A callback that waits blocks the other members; a callback that
/// panics ends the whole group.
///
/// # Look-ahead
/// Each member holds the next message of its stream until its turn: allow for one more borrowed sample than the
/// callback itself holds.
///
/// ```
/// use futures::stream;
/// use std::sync::mpsc;
/// use tautline_executor::{CallbackGroup, CallbackOptions, Executor, Realtime};
///
/// let (log, logged) = mpsc::channel();
/// let mut group = CallbackGroup::new();
/// for (name, releases) in [("/a", [1, 4]), ("/b", [2, 3])] {
///     let log = log.clone();
///     group.add(name, stream::iter(releases), |release| *release, move |release| {
///         log.send((name, release)).unwrap();
///         async {}
///     });
/// }
/// let executor = Executor::new(Realtime::Off);
/// executor.spawn_group(CallbackOptions::fifo(20), group)?.join()?;
/// assert_eq!(logged.try_iter().collect::<Vec<_>>(), [("/a", 1), ("/b", 2), ("/b", 3), ("/a", 4)]);
/// # Ok::<(), tautline_executor::ExecutorError>(())
/// ```
#[derive(Default)]
#[must_use = "hand it to Executor::spawn_group"]
pub struct CallbackGroup {
    /// Members are created in their thread, because a callback's future need not be `Send`.
    recipes: Vec<Box<dyn FnOnce() -> Box<dyn GroupMember> + Send>>,
    members: Vec<MemberInfo>,
    kept: Vec<GroupGuard>,
}

/// The statistics and options of a member, which the executor needs.
pub(crate) struct MemberInfo {
    pub stats: Arc<CallbackStats>,
    pub options: CallbackOptions,
}

impl CallbackGroup {
    /// A group without members.
    pub fn new() -> CallbackGroup {
        CallbackGroup::default()
    }

    /// Keeps `what` until the group has ended.
    pub fn keep(&mut self, what: impl Send + 'static) {
        self.kept.push(Box::new(what));
    }

    /// Adds a callback for the items of a stream. `release` returns an item's release in `CLOCK_MONOTONIC` ns, of a timer's tick its
    /// `since_ns`; a stream's items must arrive in order of release. Neither the items nor the callback's futures need to be
    /// `Send`.
    ///
    /// `member` is a name, or [`CallbackOptions`]. A member uses only their name, period, deadline, budget, bound and
    /// handlers, because its thread is the group's.
    ///
    /// Returns the member's statistics, which count from the time when the group is spawned.
    pub fn add<S, F, Fut>(
        &mut self,
        member: impl Into<MemberOptions>,
        stream: S,
        release: fn(&S::Item) -> u64,
        callback: F,
    ) -> Arc<CallbackStats>
    where
        S: Stream + Send + 'static,
        F: FnMut(S::Item) -> Fut + Send + 'static,
        Fut: Future<Output = ()> + 'static,
    {
        let MemberOptions(options) = member.into();
        let stats = Arc::new(CallbackStats::new(options.name.as_str()));
        stats.set_limits(&options);
        let (member_stats, watch) = (Arc::clone(&stats), options.watch.clone());
        self.members.push(MemberInfo { stats: Arc::clone(&stats), options });
        self.recipes.push(Box::new(move || {
            let trace = tautline_trace::callback_init(member_stats.name());
            Box::new(StreamMember {
                stream: Box::pin(stream),
                ended: false,
                release,
                callback,
                next: None,
                future: Box::pin(None),
                begun: None,
                stats: member_stats,
                watch,
                traced: trace.id(),
                trace,
            })
        }));
        stats
    }

    /// The options of each member, in the order in which they were added.
    pub fn members(&self) -> impl Iterator<Item = &CallbackOptions> {
        self.members.iter().map(|member| &member.options)
    }

    pub(crate) fn take_members(&mut self) -> Vec<MemberInfo> {
        std::mem::take(&mut self.members)
    }

    /// Creates the members, in the thread that will run them, and returns the objects that are kept as long as the members.
    pub(crate) fn into_members(self) -> (Box<[Box<dyn GroupMember>]>, Vec<GroupGuard>) {
        (self.recipes.into_iter().map(|make| make()).collect(), self.kept)
    }
}

impl std::fmt::Debug for CallbackGroup {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("CallbackGroup").field("members", &self.recipes.len()).finish()
    }
}

/// The name of a group's member and the properties that are monitored: a name, or [`CallbackOptions`].
#[derive(Debug, Clone)]
pub struct MemberOptions(CallbackOptions);

impl From<CallbackOptions> for MemberOptions {
    fn from(options: CallbackOptions) -> MemberOptions {
        MemberOptions(options)
    }
}

impl From<&str> for MemberOptions {
    fn from(name: &str) -> MemberOptions {
        MemberOptions(CallbackOptions::other().name(name))
    }
}

impl From<String> for MemberOptions {
    fn from(name: String) -> MemberOptions {
        MemberOptions(CallbackOptions::other().name(name))
    }
}
