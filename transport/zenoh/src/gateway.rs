// SPDX-License-Identifier: MIT OR Apache-2.0
//! The gateway: joins the domain and the network, and starts its threads.

use crate::config::{ConfigError, SessionConfig, is_loopback};
use crate::descriptions::Descriptions;
use crate::events::{Events, ends_to, tokens_to};
use crate::options::Options;
use crate::origin::ended_wildcard;
use crate::outgoing::{self, THREADS};
use crate::services::NetworkServices;
use crate::session::{self, SessionError, network_threads};
use crate::side::NetworkSide;
use crate::stats::{GatewayState, Stats};
use crate::unclaimed::ClaimThread;
use crate::wire::{Token, token_wildcard};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use tautline_relay::{
    Event, Guard, Instance, InstanceError, InstanceLock, Latest, MirrorControl, Parts, RelayError, Rules,
    Services, watch_domain,
};
use tautline_rt::{JoinHandle, Policy, Realtime, RtError, ThreadBuilder, ThreadInfo};
use tautline_schema::SchemaError;
use tautline_transport::{Participant, RemoteGraph, SchemaStore, TransportError};
use zenoh::{Session, Wait};

/// Why a gateway could not start.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GatewayError {
    /// Another gateway runs, or the lock file failed.
    #[error(transparent)]
    Instance(#[from] InstanceError),
    /// Invalid configuration.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// Zenoh could not start.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// Shared memory of the domain failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// A thread could not start.
    #[error(transparent)]
    Threads(#[from] RtError),
    /// The built-in definition of the type description service is invalid.
    #[error("built-in type definitions are invalid, build again from a clean checkout: {0}")]
    Definitions(Box<SchemaError>),
    /// A Zenoh call failed.
    #[error("{what} failed in Zenoh: {reason}")]
    Zenoh {
        /// The step.
        what: &'static str,
        /// Zenoh's error.
        reason: String,
    },
}

impl From<RelayError> for GatewayError {
    fn from(error: RelayError) -> Self {
        match error {
            RelayError::Transport(error) => GatewayError::Transport(error),
            RelayError::Rt(error) => GatewayError::Threads(error),
        }
    }
}

/// A running gateway. Dropping it withdraws tokens, closes links, ends threads and releases the lock.
pub struct Gateway {
    events: Events,
    state: Arc<GatewayState>,
    control: Option<JoinHandle<()>>,
    watch: Option<JoinHandle<()>>,
    guard: Option<Guard>,
    config: SessionConfig,
    session: Session,
    _lock: InstanceLock,
}

/// Capacity of the event queue; on overflow all tokens are requested again.
const EVENTS: usize = 16_384;

impl Gateway {
    /// Starts a gateway in this process: about eight threads. The caller's real-time threads wait for none of them.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`GatewayError`]: another gateway of the domain, an invalid configuration, a missing privilege.
    pub fn spawn(options: Options) -> Result<Self, GatewayError> {
        let lock = Instance::gateway(options.domain).lock()?;
        Self::spawn_in(options, lock)
    }

    /// Like [`spawn`](Self::spawn), with a lock from [`Instance::wait`].
    pub fn spawn_in(options: Options, lock: InstanceLock) -> Result<Self, GatewayError> {
        Self::spawn_while(options, lock, |_| true)
    }

    /// Like [`spawn_in`](Self::spawn_in), but gives up when `go_on` returns false. `go_on` is called every 50 ms while the session opens.
    /// A client's session opens once it has its link: never, if no router answers.
    ///
    /// # Errors
    /// As [`spawn`](Self::spawn), and [`SessionError::GivenUp`].
    pub fn spawn_while(
        options: Options,
        lock: InstanceLock,
        mut go_on: impl FnMut(&SessionConfig) -> bool,
    ) -> Result<Self, GatewayError> {
        let config =
            options.network.session_config(|name| std::env::var(name).ok(), options.max_message_bytes)?;
        let participant = Participant::new(options.domain)?;
        // Marks the participant as a mirror of remote endpoints, before its first port appears.
        participant.set_remote(&RemoteGraph::default())?;
        let policy = match options.realtime {
            Realtime::Required => Policy::Fifo(options.priority),
            Realtime::Off => tautline_rt::current_policy()?,
        };
        let go_on = || go_on(&config);
        let session = session::open(config.clone(), policy, options.realtime, options.cores, go_on)?;
        let outgoing = outgoing::start(&participant, policy, options.realtime, options.cores)?;

        let (events, received) = mpsc::sync_channel(EVENTS);
        let network_domain = options.domain_there();
        let zid = u128::from_le_bytes(session.zid().to_le_bytes());
        let named = format!("{zid:x}");
        let stats = Stats { domain: options.domain, network_domain, zid: named, ..Stats::default() };
        let state = Arc::new(GatewayState {
            stop: AtomicBool::new(false),
            has_missed: AtomicBool::new(false),
            stats: Latest::new(stats),
            remote: Latest::default(),
        });
        let refused =
            |what| move |error: zenoh::Error| GatewayError::Zenoh { what, reason: error.to_string() };
        let tokens = session
            .liveliness()
            .declare_subscriber(token_wildcard(network_domain))
            .history(true)
            .callback(tokens_to(events.clone(), state.clone()))
            .wait()
            .map_err(refused("subscribing to liveliness tokens"))?;
        let ends = session
            .liveliness()
            .declare_subscriber(ended_wildcard(network_domain))
            .callback(ends_to(events.clone(), zid))
            .wait()
            .map_err(refused("subscribing to the ends of publishers"))?;
        let thread = |name: &str| {
            let builder = ThreadBuilder { cores: options.cores, ..ThreadBuilder::new(name) };
            // Calls into Zenoh need a deep stack.
            builder.policy(policy).realtime(options.realtime).stack_bytes(2 << 20)
        };
        let services = NetworkServices::new(&session, network_domain, options.max_message_bytes);
        let services = Services::start(&participant, services, thread("gw-services"))?;
        let descriptions = Descriptions::new(SchemaStore::of_user(), events.clone())
            .map_err(|error| GatewayError::Definitions(error.into()))?;
        // From here on, an error drops the gateway, which ends all threads that have started.
        let (control, watch, guard) = (None, None, None);
        let mut gateway = Gateway { events, state, control, watch, guard, config, session, _lock: lock };
        gateway.watch = {
            let (participant, events) = (participant.clone(), gateway.events.clone());
            let state = gateway.state.clone();
            Some(thread("gw-watch").spawn(move || move || watch_domain(&participant, &events, &state.stop))?)
        };
        gateway.control = {
            let (session, state) = (gateway.session.clone(), gateway.state.clone());
            let rules = Rules { auto: true, filter: options.filter.clone(), ..Rules::default() };
            let claims =
                ClaimThread::start(ThreadBuilder { cores: options.cores, ..ThreadBuilder::new("gw-claim") })?;
            let (far, transit) = NetworkSide::new(
                options.clone(),
                participant.clone(),
                session,
                descriptions,
                claims,
                state.clone(),
                gateway.events.clone(),
            );
            let (participant, service_rules) = (participant.clone(), rules.clone());
            let parts = Parts { participant, far, relay: outgoing, services, transit, rules, service_rules };
            let control = MirrorControl::new(parts);
            Some(thread("gw-control").spawn(move || {
                move || {
                    let _heard = (tokens, ends);
                    control.run(&received, &state.stop);
                }
            })?)
        };
        if let (Realtime::Required, Some(budget)) = (options.realtime, options.budget) {
            let list = move || Ok(watched_threads()?.into_iter().map(|tid| (tid, policy)).collect());
            gateway.guard = Some(Guard::start("gw-budget", budget, policy, Box::new(list))?);
        }
        if options.realtime == Realtime::Required {
            gateway.check_threads(policy)?;
        }
        Ok(gateway)
    }

    /// Reads back the policies of Zenoh's threads, and corrects them.
    fn check_threads(&self, asked: Policy) -> Result<(), RtError> {
        for thread in network_threads()? {
            // The guard may have demoted the thread in the meantime.
            if thread.policy != asked && self.guard.as_ref().is_none_or(|guard| guard.demotions() == 0) {
                tautline_rt::set_policy_of(thread.tid, asked)?;
            }
        }
        Ok(())
    }

    /// The configuration of the Zenoh session.
    pub fn config(&self) -> &SessionConfig {
        &self.config
    }

    /// Listening addresses, such as `tcp/127.0.0.1:41234`.
    pub fn locators(&self) -> Vec<String> {
        self.session.info().locators().wait().iter().map(ToString::to_string).collect()
    }

    /// Whether other hosts can open a link to this host, by the configuration or by the session's listening addresses.
    pub fn is_reachable(&self) -> bool {
        self.config().is_reachable() || self.locators().iter().any(|locator| !is_loopback(locator))
    }

    /// Zenoh's threads, as reported by the kernel.
    ///
    /// # Errors
    /// [`RtError`] if `/proc` cannot be read.
    pub fn threads(&self) -> Result<Vec<ThreadInfo>, RtError> {
        network_threads()
    }

    /// The current statistics. Rates are those of the last second.
    pub fn stats(&self) -> Stats {
        let links = self.session.info().transports().wait().count();
        let throttled = self.guard.as_ref().map_or(0, Guard::demotions);
        Stats { links, throttled, ..(*self.state.stats.get()).clone() }
    }

    /// Nodes, publishers, subscriptions, services and clients of other hosts.
    pub fn remote(&self) -> Arc<Vec<Token>> {
        self.state.remote.get()
    }
}

impl Drop for Gateway {
    fn drop(&mut self) {
        self.guard = None;
        self.state.stop.store(true, Ordering::Release);
        // If the queue is full, the control thread wakes anyway and sees the flag.
        let _ = self.events.try_send(Event::Stop);
        for thread in [self.control.take(), self.watch.take()].into_iter().flatten() {
            let _ = thread.join();
        }
        let _ = self.session.close().wait();
    }
}

/// Zenoh's threads and the gateway's own.
fn watched_threads() -> Result<Vec<u32>, RtError> {
    let own = tautline_rt::threads()?.into_iter().filter(|thread| THREADS.contains(&thread.name.as_str()));
    Ok(network_threads()?.into_iter().chain(own).map(|thread| thread.tid).collect())
}
