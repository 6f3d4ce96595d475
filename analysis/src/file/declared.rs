// SPDX-License-Identifier: MIT OR Apache-2.0
//! The file as it is written: every section with its positions in the text, before names are resolved.
use super::content::{Client, Executor, JoinPolicy, LinkPriority, OverrunPolicy, ThreadPriority};
use super::reader::At;
use crate::{LockProtocol, Order, Reservation};

/// How priorities are chosen for callbacks that name none.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Policy {
    RateMonotonic,
    DeadlineMonotonic,
    Audsley,
}

#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Costs {
    pub context_switch: Option<u64>,
    pub per_message: Option<u64>,
    pub gateway: Option<u64>,
    pub rclcpp: Option<u64>,
    pub rclpy: Option<u64>,
    pub demotion: Option<u64>,
    pub tick: Option<(u64, u64)>,
    pub throttling: Option<(u64, u64)>,
}

pub(super) struct Host {
    pub name: String,
    pub cores: Vec<usize>,
    pub costs: Costs,
    pub sampler_priority: u8,
    pub stall: u64,
    pub refuses_unlisted: bool,
}

pub(super) struct Node {
    pub name: String,
    pub client: Client,
    pub executor: Option<At<Executor>>,
    pub host: Option<At<String>>,
    pub core: Option<At<i64>>,
    pub at: usize,
}

pub(super) struct Topic {
    pub name: String,
    pub type_name: Option<String>,
    pub depth: Option<At<u64>>,
    pub is_auto: bool,
    pub remote: bool,
    pub priority: Option<LinkPriority>,
    pub express: bool,
    pub period: Option<At<u64>>,
    pub jitter: u64,
    pub min_distance: Option<At<u64>>,
}

pub(super) struct Group {
    pub name: String,
    pub at: usize,
    pub order: Option<At<Order>>,
    pub priority: Option<At<u8>>,
    pub thread_priority: Option<At<ThreadPriority>>,
    /// Whether publishers wake its thread, if that is stated.
    pub direct_wake: Option<At<bool>>,
}

impl Node {
    pub fn executor(&self) -> Executor {
        self.executor.as_ref().map_or(Executor::SingleThreaded, |executor| executor.value)
    }
}

impl Group {
    /// Whether its thread runs the callback with the highest priority first.
    pub fn is_ranked(&self) -> bool {
        self.order.as_ref().is_some_and(|order| order.value == Order::Priority)
    }

    /// Which priority its thread has.
    pub fn thread_priority(&self) -> ThreadPriority {
        self.thread_priority.as_ref().map_or(ThreadPriority::Group, |priority| priority.value)
    }

    /// Whether its thread has the priority of the callback that it runs.
    pub fn has_priority_of_callback(&self) -> bool {
        self.is_ranked() && self.thread_priority() == ThreadPriority::Callback
    }
}

pub(super) struct Callback {
    pub name: String,
    pub at: usize,
    pub node: Option<At<String>>,
    /// The topics that trigger it, or that it waits for.
    pub topics: Vec<At<String>>,
    /// Where `all` is, if it waits for all of its topics.
    pub all: Option<usize>,
    /// Whether there is a `topic`.
    pub has_topic: bool,
    pub window: Option<At<u64>>,
    pub policy: Option<At<JoinPolicy>>,
    pub take: Option<At<u64>>,
    pub period: Option<At<u64>>,
    /// Whether the file has any entry about a trigger, even an invalid one.
    pub triggered: bool,
    pub wcet: Option<At<u64>>,
    pub input_max: Option<u64>,
    pub bcet: Option<At<u64>>,
    pub deadline: Option<At<u64>>,
    pub jitter: Option<At<u64>>,
    pub min_distance: Option<At<u64>>,
    pub non_preemptive: Option<At<u64>>,
    pub priority: Option<At<u8>>,
    pub shares_priority: bool,
    /// Whether publishers wake its thread, if that is stated.
    pub direct_wake: Option<At<bool>>,
    /// Under SCHED_DEADLINE.
    pub reservation: Option<At<Reservation>>,
    pub core: Option<At<i64>>,
    /// Where `core` is, if it is any.
    pub floats: Option<usize>,
    pub group: Option<At<String>>,
    pub overrun: Option<At<OverrunPolicy>>,
    pub publishes: Vec<At<String>>,
    pub reads: Vec<At<String>>,
    pub locks: Vec<(String, u64)>,
}

impl Callback {
    pub fn policy(&self) -> JoinPolicy {
        self.policy.as_ref().map_or(JoinPolicy::ByWindow, |policy| policy.value)
    }

    /// The position of the entry that enforces the budget of its jobs, if there is one.
    pub fn holds(&self) -> Option<usize> {
        self.overrun.as_ref().filter(|overrun| overrun.value != OverrunPolicy::Tell).map(|overrun| overrun.at)
    }
}

pub(super) struct Chain {
    pub name: String,
    pub at: usize,
    pub path: Vec<At<String>>,
    pub deadline: Option<u64>,
}

pub(super) struct Declared {
    pub policy: Policy,
    pub highest: u8,
    pub protocol: LockProtocol,
    pub costs: Costs,
    pub network: Option<(u64, u64)>,
    pub hosts: Vec<Host>,
    pub nodes: Vec<Node>,
    pub topics: Vec<Topic>,
    pub groups: Vec<Group>,
    pub callbacks: Vec<Callback>,
    pub chains: Vec<Chain>,
}
