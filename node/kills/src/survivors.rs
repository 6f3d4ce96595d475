// SPDX-License-Identifier: MIT OR Apache-2.0
//! The processes that survive beside those that are killed. Their messages to each other arrive, or are counted as lost; their requests
//! are answered, or end with an error.

use crate::Result;
use crate::process::{Said, answer, lock, say, told, wait};
use futures::executor::block_on;
use futures::{FutureExt, StreamExt};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};
use tautline::example_interfaces::action::Fibonacci;
use tautline::example_interfaces::srv::AddTwoInts;
use tautline::std_msgs::msg::UInt64;
use tautline::{
    CallbackOptions, Context, Error, Gid, GoalStatus, Node, PublishError, Publisher, Qos, SendError,
    ServiceError,
};
use tautline_transport::{EndpointKind, graph_of};

/// Messages from one survivor to the other; actors only subscribe.
pub const NUMBERS: &str = "/survivors/numbers";
/// Actors publish here, too.
pub const SHARED: &str = "/survivors/shared";
/// Keep-all: an actor that takes nothing stops the publisher as long as it lives.
pub const ALL: &str = "/survivors/all";
/// Transient local, for late joiners.
pub const KEPT: &str = "/survivors/kept";
/// Newcomers send on the first topic, and survivors answer on the second one.
pub const PING: &str = "/survivors/ping";
pub const PONG: &str = "/survivors/pong";
/// Served by a survivor, and by actors.
pub const ADD: &str = "/survivors/add";
/// Served by actors only.
pub const ACTORS_ADD: &str = "/actors/add";
pub const ACTORS_FIBONACCI: &str = "/actors/fibonacci";
/// The node with parameters that actors set.
pub const PARAMETERS: &str = "/survivor_server";

pub const KEPT_DEPTH: usize = 10;
pub const KEPT_PERIOD: Duration = Duration::from_millis(10);

/// An operation that takes longer hangs: no actor lives as long.
const PATIENCE: Duration = Duration::from_secs(5);

pub const NUMBERS_QOS: Qos = Qos::keep_last(2000);
pub const ALL_QOS: Qos = Qos::keep_all(64);
pub const KEPT_QOS: Qos = Qos::keep_last(KEPT_DEPTH).transient_local();

#[derive(Debug, Default, Serialize, Deserialize)]
pub struct Sent {
    pub numbers: u64,
    pub shared: u64,
    pub all: u64,
    /// The longest time for which an actor's full queue stopped the keep-all topic.
    pub longest_full_ms: u64,
}

#[derive(Debug, Default, Serialize, Deserialize)]
pub struct Received {
    pub numbers: Count,
    pub shared: Count,
    pub all: Count,
}

#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Count {
    pub received: u64,
    pub lost: u64,
    /// Sequence numbers that are missing, of each publisher.
    pub missing: u64,
    /// Messages that arrived out of order, or twice.
    pub disordered: u64,
}

/// The outcomes of requests and goals, by service.
pub type Asked = BTreeMap<String, Answers>;

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Answers {
    pub asked: u64,
    pub answered: u64,
    pub errors: BTreeMap<String, u64>,
    pub slowest_ms: u64,
    /// Requests with neither an answer nor an error.
    pub hung: u64,
    /// Requests with the answer to another request.
    pub wrong: u64,
}

pub fn play(name: &str) -> Result<()> {
    let context = Context::create()?;
    match name {
        "publisher" => publisher(&context),
        "subscription" => subscription(&context),
        "server" => server(&context),
        "client" => client(&context),
        "echo" => echo(&context),
        _ => Err(format!("no survivor {name}").into()),
    }
}

/// Spins on a thread of its own until this is dropped.
pub struct Spinning {
    context: Context,
    thread: Option<JoinHandle<()>>,
}

pub fn spin(context: &Context) -> Spinning {
    let sampler = context.clone();
    let run = move || {
        if let Err(error) = sampler.spin() {
            say(&Said::Failed(format!("spin: {error}")));
        }
    };
    Spinning { context: context.clone(), thread: Some(thread::spawn(run)) }
}

impl Drop for Spinning {
    fn drop(&mut self) {
        self.context.shutdown();
        // The thread releases its part of the context before the process ends.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

fn answer_pings(node: &mut Node) -> Result<()> {
    let pings = node.subscribe::<UInt64>(PING, Qos::default())?;
    let pongs = node.create_publisher::<UInt64>(PONG, Qos::default())?;
    let answer = pings.for_each(move |ping| {
        let _ = pongs.publish(&UInt64 { data: ping.data });
        async {}
    });
    node.spawn_callback(CallbackOptions::other().name("echo"), answer)?;
    Ok(())
}

fn echo(context: &Context) -> Result<()> {
    let mut node = Node::create(context.clone(), "echo", "")?;
    answer_pings(&mut node)?;
    let _spinning = spin(context);
    say(&Said::Ready);
    told().for_each(drop);
    Ok(())
}

fn publisher(context: &Context) -> Result<()> {
    let mut node = Node::create(context.clone(), "survivor_publisher", "")?;
    let numbers = node.create_publisher::<UInt64>(NUMBERS, NUMBERS_QOS)?;
    let shared = node.create_publisher::<UInt64>(SHARED, NUMBERS_QOS)?;
    let all = node.create_publisher::<UInt64>(ALL, ALL_QOS)?;
    let kept = node.create_publisher::<UInt64>(KEPT, KEPT_QOS)?;
    answer_pings(&mut node)?;
    let _spinning = spin(context);
    say(&Said::Ready);
    let stop = Arc::new(AtomicBool::new(false));
    let mut commands = told();
    // The first command starts it, when the subscription exists.
    commands.next();
    let publish = {
        let stop = stop.clone();
        move || -> Result<Sent> {
            for (name, publisher) in [("numbers", &numbers), ("shared", &shared), ("all", &all)] {
                let is_matched = || Ok(publisher.subscription_count() > 0);
                wait(&format!("a subscription of {name}"), PATIENCE, is_matched)?;
            }
            let (mut sent, mut kept_next, mut full_since) = (Sent::default(), Instant::now(), None);
            while !stop.load(Ordering::Acquire) {
                numbers.publish(&UInt64 { data: sent.numbers + 1 })?;
                sent.numbers += 1;
                shared.publish(&UInt64 { data: sent.shared + 1 })?;
                sent.shared += 1;
                let mut loan = all.loan()?;
                loan.data = sent.all + 1;
                match loan.publish() {
                    Ok(()) => {
                        sent.all += 1;
                        full_since = None;
                    }
                    Err(SendError { error: PublishError::Full, .. }) => {
                        let since = *full_since.get_or_insert_with(Instant::now);
                        sent.longest_full_ms = sent.longest_full_ms.max(since.elapsed().as_millis() as u64);
                        if since.elapsed() > PATIENCE {
                            return Err(full(&all).into());
                        }
                    }
                    Err(other) => return Err(format!("{other:?}").into()),
                }
                if kept_next <= Instant::now() {
                    kept.publish(&UInt64 { data: 0 })?;
                    kept_next += KEPT_PERIOD;
                }
                thread::sleep(Duration::from_millis(1));
            }
            // Nothing is published any more, so that no later ring can hide a lost one.
            Ok(sent)
        }
    };
    let publishing = thread::spawn(move || {
        // Logged at once, because others notice that it has stopped.
        publish().inspect_err(|error| eprintln!("{}: the publisher: {error}", std::process::id()))
    });
    // The second command stops it.
    commands.next();
    stop.store(true, Ordering::Release);
    match publishing.join() {
        Ok(Ok(sent)) => answer(&sent),
        Ok(Err(error)) => say(&Said::Failed(error.to_string())),
        Err(_) => say(&Said::Failed("it panicked".into())),
    }
    commands.for_each(drop);
    Ok(())
}

/// The error for a queue that is full for longer than any actor lives, with the subscriptions that may be the cause.
fn full(publisher: &Publisher<UInt64>) -> String {
    let ends = || -> Result<Vec<String>> {
        let graph = graph_of(Context::domain_of_environment()?)?;
        let ends = graph.endpoints.iter();
        let ends = ends.filter(|end| end.topic == ALL && end.kind == EndpointKind::Subscription);
        Ok(ends.map(|end| format!("{:?} of {:?} ({:?})", end.gid, end.pid, end.node)).collect())
    };
    let ends = ends().unwrap_or_else(|error| vec![error.to_string()]);
    format!(
        "a queue is full for {PATIENCE:?}; {} subscriptions match; there are {ends:?}",
        publisher.subscription_count()
    )
}

/// Counts the messages that a subscription received, and those that are missing, by publisher.
#[derive(Default)]
struct Tally {
    last: HashMap<Gid, u64>,
    count: Count,
}

impl Tally {
    fn add(&mut self, publisher: Gid, number: u64) {
        self.count.received += 1;
        let last = self.last.entry(publisher).or_insert(number.saturating_sub(1));
        match number.checked_sub(*last + 1) {
            Some(missing) => {
                self.count.missing += missing;
                *last = number;
            }
            None => self.count.disordered += 1,
        }
    }
}

fn subscription(context: &Context) -> Result<()> {
    let mut node = Node::create(context.clone(), "survivor_subscription", "")?;
    let mut tallies = Vec::new();
    for (topic, qos) in [(NUMBERS, NUMBERS_QOS), (SHARED, NUMBERS_QOS), (ALL, ALL_QOS)] {
        let subscription = node.subscribe::<UInt64>(topic, qos)?;
        let (counters, tally) = (subscription.counters(), Arc::new(Mutex::new(Tally::default())));
        tallies.push((counters, tally.clone()));
        let count = subscription.for_each(move |sample| {
            let info = sample.info();
            let mut tally = lock(&tally);
            tally.add(info.publisher_gid, info.sequence_number);
            async {}
        });
        node.spawn_callback(CallbackOptions::other().name(topic), count)?;
    }
    let _spinning = spin(context);
    say(&Said::Ready);
    for _ in told() {
        let mut counts =
            tallies.iter().map(|(counters, tally)| Count { lost: counters.lost(), ..lock(tally).count });
        let mut next = || counts.next().unwrap_or_default();
        answer(&Received { numbers: next(), shared: next(), all: next() });
    }
    Ok(())
}

fn server(context: &Context) -> Result<()> {
    let mut node = Node::create(context.clone(), "survivor_server", "")?;
    let requests = node.create_service::<AddTwoInts::Service>(ADD, Qos::services_default())?.owned();
    let serve = requests.for_each(|request| {
        let AddTwoInts::Request { a, b } = request.message;
        if let Err(error) = request.respond(AddTwoInts::Response { sum: a + b }) {
            // The queue of a client is full, of an actor that does not take its answers.
            eprintln!("{}: {error}", std::process::id());
        }
        async {}
    });
    node.spawn_callback(CallbackOptions::other().name("serve"), serve)?;
    node.declare_parameter("speed", 1_i64)?;
    let (parameters, changes) = node.make_parameter_handler()?;
    node.spawn_callback(CallbackOptions::other().name("parameters"), parameters)?;
    node.spawn_callback(CallbackOptions::other().name("changes"), changes.for_each(|_| async {}))?;
    let _spinning = spin(context);
    say(&Said::Ready);
    told().for_each(drop);
    Ok(())
}

/// Sends one request after the other until `stop` is set. `ask` returns whether the answer is right.
fn ask(
    name: &'static str,
    asked: &Arc<Mutex<Asked>>,
    stop: &Arc<AtomicBool>,
    mut ask: impl FnMut() -> std::result::Result<bool, Error> + Send + 'static,
) -> JoinHandle<()> {
    let (asked, stop) = (asked.clone(), stop.clone());
    thread::spawn(move || {
        while !stop.load(Ordering::SeqCst) {
            let start = Instant::now();
            let answer = ask();
            let mut asked = lock(&asked);
            let answers = asked.entry(name.to_owned()).or_default();
            answers.asked += 1;
            answers.slowest_ms = answers.slowest_ms.max(start.elapsed().as_millis() as u64);
            match answer {
                Ok(true) => answers.answered += 1,
                Ok(false) => answers.wrong += 1,
                Err(Error::ServiceTimeout { .. }) => answers.hung += 1,
                Err(error) => *answers.errors.entry(kind(&error)).or_default() += 1,
            }
            drop(asked);
            thread::sleep(Duration::from_millis(2));
        }
    })
}

/// The outcome of a request to a server that takes none.
pub const FULL: &str = "requests full";

/// The possible outcomes of a request whose server is killed, or rejects it.
pub const OF_SERVERS_THAT_GO: [&str; 3] = ["no server", "server gone", "goal rejected"];

fn kind(error: &Error) -> String {
    let [none, gone, rejected] = OF_SERVERS_THAT_GO;
    match error {
        Error::Service(ServiceError::NoServer { .. }) => none.into(),
        Error::Service(ServiceError::ServerGone { .. }) => gone.into(),
        Error::Service(ServiceError::RequestsFull { .. }) => FULL.into(),
        Error::GoalRejected { .. } => rejected.into(),
        // The server ended between the two requests.
        Error::GoalUnheard { source, .. } => kind(source),
        other => other.to_string(),
    }
}

fn client(context: &Context) -> Result<()> {
    let mut node = Node::create(context.clone(), "survivor_client", "")?;
    let (asked, stop): (Arc<Mutex<Asked>>, Arc<AtomicBool>) = Default::default();
    let mut clients = Vec::new();
    for name in [ADD, ACTORS_ADD] {
        clients.push((name, node.create_client::<AddTwoInts::Service>(name)?));
    }
    let actions = node.create_action_client::<Fibonacci::Action>(ACTORS_FIBONACCI)?;
    let _spinning = spin(context);
    say(&Said::Ready);
    let mut commands = told();
    commands.next();
    let mut asking = Vec::new();
    for (name, client) in clients {
        asking.push(ask(name, &asked, &stop, move || {
            let response = block_on(client.request_timeout(&AddTwoInts::Request { a: 2, b: 3 }, PATIENCE)?)?;
            Ok(response.sum == 5)
        }));
    }
    // A goal has no time limit of its own, so an alarm limits all of its steps.
    let clock = node.context().events().clone();
    asking.push(ask(ACTORS_FIBONACCI, &asked, &stop, move || {
        let mut alarm = tautline_sampler::Alarm::new(&clock)?;
        let limit = tautline_rt::clock::monotonic_ns() + PATIENCE.as_nanos() as u64;
        alarm.set(Some(limit));
        let goal = actions.send_goal_request(Fibonacci::Goal { order: 5 })?;
        let pursue = async {
            let (_goal, result, feedback) = goal.await?;
            let (_, result) = futures::join!(feedback.for_each(|_| async {}), result);
            let (status, result) = result?;
            Ok(status != GoalStatus::Succeeded || result.sequence == [5])
        };
        let late = std::future::poll_fn(|context| alarm.poll(context));
        block_on(async {
            futures::select_biased! {
                outcome = pursue.fuse() => outcome,
                () = late.fuse() => Err(Error::ServiceTimeout { service: ACTORS_FIBONACCI.into(), timeout: PATIENCE }),
            }
        })
    }));
    for command in commands {
        if command == "stop" {
            stop.store(true, Ordering::SeqCst);
            let have_ended = || Ok(asking.iter().all(JoinHandle::is_finished));
            if wait("the last answers", 2 * PATIENCE, have_ended).is_err() {
                say(&Said::Failed("a request neither ends nor fails".into()));
            } else if asking.drain(..).any(|thread| thread.join().is_err()) {
                say(&Said::Failed("a thread that asks panicked".into()));
            }
        }
        answer(&*lock(&asked));
    }
    Ok(())
}
