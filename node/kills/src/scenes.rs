// SPDX-License-Identifier: MIT OR Apache-2.0
//! Scenes in which one process is killed at each of its system calls, and another process, its friend, survives.

use crate::Result;
use crate::inspector::Met;
use crate::process::{PATIENCE, Said, answer, say, told, wait};
use crate::survivors::{PING, PONG};
use clap::ValueEnum;
use futures::FutureExt;
use std::sync::mpsc::{TryRecvError, channel};
use std::thread;
use std::time::{Duration, Instant};
use tautline::Context;
use tautline::example_interfaces::srv::AddTwoInts;
use tautline::std_msgs::msg::UInt64;
use tautline_transport::{
    Client, Limits, Participant, PendingResponse, PublishError, Publisher, Qos, Sample, Server, Subscription,
};

const FRIENDS_NUMBERS: &str = "/friend/numbers";
const FRIENDS_KEPT: &str = "/friend/kept";
const FRIENDS_ALL: &str = "/friend/all";
const FRIENDS_ADD: &str = "/friend/add";
const NUMBERS: &str = "/killed/numbers";
const KEPT: &str = "/killed/kept";
const ADD: &str = "/killed/add";

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Scene {
    /// A process has every kind of end, uses each, ends.
    Ends,
    /// Subscriptions find the friend's publishers, hold samples, go.
    Attach,
    /// A process is the first one of the domain, cleans up after another one, and is the last one to go.
    Warden,
}

impl Scene {
    pub fn name(self) -> String {
        self.to_possible_value().map(|value| value.get_name().to_owned()).unwrap_or_default()
    }
}

pub fn play(name: &str) -> Result<()> {
    let domain = Context::domain_of_environment()?;
    say(&Said::Ready);
    match name {
        "friend" => return be_friend(domain),
        "victim" => return be_victim(domain),
        _ => {}
    }
    let mut commands = told();
    // From here on the process is traced.
    commands.next();
    match name {
        "ends" => ends(domain),
        "attach" => attach(domain),
        "warden" => warden(domain, commands),
        _ => Err(format!("no scene {name}").into()),
    }
}

/// Waits for a condition that another process fulfils, with a time limit.
fn until(what: &str, is_so: impl FnMut() -> Result<bool>) -> Result<()> {
    wait(what, PATIENCE / 2, is_so)
}

fn publisher(participant: &Participant, topic: &str, qos: Qos) -> Result<Publisher<UInt64>> {
    Ok(participant.create_publisher(topic, qos, Limits::default())?)
}

fn subscription(participant: &Participant, topic: &str, qos: Qos) -> Result<Subscription<UInt64>> {
    Ok(participant.create_subscription(topic, qos, Limits::default())?)
}

fn server(participant: &Participant, service: &str) -> Result<Server<AddTwoInts::Service>> {
    Ok(participant.create_server(service, 10, Limits::default())?)
}

fn client(participant: &Participant, service: &str) -> Result<Client<AddTwoInts::Service>> {
    Ok(participant.create_client(service, Limits::default())?)
}

/// Answers the waiting requests. Returns their number.
fn serve(server: &mut Server<AddTwoInts::Service>) -> Result<usize> {
    let mut count = 0;
    while let Some(request) = server.try_take()? {
        let sum = request.a + request.b;
        // The client may have ended.
        let _ = server.respond(request.id(), &AddTwoInts::Response { sum });
        count += 1;
    }
    Ok(count)
}

const KEPT_QOS: Qos = Qos::keep_last(5).transient_local();
const ALL_QOS: Qos = Qos::keep_all(8);

fn ends(domain: u32) -> Result<()> {
    let participant = Participant::new(domain)?;
    let node = participant.create_node("killed", "/")?;
    let participant = participant.for_node(&node);
    let numbers = publisher(&participant, NUMBERS, Qos::default())?;
    let friends_numbers = subscription(&participant, FRIENDS_NUMBERS, Qos::default())?;
    let kept = publisher(&participant, KEPT, KEPT_QOS)?;
    (0..3).try_for_each(|data| kept.publish(&UInt64 { data }))?;
    let friends_kept = subscription(&participant, FRIENDS_KEPT, KEPT_QOS)?;
    let mut server = server(&participant, ADD)?;
    let client = client(&participant, FRIENDS_ADD)?;
    until("the friend's numbers", || Ok(friends_numbers.try_take()?.is_some()))?;
    let mut held = None;
    until("what the friend had kept", || {
        held = friends_kept.try_take()?;
        Ok(held.is_some())
    })?;
    until("the friend to match", || Ok(numbers.subscription_count() > 0 && kept.subscription_count() > 0))?;
    (0..5).try_for_each(|data| numbers.publish(&UInt64 { data }))?;
    until("the friend's service", || Ok(client.server_count() > 0))?;
    let mut pending = client.request(&AddTwoInts::Request { a: 1, b: 2 })?;
    until("the friend's answer", || Ok((&mut pending).now_or_never().transpose()?.is_some()))?;
    until("the friend's request", || Ok(serve(&mut server)? > 0))?;
    participant.graph()?;
    drop(kept);
    drop(client);
    drop(friends_kept);
    drop(held);
    Ok(())
}

fn attach(domain: u32) -> Result<()> {
    let participant = Participant::new(domain)?;
    for _ in 0..2 {
        let numbers = subscription(&participant, FRIENDS_NUMBERS, Qos::keep_last(100))?;
        let kept = subscription(&participant, FRIENDS_KEPT, KEPT_QOS)?;
        let all = subscription(&participant, FRIENDS_ALL, ALL_QOS)?;
        let mut held: Vec<Sample<UInt64>> = Vec::new();
        for subscription in [&numbers, &kept, &all] {
            until("a sample to hold", || {
                held.extend(subscription.try_take()?);
                Ok(held.last().is_some())
            })?;
        }
        until("a full queue", || Ok(all.try_take()?.is_some()))?;
        drop(all);
        drop(numbers);
        drop(held);
        drop(kept);
    }
    Ok(())
}

fn warden(domain: u32, mut commands: impl Iterator<Item = String>) -> Result<()> {
    let participant = Participant::new(domain)?;
    let numbers = subscription(&participant, NUMBERS, Qos::keep_last(100))?;
    let kept = publisher(&participant, KEPT, KEPT_QOS)?;
    kept.publish(&UInt64 { data: 1 })?;
    say(&Said::At("joined".into()));
    // The victim has died.
    commands.next();
    until("what the victim sent", || Ok(numbers.try_take()?.is_some()))?;
    until("the victim's end", || {
        while numbers.try_take()?.is_some() {}
        Ok(numbers.publisher_count() == 0)
    })?;
    say(&Said::At("cleaned up".into()));
    // The friend has left.
    commands.next();
    Ok(())
}

/// Joins on command, sends a message to the warden, and is killed.
fn be_victim(domain: u32) -> Result<()> {
    let mut commands = told();
    if commands.next().is_none() {
        return Ok(());
    }
    let participant = Participant::new(domain)?;
    let numbers = publisher(&participant, NUMBERS, Qos::keep_last(100))?;
    let _kept = subscription(&participant, KEPT, KEPT_QOS)?;
    (0..10).try_for_each(|data| numbers.publish(&UInt64 { data }))?;
    say(&Said::Ready);
    commands.for_each(drop);
    Ok(())
}

/// The endpoints of the surviving process, which sends, takes, requests and answers all the time.
struct Ends {
    participant: Participant,
    numbers: Publisher<UInt64>,
    _kept: Publisher<UInt64>,
    all: Publisher<UInt64>,
    server: Server<AddTwoInts::Service>,
    client: Client<AddTwoInts::Service>,
    pending: Option<PendingResponse<AddTwoInts::Service>>,
    takers: Vec<Subscription<UInt64>>,
    pings: Subscription<UInt64>,
    pongs: Publisher<UInt64>,
    full_since: Option<Instant>,
}

impl Ends {
    fn new(domain: u32) -> Result<Self> {
        let participant = Participant::new(domain)?;
        let kept = publisher(&participant, FRIENDS_KEPT, KEPT_QOS)?;
        (0..5).try_for_each(|data| kept.publish(&UInt64 { data }))?;
        Ok(Ends {
            numbers: publisher(&participant, FRIENDS_NUMBERS, Qos::default())?,
            _kept: kept,
            all: publisher(&participant, FRIENDS_ALL, ALL_QOS)?,
            server: server(&participant, FRIENDS_ADD)?,
            client: client(&participant, ADD)?,
            pending: None,
            takers: vec![
                subscription(&participant, NUMBERS, Qos::default())?,
                subscription(&participant, KEPT, KEPT_QOS)?,
            ],
            pings: subscription(&participant, PING, Qos::default())?,
            pongs: publisher(&participant, PONG, Qos::default())?,
            full_since: None,
            participant,
        })
    }

    fn turn(&mut self) -> Result<()> {
        self.numbers.publish(&UInt64 { data: 1 })?;
        match self.all.publish(&UInt64 { data: 1 }) {
            Err(PublishError::Full) => _ = self.full_since.get_or_insert_with(Instant::now),
            other => {
                other?;
                self.full_since = None;
            }
        }
        serve(&mut self.server)?;
        for taker in &self.takers {
            while taker.try_take()?.is_some() {}
        }
        while let Some(ping) = self.pings.try_take()? {
            self.pongs.publish(&UInt64 { data: ping.data })?;
        }
        self.pending = match self.pending.take() {
            Some(mut pending) => (&mut pending).now_or_never().is_none().then_some(pending),
            // There may be no server.
            None => self.client.request(&AddTwoInts::Request { a: 1, b: 2 }).ok(),
        };
        Ok(())
    }

    /// Creates a publisher and a subscription, and passes a message between them.
    fn meet(&self) -> Result<Met> {
        let (start, mut met) = (Instant::now(), Met::default());
        let subscription = subscription(&self.participant, "/friend/fresh", Qos::default())?;
        let publisher = publisher(&self.participant, "/friend/fresh", Qos::default())?;
        met.made = start.elapsed();
        until("its own subscription", || Ok(publisher.subscription_count() > 0))?;
        met.matched = start.elapsed();
        publisher.publish(&UInt64 { data: 1 })?;
        until("its own message", || Ok(subscription.try_take()?.is_some()))?;
        met.answered = start.elapsed();
        Ok(met)
    }
}

fn be_friend(domain: u32) -> Result<()> {
    let (sender, commands) = channel();
    thread::spawn(move || told().try_for_each(|command| sender.send(command)));
    let mut ends: Option<Ends> = None;
    loop {
        match commands.try_recv().as_deref() {
            Ok("join") => {
                ends = Some(Ends::new(domain)?);
                say(&Said::Ready);
            }
            Ok("leave") => {
                ends = None;
                say(&Said::Ready);
            }
            Ok("has_joined") => answer(&ends.is_some()),
            Ok("meet") => answer(&ends.as_ref().ok_or("it has not joined")?.meet()?),
            // The time for which a subscription that takes nothing any more has kept the friend from publishing.
            Ok("full") => {
                let full_since = ends.as_ref().and_then(|ends| ends.full_since);
                answer(&full_since.map_or(Duration::ZERO, |since| since.elapsed()));
            }
            Ok(other) => return Err(format!("the friend is told '{other}'").into()),
            Err(TryRecvError::Disconnected) => return Ok(()),
            Err(TryRecvError::Empty) => {
                if let Some(ends) = &mut ends {
                    ends.turn()?;
                }
                thread::sleep(Duration::from_millis(1));
            }
        }
    }
}
