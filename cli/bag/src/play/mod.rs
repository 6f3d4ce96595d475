// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut play`: publishes the messages of a bag at the times of their reception.
//!
//! `feeder` reads the bag in order into a ring of locked memory; `player` publishes from the ring at absolute times.

mod args;
mod console;
mod feeder;
mod player;
mod stand_in;
mod statement;

pub use args::PlayArgs;

use crate::definitions::{from_bag, recorded_type};
use crate::offered_qos;
use args::PRIORITY;
use feeder::{Fed, Feeder, Part};
use player::{Clock, Control, Player};
use stand_in::StandIn;
use statement::{Role, Statement};
use std::cell::Cell;
use std::collections::BTreeSet;
use std::fmt::Display;
use std::num::NonZeroU64;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use taut_cli::arguments::full_name;
use taut_cli::verb::{End, Failure, Outcome};
use tautline_bag::{CDR, Ordered, Topic};
use tautline_definitions::{find_schema, type_of};
use tautline_rt::{self as rt, CoreSet, MemoryLock, Policy, ThreadBuilder};
use tautline_schema::{Schema, SchemaError, TypeName};
use tautline_transport::{
    Durability, EndpointKind, Limits, Participant, Qos, RawPublisher, TopicType, Visitor,
};

/// How long subscriptions of another host or of ROS may take to discover a publisher.
const FAR: Duration = Duration::from_secs(1);

/// How long a gateway or bridge may take to take a topic.
const PATIENCE: Duration = Duration::from_secs(5);

/// The topics that are played.
struct Chosen {
    roles: Vec<Role>,
    /// The role of each topic of the bag.
    numbers: Vec<Option<usize>>,
    /// Topics that cannot be played and were not named in the command, with the reason.
    unplayable: Vec<String>,
}

pub fn run(args: &PlayArgs) -> Outcome {
    let domain = args.common.domain()?;
    let control = Arc::new(Control::default());
    control.is_paused.store(args.paused, Ordering::Relaxed);
    console::listen(&control)?;
    // Until `End::of` below, a signal ends the process at once.
    let bag = {
        let since = Instant::now();
        let tell = &mut |path: &Path| {
            if since.elapsed() > Duration::from_secs(1) {
                eprintln!("taut: looking through {}", path.display());
            }
        };
        Ordered::open(&args.bag, tell)?
    };
    let mut end = End::of(&args.common)?;
    let (from_ns, to_ns) = args.range(&bag)?;
    if let Some(core) = args.core {
        CoreSet::one(core).check().map_err(|error| Failure::unusable(format!("--core: {error}")))?;
    }
    let stand_in = args.stand_in(domain)?;
    let Chosen { roles, numbers, unplayable } = args.choose(&bag, stand_in.as_ref())?;
    let participant = Participant::new(domain)?;
    let (name, namespace) = match &stand_in {
        Some(stand_in) => stand_in.name(&participant)?,
        None => (format!("taut_play_{}", std::process::id()), "/".to_owned()),
    };
    let node = participant.create_node(&name, &namespace)?;
    let participant = participant.for_node(&node);
    args.refuse_live(&participant, &roles)?;

    if let Err(error) = rt::lock_memory(MemoryLock::OnFault) {
        eprintln!("taut: warning: the buffers are not locked into memory: {error}");
    }
    let (producer, consumer) = crate::ring::touched(args.budget)?;
    let start_ns = bag.span_ns().map_or(0, |(start_ns, _)| start_ns);
    let feeder = Feeder {
        bag,
        numbers,
        parts: roles.iter().map(|role| role.part.clone()).collect(),
        producer,
        control: control.clone(),
        start_ns,
        from_ns,
        to_ns,
        times: args.again.map_or(Some(1), |times| times.map(NonZeroU64::get)),
        given: 0,
        latched: None,
        generation: 0,
        fed: Fed::default(),
        filling: None,
        rate: args.rate,
    };
    let feeder = std::thread::spawn(move || feeder.run());
    let is_filled = || Ok((control.is_filled.load(Ordering::Acquire) || feeder.is_finished()).then_some(()));
    let ready = end.wait(|| "the bag to be read".to_owned(), is_filled).and_then(|()| {
        let publishers = publishers(&participant, &roles)?;
        let clock = args.clock.map(|hz| clock(&participant, hz)).transpose()?;
        args.wait_for_subscriptions(domain, &roles, &publishers, &end)?;
        Ok((publishers, clock))
    });
    let (publishers, clock) = match ready {
        Ok(ready) => ready,
        Err(failure) => {
            control.stop.store(true, Ordering::Relaxed);
            let _ = feeder.join();
            return Err(failure);
        }
    };
    let player = Player::new(consumer, publishers, clock, args.rate, control.clone());
    let policy = args.policy(stand_in.as_ref());
    let mut thread = ThreadBuilder::new("player").policy(policy);
    if let Some(cores) = args.core.map(CoreSet::one).or(stand_in.as_ref().map(StandIn::cores)) {
        thread = thread.cores(cores);
    }
    let _shown = stand_in.as_ref().map(|stand_in| stand_in.show(domain, policy)).transpose()?;
    let thread = thread.spawn(move || move || player.run())?;
    end.restart();
    let until = if args.again == Some(None) { ", until Ctrl-C" } else { "" };
    let topics = roles.iter().map(|role| &role.name).collect::<BTreeSet<_>>().len();
    eprintln!("playing {topics} topics of {} in domain {domain}{until}", args.bag.display());
    console::watch(&control, &end, start_ns, args.common.json, || thread.is_finished());
    let is_interrupted = !thread.is_finished();
    control.stop.store(true, Ordering::Relaxed);
    let played = thread.join()?;
    let fed = feeder.join().map_err(|_| Failure::unusable("the thread that reads the bag panicked"))?;
    Statement { args, roles: &roles, unplayable, played, fed, is_interrupted }.print()
}

impl PlayArgs {
    fn policy(&self, stand_in: Option<&StandIn>) -> Policy {
        if self.no_rt {
            return Policy::Other { nice: 0 };
        }
        let priority = self.priority.or(stand_in.map(StandIn::priority)).unwrap_or(PRIORITY);
        match rt::permission::realtime_permitted(priority) {
            Ok(()) => Policy::Fifo(priority),
            Err(error) => {
                eprintln!("taut: warning: messages are published at an ordinary priority: {error}");
                Policy::Other { nice: 0 }
            }
        }
    }

    fn choose(&self, bag: &Ordered, stand_in: Option<&StandIn>) -> Outcome<Chosen> {
        let names: Vec<_> = match stand_in {
            None => self.topics.iter().map(|name| full_name(name)).collect(),
            Some(stand_in) => stand_in.topics().collect(),
        };
        let there = || bag.topics().iter().map(|topic| &*topic.name);
        let mut asked = names.iter().chain(self.remap.iter().map(|(from, _)| from));
        if let Some(unknown) = asked.find(|name| !there().any(|there| there == *name)) {
            let list = format!("bag info {}", self.bag.display());
            return Err(Failure::unknown("topic", unknown, there(), &list));
        }
        let is_wanted = |name: &str| {
            let is_chosen = match &self.regex {
                Some(regex) => regex.is_match(name),
                None => names.is_empty(),
            };
            (is_chosen || names.iter().any(|wanted| wanted == name))
                && !self.exclude.as_ref().is_some_and(|regex| regex.is_match(name))
                && !(self.clock.is_some() && name == "/clock")
        };
        let (mut roles, mut numbers, mut unplayable) = (Vec::new(), Vec::new(), Vec::new());
        for topic in bag.topics() {
            if !is_wanted(&topic.name) {
                numbers.push(None);
                continue;
            }
            match self.role(topic) {
                Ok(role) => {
                    numbers.push(Some(roles.len()));
                    roles.push(role);
                }
                Err(error) if names.contains(&topic.name) => {
                    return Err(Failure::unusable(format!("{error}; leave it out with -x")));
                }
                Err(error) => {
                    eprintln!("taut: warning: {error}");
                    unplayable.push(error);
                    numbers.push(None);
                }
            }
        }
        match (roles.is_empty(), unplayable.first()) {
            (false, _) => Ok(Chosen { roles, numbers, unplayable }),
            (true, Some(first)) => {
                Err(Failure::unusable(format!("no topic of the bag can be played; the first: {first}")))
            }
            (true, None) => Err(Failure::unusable(
                "no topic of the bag is chosen; `taut bag info` prints which there are",
            )),
        }
    }

    /// The role of a topic, or the reason why it cannot be played.
    fn role(&self, topic: &Arc<Topic>) -> Result<Role, String> {
        let name = self.remap.iter().find(|(from, _)| *from == topic.name).map_or(&topic.name, |(_, to)| to);
        let unplayable = |why: &dyn Display| format!("{} cannot be played: {why}", topic.name);
        if topic.encoding != CDR {
            return Err(unplayable(&format!("its messages are {}, not {CDR}", topic.encoding)));
        }
        let type_name = topic.type_name.parse().map_err(|error: SchemaError| unplayable(&error))?;
        let (schema, topic_type) = described(topic, &type_name);
        let qos = offered_qos::read(&topic.qos).unwrap_or_else(|error| {
            eprintln!(
                "taut: warning: {}: its recorded QoS cannot be read, so it has the default: {error}",
                topic.name
            );
            Qos::default()
        });
        let kept = if qos.durability == Durability::TransientLocal { qos.depth } else { 0 };
        let part = Part { schema, kept, largest: Arc::default() };
        Ok(Role { name: name.clone(), topic: topic.clone(), topic_type, qos, part })
    }

    /// Refuses to play topics that already have publishers, unless `--mix` allows it.
    fn refuse_live(&self, participant: &Participant, roles: &[Role]) -> Outcome {
        if self.mix {
            return Ok(());
        }
        let graph = participant.graph()?;
        let names: BTreeSet<_> =
            roles.iter().map(|role| &*role.name).chain(self.clock.map(|_| "/clock")).collect();
        let is_live = |name: &&str| {
            graph.endpoints.iter().any(|end| end.kind == EndpointKind::Publisher && end.topic == *name)
        };
        let live: Vec<_> = names.into_iter().filter(is_live).collect();
        if live.is_empty() {
            return Ok(());
        }
        Err(Failure::unusable(format!(
            "{} {} live publishers, and subscriptions would get both; leave them out with -x, play on other topics with --remap, or \
             beside them with --mix",
            live.join(", "),
            if live.len() == 1 { "has" } else { "have" }
        )))
    }

    /// Waits until existing subscriptions are connected.
    fn wait_for_subscriptions(
        &self,
        domain: u32,
        roles: &[Role],
        publishers: &[RawPublisher],
        end: &End,
    ) -> Outcome {
        let mut visitor = Visitor::new(domain)?;
        let (missing, mut is_far, since) = (Cell::new(""), false, Instant::now());
        let what = || format!("a subscription of '{}'", missing.get());
        end.wait(what, || {
            let graph = visitor.graph()?;
            for (role, publisher) in roles.iter().zip(publishers) {
                let ends = graph.endpoints.iter().filter(|end| {
                    end.kind == EndpointKind::Subscription
                        && end.topic == role.name
                        && end.topic_type.agrees_with(&role.topic_type)
                        && role.qos.incompatibility(&end.qos).is_none()
                });
                let (far, here): (Vec<_>, Vec<_>) = ends.partition(|end| end.is_remote);
                let wanted = here.len().max(usize::from(self.wait && far.is_empty()));
                missing.set(&role.name);
                if publisher.subscription_count() < wanted {
                    return Ok(None);
                }
                if far.is_empty() {
                    continue;
                }
                // A gateway or bridge subscribes on their behalf.
                let own = graph.endpoints.iter().find(|end| end.gid == publisher.gid());
                let Some(own) = own else { return Ok(None) };
                if visitor.overwritten(own)?.is_empty() {
                    if !self.wait && since.elapsed() > PATIENCE {
                        eprintln!(
                            "taut: warning: no gateway or bridge takes {} for those elsewhere",
                            role.name
                        );
                        continue;
                    }
                    return Ok(None);
                }
                is_far = true;
            }
            Ok(Some(()))
        })?;
        if is_far {
            eprintln!("taut: subscriptions are elsewhere, too: what arrives there is not known here");
            end.pause(FAR);
        }
        Ok(())
    }
}

/// The definition of a topic's type, and the type as it is published.
fn described(topic: &Topic, name: &TypeName) -> (Option<Arc<Schema>>, TopicType) {
    let recorded = recorded_type(topic);
    let warn = |error: &SchemaError| {
        eprintln!("taut: warning: {}: its recorded definition cannot be used: {error}", topic.name);
    };
    let schema = topic.ros2msg().and_then(|text| from_bag(name, &text).inspect_err(warn).ok()).map(Arc::new);
    let schema = schema.or_else(|| find_schema(&topic.name, name, Some(&recorded)).ok());
    let agreed =
        schema.map(|schema| (type_of(&schema), schema)).filter(|(known, _)| known.agrees_with(&recorded));
    match agreed {
        Some((topic_type, schema)) => (Some(schema), topic_type),
        None => {
            eprintln!(
                "taut: warning: {}: the definition of {} is not known, so what is sent is not checked",
                topic.name, topic.type_name
            );
            (None, recorded)
        }
    }
}

/// Creates the publishers, with room for half as much again as the longest message read so far.
fn publishers(participant: &Participant, roles: &[Role]) -> Outcome<Vec<RawPublisher>> {
    let publisher = |role: &Role| {
        let largest = role.part.largest.load(Ordering::Relaxed);
        let message_bytes =
            (largest + largest / 2).clamp(Limits::default().message_bytes, Limits::MAX_MESSAGE_BYTES);
        let limits = Limits { message_bytes, ..Limits::default() };
        Ok(participant.create_raw_publisher(&role.name, &role.topic_type, role.qos, limits)?)
    };
    roles.iter().map(publisher).collect()
}

fn clock(participant: &Participant, hz: f64) -> Outcome<Clock> {
    let name: TypeName = "rosgraph_msgs/msg/Clock".parse()?;
    let topic_type = type_of(&*find_schema("/clock", &name, None)?);
    let publisher =
        participant.create_raw_publisher("/clock", &topic_type, Qos::keep_last(1), Limits::default())?;
    Ok(Clock { publisher, period_ns: (1e9 / hz) as u64 })
}
