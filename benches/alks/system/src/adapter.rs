// SPDX-License-Identifier: MIT OR Apache-2.0
//! The FlexRay adapter: in place of the car's bus a simulation, eleven topics of it, and the command back to it.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tautline::std_msgs::msg::{Float64, Float64MultiArray, UInt32};
use tautline::{CallbackGroup, Context, Message, Node, Publisher, Sample, Tick, nav_msgs, sensor_msgs};
use tautline_alks::drive::Logbook;
use tautline_alks::job::{Job, WARM_UP_NS, tell};
use tautline_alks::records::{Records, Span, TOPICS};
use tautline_alks::signals::{Command, Fast};
use tautline_alks::simulator::Simulator;
use tautline_rt::clock::monotonic_ns;

use crate::{Result, ros};

const PERIOD_NS: u64 = 20_000_000;
/// Time between set-up and the first step: whoever listens has heard of the topics by then.
const LEAD_NS: u64 = 500_000_000;

/// What the callbacks share: all of them run on one thread, so that nobody ever waits for it.
struct World {
    simulator: Simulator,
    logbook: Option<Logbook>,
    command: Command,
}

/// The topics of 50 Hz.
struct Fasts {
    speed: Publisher<Float64>,
    steering: Publisher<Float64>,
    gps: Publisher<sensor_msgs::msg::NavSatFix>,
    odometry: Publisher<nav_msgs::msg::Odometry>,
    imu: Publisher<sensor_msgs::msg::Imu>,
    wheels: Publisher<sensor_msgs::msg::JointState>,
    pedals: Publisher<sensor_msgs::msg::Joy>,
    status: Publisher<UInt32>,
    driver: Publisher<sensor_msgs::msg::Joy>,
}

pub fn run(job: &Job, context: &Context) -> Result<()> {
    let first_ns = monotonic_ns() + LEAD_NS;
    let end_ns = job.end_ns(first_ns);
    let records = Arc::new(Records::new(first_ns + WARM_UP_NS));
    let world = World {
        simulator: Simulator::new(job.seed, job.minutes()),
        logbook: Some(Logbook::new(job.seed, job.seconds + 2.0)),
        command: Command::default(),
    };
    let world = Arc::new(Mutex::new(world));
    let mut node = Node::create(context.clone(), "adapter", "")?;
    let mut group = CallbackGroup::new();
    steps(&mut node, &mut group, context, &world, &records, (first_ns, end_ns))?;
    perception(&mut node, &mut group, context, &world, &records, first_ns)?;
    commands(&mut node, &mut group, context, &world, &records)?;
    let callback = node.spawn_group(context.group("adapter")?, group)?;
    context.spin()?;
    // What was published last has come before others are told to end.
    callback.stop();
    callback.join()?;
    let drive = lock(&world).logbook.take().map(Logbook::close);
    tell(records.part(drive));
    Ok(())
}

fn lock(world: &Mutex<World>) -> MutexGuard<'_, World> {
    world.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The IMU's callback: a step of the simulation and nine topics. It ends the run.
fn steps(
    node: &mut Node,
    group: &mut CallbackGroup,
    context: &Context,
    world: &Arc<Mutex<World>>,
    records: &Arc<Records>,
    (first_ns, end_ns): (u64, u64),
) -> Result<()> {
    let timer = node.create_wall_timer_at(first_ns, std::time::Duration::from_nanos(PERIOD_NS))?;
    let fasts = Fasts::open(node)?;
    let (world, records, events) = (world.clone(), records.clone(), context.events().clone());
    group.add(
        context.callback("imu")?,
        timer,
        |tick: &Tick| tick.release_ns,
        move |tick| {
            if tick.release_ns >= end_ns {
                events.stop();
                return std::future::ready(());
            }
            let mut world = lock(&world);
            records.timed(Span::Imu, || {
                let World { simulator, logbook, command } = &mut *world;
                let fast = simulator.step(command);
                logbook.iter_mut().for_each(|logbook| logbook.note(&simulator.truth()));
                fasts.publish(&fast, tick.release_ns, &records);
            });
            std::future::ready(())
        },
    );
    Ok(())
}

/// Vehicles and lines, of each second step.
fn perception(
    node: &mut Node,
    group: &mut CallbackGroup,
    context: &Context,
    world: &Arc<Mutex<World>>,
    records: &Arc<Records>,
    first_ns: u64,
) -> Result<()> {
    let timer = node.create_wall_timer_at(first_ns, std::time::Duration::from_nanos(2 * PERIOD_NS))?;
    let vehicles = publisher::<Float64MultiArray>(node, 9)?;
    let lines = publisher::<Float64MultiArray>(node, 10)?;
    let (world, records) = (world.clone(), records.clone());
    group.add(
        context.callback("perception")?,
        timer,
        |tick: &Tick| tick.release_ns,
        move |_| {
            records.timed(Span::Perception, || {
                let slow = lock(&world).simulator.slow();
                send(&vehicles, &ros::vehicles(&slow.vehicles), 9, &records);
                send(&lines, &ros::lines(&slow.lines), 10, &records);
            });
            std::future::ready(())
        },
    );
    Ok(())
}

/// What the car is told; what is no command is not obeyed.
fn commands(
    node: &mut Node,
    group: &mut CallbackGroup,
    context: &Context,
    world: &Arc<Mutex<World>>,
    records: &Arc<Records>,
) -> Result<()> {
    let qos = context.callback_qos("take_command")?;
    let commands = node.subscribe::<Float64MultiArray>(TOPICS[12], qos)?;
    let (world, records, counters) = (world.clone(), records.clone(), commands.counters());
    group.add(
        context.callback("take_command")?,
        commands,
        |message: &Sample<Float64MultiArray>| message.info().released_ns,
        move |message| {
            records.received(12, Some(counters.lost()));
            if let Some(command) = ros::from_command(&message.to_owned()) {
                lock(&world).command = command;
            }
            std::future::ready(())
        },
    );
    Ok(())
}

impl Fasts {
    fn open(node: &mut Node) -> Result<Fasts> {
        Ok(Fasts {
            speed: publisher(node, 0)?,
            steering: publisher(node, 1)?,
            gps: publisher(node, 2)?,
            odometry: publisher(node, 3)?,
            imu: publisher(node, 4)?,
            wheels: publisher(node, 5)?,
            pedals: publisher(node, 6)?,
            status: publisher(node, 7)?,
            driver: publisher(node, 8)?,
        })
    }

    fn publish(&self, fast: &Fast, stamp_ns: u64, records: &Records) {
        send(&self.odometry, &ros::odometry(fast.odometry, stamp_ns), 3, records);
        send(&self.speed, &ros::float(fast.speed_mps), 0, records);
        send(&self.steering, &ros::float(fast.steering_wheel_rad), 1, records);
        send(&self.gps, &ros::gps(fast, stamp_ns), 2, records);
        send(&self.imu, &ros::imu(fast, stamp_ns), 4, records);
        send(&self.wheels, &ros::wheels(fast, stamp_ns), 5, records);
        send(&self.pedals, &ros::pair(fast.pedals, stamp_ns), 6, records);
        send(&self.status, &UInt32 { data: fast.status }, 7, records);
        send(&self.driver, &ros::driver(fast, stamp_ns), 8, records);
    }
}

/// Of the topic with this number.
pub fn publisher<T: Message>(node: &mut Node, topic: usize) -> Result<Publisher<T>> {
    Ok(node.create_publisher(TOPICS[topic], tautline::Qos::default())?)
}

/// A message that cannot be published is not counted as sent, and is missed by nobody who waits for the next one.
pub fn send<T: Message>(publisher: &Publisher<T>, message: &T, topic: usize, records: &Records) {
    if publisher.publish(message).is_ok() {
        records.sent(topic);
    }
}
