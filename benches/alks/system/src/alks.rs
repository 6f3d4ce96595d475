// SPDX-License-Identifier: MIT OR Apache-2.0
//! The ALKS node: eleven subscriptions on one thread keep what they hear, a timer on another one drives the car.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tautline::std_msgs::msg::{Float64, Float64MultiArray, UInt32};
use tautline::{
    CallbackGroup, CallbackHandle, Context, Message, Node, Publisher, Sample, nav_msgs, sensor_msgs,
};
use tautline_alks::control::Controller;
use tautline_alks::inputs::Inputs;
use tautline_alks::job::{Job, WARM_UP_NS, ready, tell, until_told};
use tautline_alks::now_s;
use tautline_alks::records::{Records, Span, TOPICS};
use tautline_alks::sharing::{Store, View, share};
use tautline_rt::clock::monotonic_ns;

use crate::adapter::{publisher, send};
use crate::{Result, ros};

/// What the subscribers' callbacks have in common; all of them run on one thread, so that nobody waits for the outer lock.
#[derive(Clone)]
struct Subscribers {
    store: Arc<Mutex<Store>>,
    records: Arc<Records>,
}

pub fn run(job: &Job, context: &Context) -> Result<()> {
    let records = Arc::new(Records::new(monotonic_ns() + WARM_UP_NS));
    let (store, view) = share(job.shared);
    let mut node = Node::create(context.clone(), "alks", "")?;
    let subscribers = Subscribers { store: Arc::new(Mutex::new(store)), records: records.clone() };
    let group = subscribe(&mut node, context, &subscribers)?;
    let callbacks = [
        node.spawn_group(context.group("subscribers")?, group)?,
        control(&mut node, context, view, &records)?,
    ];
    let events = context.events().clone();
    let waiting = std::thread::spawn(move || {
        until_told();
        events.stop();
    });
    ready();
    context.spin()?;
    callbacks.iter().for_each(CallbackHandle::stop);
    callbacks.into_iter().try_for_each(CallbackHandle::join)?;
    tell(records.part(None));
    drop(waiting);
    Ok(())
}

fn subscribe(node: &mut Node, context: &Context, to: &Subscribers) -> Result<CallbackGroup> {
    let mut group = CallbackGroup::new();
    let mut add = (node, context, &mut group, to);
    keep::<Float64>(&mut add, 0, "on_speed", ros::keep::speed)?;
    keep::<Float64>(&mut add, 1, "on_steering_wheel_angle", ros::keep::steering_wheel_angle)?;
    keep::<sensor_msgs::msg::NavSatFix>(&mut add, 2, "on_gps", ros::keep::gps)?;
    odometry(&mut add)?;
    keep::<sensor_msgs::msg::Imu>(&mut add, 4, "on_imu", ros::keep::imu)?;
    keep::<sensor_msgs::msg::JointState>(&mut add, 5, "on_wheel_speeds", ros::keep::wheel_speeds)?;
    keep::<sensor_msgs::msg::Joy>(&mut add, 6, "on_pedals", ros::keep::pedals)?;
    keep::<UInt32>(&mut add, 7, "on_status", ros::keep::status)?;
    keep::<sensor_msgs::msg::Joy>(&mut add, 8, "on_driver", ros::keep::driver)?;
    keep::<Float64MultiArray>(&mut add, 9, "on_vehicles", ros::keep::vehicles)?;
    keep::<Float64MultiArray>(&mut add, 10, "on_lines", ros::keep::lines)?;
    Ok(group)
}

/// What a subscription is added to.
type Adding<'a> = (&'a mut Node, &'a Context, &'a mut CallbackGroup, &'a Subscribers);

/// A subscription whose messages are kept, and nothing else.
fn keep<T: Message>(
    (node, context, group, to): &mut Adding,
    topic: usize,
    name: &str,
    keep: fn(&mut Inputs, &T),
) -> Result<()> {
    let messages = node.subscribe::<T>(TOPICS[topic], context.callback_qos(name)?)?;
    let (to, counters) = (to.clone(), messages.counters());
    let released = |message: &Sample<T>| message.info().released_ns;
    group.add(context.callback(name)?, messages, released, move |message: Sample<T>| {
        to.records.received(topic, Some(counters.lost()));
        to.records.timed(Span::Subscriber, || to.update(|inputs| keep(inputs, &message.to_owned())));
        std::future::ready(())
    });
    Ok(())
}

/// The odometry's, which also publishes where the car is on the map, for the visualizer.
fn odometry((node, context, group, to): &mut Adding) -> Result<()> {
    type Odometry = nav_msgs::msg::Odometry;
    let messages = node.subscribe::<Odometry>(TOPICS[3], context.callback_qos("on_odometry")?)?;
    let absolute: Publisher<Odometry> = publisher(node, 11)?;
    let (to, counters) = (to.clone(), messages.counters());
    let released = |message: &Sample<Odometry>| message.info().released_ns;
    group.add(context.callback("on_odometry")?, messages, released, move |message: Sample<Odometry>| {
        to.records.received(3, Some(counters.lost()));
        let begin_ns = monotonic_ns();
        let message = message.to_owned();
        let mut pose = None;
        to.update(|inputs| {
            ros::keep::odometry(inputs, &message);
            pose = Some(inputs.odometry);
        });
        if let Some(pose) = pose {
            send(&absolute, &ros::odometry(pose, ros::stamp_ns(&message.header)), 11, &to.records);
        }
        let end_ns = monotonic_ns();
        to.records.note(Span::Odometry, end_ns, end_ns - begin_ns);
        to.records.note(Span::Subscriber, end_ns, end_ns - begin_ns);
        std::future::ready(())
    });
    Ok(())
}

impl Subscribers {
    fn update(&self, change: impl FnOnce(&mut Inputs)) {
        let begin_ns = monotonic_ns();
        let waited = || {
            let now_ns = monotonic_ns();
            self.records.note(Span::Waited, now_ns, now_ns - begin_ns);
        };
        self.store.lock().unwrap_or_else(PoisonError::into_inner).update(change, waited);
    }
}

/// The timer: everything is computed with a copy of what is known.
fn control(
    node: &mut Node,
    context: &Context,
    mut view: View,
    records: &Arc<Records>,
) -> Result<CallbackHandle> {
    let mut timer = node.create_wall_timer(Duration::from_millis(20))?;
    let commands: Publisher<Float64MultiArray> = publisher(node, 12)?;
    let trajectories: Publisher<Float64MultiArray> = publisher(node, 13)?;
    let states: Publisher<Float64MultiArray> = publisher(node, 14)?;
    let records = records.clone();
    let future = async move {
        let mut controller = Controller::default();
        while timer.tick().await.is_ok() {
            let begin_ns = monotonic_ns();
            let inputs = view.snapshot();
            let output = controller.run(&inputs, now_s());
            send(&commands, &ros::command(&output.command), 12, &records);
            send(&states, &ros::state(&output.state), 14, &records);
            if let Some(trajectory) = controller.trajectory().filter(|_| output.planned) {
                send(&trajectories, &ros::trajectory(trajectory), 13, &records);
            }
            let end_ns = monotonic_ns();
            let span = if output.planned { Span::Planning } else { Span::Timer };
            records.note(span, end_ns, end_ns - begin_ns);
        }
    };
    Ok(node.spawn_callback(context.callback("control")?, future)?)
}
