// SPDX-License-Identifier: MIT OR Apache-2.0
//! The visualizer: what it hears as markers for rviz, Foxglove or whatever shows them.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tautline::std_msgs::msg::Float64MultiArray;
use tautline::visualization_msgs::msg::MarkerArray;
use tautline::{CallbackGroup, Context, Message, Node, Publisher, Qos, Sample, Tick, nav_msgs};
use tautline_alks::inputs::Inputs;
use tautline_alks::job::{Job, WARM_UP_NS, ready, tell, until_told};
use tautline_alks::markers::Scene;
use tautline_alks::records::{Records, Span, TOPICS};
use tautline_alks::signals::Trajectory;
use tautline_rt::clock::monotonic_ns;

use crate::{Result, ros};

/// Where the markers are.
pub const MARKERS: &str = "/visualization/markers";

/// What is known; all callbacks run on one thread, so that nobody waits for it.
#[derive(Default)]
struct Known {
    inputs: Inputs,
    trajectory: Option<Trajectory>,
}

/// What a subscription is added to.
struct Adding<'a> {
    node: &'a mut Node,
    context: &'a Context,
    group: &'a mut CallbackGroup,
    known: &'a Arc<Mutex<Known>>,
    records: &'a Arc<Records>,
}

pub fn run(_: &Job, context: &Context) -> Result<()> {
    let records = Arc::new(Records::new(monotonic_ns() + WARM_UP_NS));
    let known = Arc::new(Mutex::new(Known::default()));
    let mut node = Node::create(context.clone(), "visualizer", "")?;
    let mut group = CallbackGroup::new();
    let mut adding = Adding { node: &mut node, context, group: &mut group, known: &known, records: &records };
    odometry(&mut adding)?;
    hear::<Float64MultiArray>(&mut adding, 9, "show_vehicles", |known, message| {
        ros::keep::vehicles(&mut known.inputs, message);
    })?;
    hear::<Float64MultiArray>(&mut adding, 10, "show_lines", |known, message| {
        ros::keep::lines(&mut known.inputs, message);
    })?;
    hear::<Float64MultiArray>(&mut adding, 13, "show_trajectory", |known, message| {
        known.trajectory = ros::from_trajectory(message).or(known.trajectory);
    })?;
    draw(&mut adding)?;
    let callback = node.spawn_group(context.group("visualizer")?, group)?;
    let events = context.events().clone();
    let waiting = std::thread::spawn(move || {
        until_told();
        events.stop();
    });
    ready();
    context.spin()?;
    callback.stop();
    callback.join()?;
    tell(records.part(None));
    drop(waiting);
    Ok(())
}

fn lock(known: &Mutex<Known>) -> MutexGuard<'_, Known> {
    known.lock().unwrap_or_else(PoisonError::into_inner)
}

fn hear<T: Message>(
    Adding { node, context, group, known, records }: &mut Adding,
    topic: usize,
    name: &str,
    keep: fn(&mut Known, &T),
) -> Result<()> {
    let messages = node.subscribe::<T>(TOPICS[topic], context.callback_qos(name)?)?;
    let (known, records, counters) = (known.clone(), records.clone(), messages.counters());
    let released = |message: &Sample<T>| message.info().released_ns;
    group.add(context.callback(name)?, messages, released, move |message: Sample<T>| {
        records.received(topic, Some(counters.lost()));
        keep(&mut lock(&known), &message.to_owned());
        std::future::ready(())
    });
    Ok(())
}

/// The end of the odometry chain.
fn odometry(Adding { node, context, group, known, records }: &mut Adding) -> Result<()> {
    type Odometry = nav_msgs::msg::Odometry;
    let messages = node.subscribe::<Odometry>(TOPICS[11], context.callback_qos("show_odometry")?)?;
    let (known, records, counters) = (known.clone(), records.clone(), messages.counters());
    let released = |message: &Sample<Odometry>| message.info().released_ns;
    group.add(context.callback("show_odometry")?, messages, released, move |message: Sample<Odometry>| {
        records.received(11, Some(counters.lost()));
        let begin_ns = monotonic_ns();
        let message = message.to_owned();
        lock(&known).inputs.odometry = ros::from_odometry(&message);
        let end_ns = monotonic_ns();
        records.note(Span::ShowOdometry, end_ns, end_ns - begin_ns);
        records.note(Span::Chain, end_ns, end_ns.saturating_sub(ros::stamp_ns(&message.header)));
        std::future::ready(())
    });
    Ok(())
}

fn draw(Adding { node, context, group, known, records }: &mut Adding) -> Result<()> {
    let timer = node.create_wall_timer(Duration::from_millis(40))?;
    let markers: Publisher<MarkerArray> = node.create_publisher(MARKERS, Qos::default())?;
    let (known, records) = (known.clone(), records.clone());
    let mut scene = Scene::default();
    group.add(
        context.callback("draw")?,
        timer,
        |tick: &Tick| tick.release_ns,
        move |tick| {
            records.timed(Span::Draw, || {
                let known = lock(&known);
                scene.draw(known.inputs.odometry, &known.inputs, known.trajectory.as_ref());
                // Whoever looks sees the next one.
                let _ = markers.publish(&ros::markers(&scene, tick.release_ns));
            });
            std::future::ready(())
        },
    );
    Ok(())
}
