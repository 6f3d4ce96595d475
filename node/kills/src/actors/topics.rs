// SPDX-License-Identifier: MIT OR Apache-2.0
//! Publishers and subscriptions of every kind, and managed nodes that have some.

use super::actor::Actor;
use crate::Result;
use crate::process::lock;
use crate::survivors::{ALL, ALL_QOS, KEPT, KEPT_QOS, NUMBERS, NUMBERS_QOS, SHARED};
use std::sync::{Arc, Mutex};
use tautline::lifecycle::CallbackReturn;
use tautline::std_msgs::msg::{String as Text, UInt64};
use tautline::{
    LifecycleCallbacks, LifecycleNode, ManagedNode, Message, Publisher, Qos, Sample, Subscription,
};

const TEXTS: [&str; 3] = ["/actors/a", "/actors/b", "/actors/c"];
/// Longest text: longer than a publisher has memory for at first.
const LONGEST: usize = 20_000;

const QOS: [Qos; 4] = [
    Qos::keep_last(10),
    Qos::keep_last(100).best_effort(),
    Qos::keep_last(5).transient_local(),
    Qos::keep_all(8),
];

/// A subscription, and the samples that are held of it.
struct Taker<T: Message> {
    subscription: Subscription<T>,
    held: Vec<Sample<T>>,
}

impl<T: Message> Taker<T> {
    fn new(subscription: Subscription<T>) -> Self {
        Taker { subscription, held: Vec::new() }
    }

    /// Takes all waiting samples, and holds some of them.
    fn take(&mut self, actor: &mut Actor) {
        self.held.truncate(actor.up_to(3));
        while let Ok(Some(sample)) = self.subscription.try_take() {
            if self.held.len() < 3 && actor.chance(0.3) {
                self.held.push(sample);
            }
        }
    }
}

pub fn play(actor: &mut Actor) -> Result<()> {
    let mut node = actor.node("topics")?;
    let mut text_publishers: Vec<Publisher<Text>> = Vec::new();
    let mut number_publishers: Vec<Publisher<UInt64>> = Vec::new();
    let mut text_takers: Vec<Taker<Text>> = Vec::new();
    let mut number_takers: Vec<Taker<UInt64>> = Vec::new();
    loop {
        match actor.up_to(13) {
            0 | 1 if text_publishers.len() < 4 => {
                let (topic, qos) = (actor.one_of(&TEXTS), actor.one_of(&QOS));
                text_publishers.push(node.create_publisher(topic, qos)?);
            }
            2 if number_publishers.len() < 2 => {
                number_publishers.push(node.create_publisher(SHARED, NUMBERS_QOS)?);
            }
            3 | 4 if text_takers.len() < 4 => {
                let (topic, qos) = (actor.one_of(&TEXTS), actor.one_of(&QOS));
                text_takers.push(Taker::new(node.subscribe(topic, qos)?));
            }
            5 | 6 if number_takers.len() < 4 => {
                let kinds =
                    [(NUMBERS, Qos::default()), (SHARED, NUMBERS_QOS), (ALL, ALL_QOS), (KEPT, KEPT_QOS)];
                let (topic, qos) = actor.one_of(&kinds);
                number_takers.push(Taker::new(node.subscribe(topic, qos)?));
            }
            7 => actor.forget_one(&mut text_publishers),
            8 => actor.forget_one(&mut text_takers),
            9 => actor.forget_one(&mut number_takers),
            10 if actor.chance(0.3) => {
                // The node's publishers and subscriptions end, too.
                (text_publishers, number_publishers) = Default::default();
                (text_takers, number_takers) = Default::default();
                node = actor.node("topics")?;
            }
            _ => {}
        }
        for publisher in &text_publishers {
            let longest = if actor.chance(0.1) { LONGEST } else { 100 };
            let data = "x".repeat(actor.up_to(longest));
            for _ in 0..actor.up_to(3) {
                // A keep-all subscription may be full.
                let _ = publisher.publish(&Text { data: data.clone() });
            }
        }
        for publisher in &number_publishers {
            for data in 0..actor.up_to(3) as u64 {
                publisher.publish(&UInt64 { data })?;
            }
        }
        text_takers.iter_mut().for_each(|taker| taker.take(actor));
        number_takers.iter_mut().for_each(|taker| taker.take(actor));
        actor.rest();
    }
}

/// A managed node with a publisher while it is configured.
#[derive(Clone, Default)]
struct Managed {
    publisher: Arc<Mutex<Option<Publisher<Text>>>>,
}

impl Managed {
    fn set(&self, publisher: Option<Publisher<Text>>) {
        *lock(&self.publisher) = publisher;
    }

    fn publish(&self) {
        if let Some(publisher) = &*lock(&self.publisher) {
            let _ = publisher.publish(&Text { data: "managed".into() });
        }
    }
}

impl LifecycleCallbacks for Managed {
    fn on_configure(&mut self, node: &mut ManagedNode) -> CallbackReturn {
        match node.create_publisher(TEXTS[0], Qos::default()) {
            Ok(publisher) => {
                self.set(Some(publisher));
                CallbackReturn::Success
            }
            Err(error) => {
                eprintln!("{}: on_configure: {error}", std::process::id());
                CallbackReturn::Failure
            }
        }
    }

    fn on_cleanup(&mut self, _: &mut ManagedNode) -> CallbackReturn {
        self.set(None);
        CallbackReturn::Success
    }
}

/// Creates managed nodes, takes them through their states, and removes them.
pub fn live(actor: &mut Actor) -> Result<()> {
    let _spinning = actor.spin();
    loop {
        let managed = Managed::default();
        let node = LifecycleNode::create(actor.context.clone(), "managed", "/actors", managed.clone())?;
        for _ in 0..=actor.up_to(2) {
            node.configure()?;
            node.activate()?;
            for _ in 0..actor.up_to(10) {
                managed.publish();
                actor.rest();
            }
            node.deactivate()?;
            node.cleanup()?;
        }
        if actor.chance(0.5) {
            node.shutdown()?;
        }
    }
}
