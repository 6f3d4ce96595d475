// SPDX-License-Identifier: MIT OR Apache-2.0
//! The automated lane keeping system on r2r, over whatever ROS 2 it was built with.
//!
//! Started by Tautline's `alks` with `--child` and a job as JSON. Car, controllers, planner and conversions are the same source as there.
//! The threads are those of the paper's table: one that spins and runs all callbacks, at priority 10, with the middleware's threads at 20; in the
//! ALKS node the timer has a thread of its own at 5, and in the adapter the callbacks do, at 10.

use std::cell::RefCell;
use std::process::ExitCode;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use futures::executor::LocalPool;
use futures::task::LocalSpawnExt;
use futures::{Stream, StreamExt};
use r2r::nav_msgs::msg::Odometry;
use r2r::std_msgs::msg::{Float64, Float64MultiArray, UInt32};
use r2r::visualization_msgs::msg::MarkerArray;
use r2r::{Context, Node, Publisher, QosProfile, Timer, WrappedTypesupport, sensor_msgs};
use rival_r2r::{Result, program};
use tautline_alks::control::Controller;
use tautline_alks::drive::Logbook;
use tautline_alks::inputs::Inputs;
use tautline_alks::job::{Job, Role, WARM_UP_NS, ready, tell, until_told};
use tautline_alks::markers::Scene as Drawing;
use tautline_alks::now_s;
use tautline_alks::records::{Records, Span, TOPICS};
use tautline_alks::sharing::{Store, View, share};
use tautline_alks::signals::Command as Wanted;
use tautline_alks::simulator::Simulator;
use tautline_rt::clock::monotonic_ns;
use tautline_rt::{MemoryLock, Policy, Realtime, ThreadBuilder, lock_memory, set_policy, tune_malloc};

/// Signals as r2r's messages.
mod ros {
    #![allow(dead_code, reason = "each process uses its part")]
    tautline_alks::messages!(r2r);
}

/// The paper's priorities.
const MIDDLEWARE: u8 = 20;
const CALLBACKS: u8 = 10;
const TIMER: u8 = 5;
/// How often it is looked whether the end has come.
const LOOK: Duration = Duration::from_millis(100);
const PERIOD: Duration = Duration::from_millis(20);
/// For discovery, before the first step.
const LEAD: Duration = Duration::from_secs(2);

fn main() -> ExitCode {
    program("alks", run)
}

fn run(job: &Job) -> Result<()> {
    if job.realtime {
        tune_malloc();
        lock_memory(MemoryLock::OnFault)?;
        // The middleware's threads inherit it.
        set_policy(Policy::Fifo(MIDDLEWARE))?;
    }
    let name = format!("{:?}", job.role).to_lowercase();
    let node = Node::create(Context::create()?, &name, "")?;
    match job.role {
        Role::Adapter => adapter(node, job),
        Role::Alks => alks(node, job),
        Role::Visualizer => visualizer(node, job),
    }
}

/// The priority of this thread from here on.
fn become_callbacks(job: &Job) -> Result<()> {
    if job.realtime {
        set_policy(Policy::Fifo(CALLBACKS))?;
    }
    Ok(())
}

/// Gives a future a thread, which ends with the process.
fn spawn(
    priority: u8,
    job: &Job,
    make: impl FnOnce() -> std::pin::Pin<Box<dyn Future<Output = ()>>> + Send + 'static,
) -> Result<()> {
    let realtime = if job.realtime { Realtime::Required } else { Realtime::Off };
    let thread = ThreadBuilder::new("callbacks").policy(Policy::Fifo(priority)).realtime(realtime);
    thread.spawn(move || move || LocalPool::new().run_until(make()))?;
    Ok(())
}

/// Becomes true when this process is told to end.
fn told() -> Arc<AtomicBool> {
    let over = Arc::new(AtomicBool::new(false));
    let set = over.clone();
    thread::spawn(move || {
        until_told();
        set.store(true, Ordering::Release);
    });
    over
}

/// Spins and runs the callbacks of this thread until `over`.
fn spin(node: &mut Node, pool: &mut LocalPool, records: &Records, over: &AtomicBool) {
    while !over.load(Ordering::Acquire) {
        node.spin_once(LOOK);
        records.timed(Span::Stalled, || pool.run_until_stalled());
    }
}

struct Sender<T: WrappedTypesupport> {
    publisher: Publisher<T>,
    topic: usize,
    records: Arc<Records>,
}

impl<T: WrappedTypesupport + 'static> Sender<T> {
    fn new(node: &mut Node, topic: usize, records: &Arc<Records>) -> Result<Sender<T>> {
        let publisher = node.create_publisher(TOPICS[topic], QosProfile::default())?;
        Ok(Sender { publisher, topic, records: records.clone() })
    }

    fn send(&self, message: &T) {
        if self.publisher.publish(message).is_ok() {
            self.records.sent(self.topic);
        }
    }
}

fn hear<T: WrappedTypesupport + Send + 'static>(
    node: &mut Node,
    topic: usize,
) -> Result<impl Stream<Item = T> + Unpin + Send + use<T>> {
    Ok(node.subscribe::<T>(TOPICS[topic], QosProfile::default())?)
}

/// Ends when the timer fails.
async fn each_tick(mut timer: Timer, mut work: impl FnMut()) {
    while timer.tick().await.is_ok() {
        work();
    }
}

fn adapter(mut node: Node, job: &Job) -> Result<()> {
    let first_ns = monotonic_ns() + LEAD.as_nanos() as u64;
    let end_ns = job.end_ns(first_ns);
    let records = Arc::new(Records::new(first_ns + WARM_UP_NS));
    let (over, result) = (Arc::new(AtomicBool::new(false)), std::sync::mpsc::channel());
    let speed = Sender::<Float64>::new(&mut node, 0, &records)?;
    let steering = Sender::<Float64>::new(&mut node, 1, &records)?;
    let gps = Sender::<sensor_msgs::msg::NavSatFix>::new(&mut node, 2, &records)?;
    let odometry = Sender::<Odometry>::new(&mut node, 3, &records)?;
    let imu = Sender::<sensor_msgs::msg::Imu>::new(&mut node, 4, &records)?;
    let wheels = Sender::<sensor_msgs::msg::JointState>::new(&mut node, 5, &records)?;
    let pedals = Sender::<sensor_msgs::msg::Joy>::new(&mut node, 6, &records)?;
    let status = Sender::<UInt32>::new(&mut node, 7, &records)?;
    let driver = Sender::<sensor_msgs::msg::Joy>::new(&mut node, 8, &records)?;
    let vehicles = Sender::<Float64MultiArray>::new(&mut node, 9, &records)?;
    let lines = Sender::<Float64MultiArray>::new(&mut node, 10, &records)?;
    let mut commands = hear::<Float64MultiArray>(&mut node, 12)?;
    let (timer, slow_timer) = (node.create_wall_timer(PERIOD)?, node.create_wall_timer(2 * PERIOD)?);
    let (thread_records, thread_over, told, thread_job) =
        (records.clone(), over.clone(), result.0, job.clone());
    spawn(CALLBACKS, job, move || {
        let simulator = Rc::new(RefCell::new(Simulator::new(thread_job.seed, thread_job.minutes())));
        let command = Rc::new(RefCell::new(Wanted::default()));
        let mut logbook = Some(Logbook::new(thread_job.seed, thread_job.seconds + 2.0));
        let records = thread_records;
        let heard = (command.clone(), records.clone());
        let take = async move {
            while let Some(message) = commands.next().await {
                heard.1.received(12, None);
                if let Some(command) = ros::from_command(&message) {
                    *heard.0.borrow_mut() = command;
                }
            }
        };
        let (seen, slow_records) = (simulator.clone(), records.clone());
        let perceive = each_tick(slow_timer, move || {
            if monotonic_ns() >= first_ns {
                slow_records.timed(Span::Perception, || {
                    let slow = seen.borrow_mut().slow();
                    vehicles.send(&ros::vehicles(&slow.vehicles));
                    lines.send(&ros::lines(&slow.lines));
                });
            }
        });
        let step = each_tick(timer, move || {
            let stamp_ns = monotonic_ns();
            if stamp_ns >= end_ns {
                if let Some(logbook) = logbook.take() {
                    let _ = told.send(logbook.close());
                }
                thread_over.store(true, Ordering::Release);
            } else if stamp_ns >= first_ns {
                records.timed(Span::Imu, || {
                    let mut simulator = simulator.borrow_mut();
                    let fast = simulator.step(&command.borrow());
                    logbook.iter_mut().for_each(|logbook| logbook.note(&simulator.truth()));
                    odometry.send(&ros::odometry(fast.odometry, stamp_ns));
                    speed.send(&ros::float(fast.speed_mps));
                    steering.send(&ros::float(fast.steering_wheel_rad));
                    gps.send(&ros::gps(&fast, stamp_ns));
                    imu.send(&ros::imu(&fast, stamp_ns));
                    wheels.send(&ros::wheels(&fast, stamp_ns));
                    pedals.send(&ros::pair(fast.pedals, stamp_ns));
                    status.send(&UInt32 { data: fast.status });
                    driver.send(&ros::driver(&fast, stamp_ns));
                });
            }
        });
        Box::pin(async move {
            futures::join!(take, perceive, step);
        })
    })?;
    become_callbacks(job)?;
    while !over.load(Ordering::Acquire) {
        node.spin_once(LOOK);
    }
    // What was published last is on its way.
    thread::sleep(LOOK);
    let drive = result.1.recv_timeout(Duration::from_secs(1)).ok();
    tell(records.part(drive));
    Ok(())
}

/// What the subscribers' callbacks have in common: one thread's.
#[derive(Clone)]
struct Subscribers {
    store: Rc<RefCell<Store>>,
    records: Arc<Records>,
}

impl Subscribers {
    fn update(&self, change: impl FnOnce(&mut Inputs)) {
        let begin_ns = monotonic_ns();
        let waited = || {
            let now_ns = monotonic_ns();
            self.records.note(Span::Waited, now_ns, now_ns - begin_ns);
        };
        self.store.borrow_mut().update(change, waited);
    }

    fn keep<T: WrappedTypesupport + Send + 'static>(
        &self,
        node: &mut Node,
        pool: &LocalPool,
        topic: usize,
        keep: fn(&mut Inputs, &T),
    ) -> Result<()> {
        let (mut messages, to) = (hear::<T>(node, topic)?, self.clone());
        pool.spawner().spawn_local(async move {
            while let Some(message) = messages.next().await {
                to.records.received(topic, None);
                to.records.timed(Span::Subscriber, || to.update(|inputs| keep(inputs, &message)));
            }
        })?;
        Ok(())
    }

    fn odometry(&self, node: &mut Node, pool: &LocalPool) -> Result<()> {
        let (mut messages, to) = (hear::<Odometry>(node, 3)?, self.clone());
        let absolute = Sender::<Odometry>::new(node, 11, &self.records)?;
        pool.spawner().spawn_local(async move {
            while let Some(message) = messages.next().await {
                to.records.received(3, None);
                let begin_ns = monotonic_ns();
                let mut pose = None;
                to.update(|inputs| {
                    ros::keep::odometry(inputs, &message);
                    pose = Some(inputs.odometry);
                });
                if let Some(pose) = pose {
                    absolute.send(&ros::odometry(pose, ros::stamp_ns(&message.header)));
                }
                let end_ns = monotonic_ns();
                to.records.note(Span::Odometry, end_ns, end_ns - begin_ns);
                to.records.note(Span::Subscriber, end_ns, end_ns - begin_ns);
            }
        })?;
        Ok(())
    }
}

fn alks(mut node: Node, job: &Job) -> Result<()> {
    let records = Arc::new(Records::new(monotonic_ns() + WARM_UP_NS));
    let (store, view) = share(job.shared);
    let to = Subscribers { store: Rc::new(RefCell::new(store)), records: records.clone() };
    let mut pool = LocalPool::new();
    to.keep::<Float64>(&mut node, &pool, 0, ros::keep::speed)?;
    to.keep::<Float64>(&mut node, &pool, 1, ros::keep::steering_wheel_angle)?;
    to.keep::<sensor_msgs::msg::NavSatFix>(&mut node, &pool, 2, ros::keep::gps)?;
    to.odometry(&mut node, &pool)?;
    to.keep::<sensor_msgs::msg::Imu>(&mut node, &pool, 4, ros::keep::imu)?;
    to.keep::<sensor_msgs::msg::JointState>(&mut node, &pool, 5, ros::keep::wheel_speeds)?;
    to.keep::<sensor_msgs::msg::Joy>(&mut node, &pool, 6, ros::keep::pedals)?;
    to.keep::<UInt32>(&mut node, &pool, 7, ros::keep::status)?;
    to.keep::<sensor_msgs::msg::Joy>(&mut node, &pool, 8, ros::keep::driver)?;
    to.keep::<Float64MultiArray>(&mut node, &pool, 9, ros::keep::vehicles)?;
    to.keep::<Float64MultiArray>(&mut node, &pool, 10, ros::keep::lines)?;
    control(&mut node, job, view, &records)?;
    become_callbacks(job)?;
    let over = told();
    ready();
    spin(&mut node, &mut pool, &records, &over);
    tell(records.part(None));
    Ok(())
}

fn control(node: &mut Node, job: &Job, mut view: View, records: &Arc<Records>) -> Result<()> {
    let timer = node.create_wall_timer(PERIOD)?;
    let commands = Sender::<Float64MultiArray>::new(node, 12, records)?;
    let trajectories = Sender::<Float64MultiArray>::new(node, 13, records)?;
    let states = Sender::<Float64MultiArray>::new(node, 14, records)?;
    let records = records.clone();
    spawn(TIMER, job, move || {
        let mut controller = Controller::default();
        Box::pin(each_tick(timer, move || {
            let begin_ns = monotonic_ns();
            let inputs = view.snapshot();
            let output = controller.run(&inputs, now_s());
            commands.send(&ros::command(&output.command));
            states.send(&ros::state(&output.state));
            if let Some(trajectory) = controller.trajectory().filter(|_| output.planned) {
                trajectories.send(&ros::trajectory(trajectory));
            }
            let end_ns = monotonic_ns();
            records.note(
                if output.planned { Span::Planning } else { Span::Timer },
                end_ns,
                end_ns - begin_ns,
            );
        }))
    })
}

fn visualizer(mut node: Node, job: &Job) -> Result<()> {
    let records = Arc::new(Records::new(monotonic_ns() + WARM_UP_NS));
    let known = Rc::new(RefCell::new((Inputs::default(), None)));
    let mut pool = LocalPool::new();
    let spawner = pool.spawner();
    let (mut odometry, mut vehicles) =
        (hear::<Odometry>(&mut node, 11)?, hear::<Float64MultiArray>(&mut node, 9)?);
    let (mut lines, mut plans) =
        (hear::<Float64MultiArray>(&mut node, 10)?, hear::<Float64MultiArray>(&mut node, 13)?);
    let to = (known.clone(), records.clone());
    spawner.spawn_local(async move {
        while let Some(message) = odometry.next().await {
            to.1.received(11, None);
            let begin_ns = monotonic_ns();
            to.0.borrow_mut().0.odometry = ros::from_odometry(&message);
            let end_ns = monotonic_ns();
            to.1.note(Span::ShowOdometry, end_ns, end_ns - begin_ns);
            to.1.note(Span::Chain, end_ns, end_ns.saturating_sub(ros::stamp_ns(&message.header)));
        }
    })?;
    let to = (known.clone(), records.clone());
    spawner.spawn_local(async move {
        while let Some(message) = vehicles.next().await {
            to.1.received(9, None);
            ros::keep::vehicles(&mut to.0.borrow_mut().0, &message);
        }
    })?;
    let to = (known.clone(), records.clone());
    spawner.spawn_local(async move {
        while let Some(message) = lines.next().await {
            to.1.received(10, None);
            ros::keep::lines(&mut to.0.borrow_mut().0, &message);
        }
    })?;
    let to = (known.clone(), records.clone());
    spawner.spawn_local(async move {
        while let Some(message) = plans.next().await {
            to.1.received(13, None);
            let mut known = to.0.borrow_mut();
            known.1 = ros::from_trajectory(&message).or(known.1);
        }
    })?;
    let markers = node.create_publisher::<MarkerArray>("/visualization/markers", QosProfile::default())?;
    let (timer, draw_records, mut scene) =
        (node.create_wall_timer(2 * PERIOD)?, records.clone(), Drawing::default());
    spawner.spawn_local(each_tick(timer, move || {
        draw_records.timed(Span::Draw, || {
            let known = known.borrow();
            scene.draw(known.0.odometry, &known.0, known.1.as_ref());
            // Whoever looks sees the next one.
            let _ = markers.publish(&ros::markers(&scene, monotonic_ns()));
        });
    }))?;
    become_callbacks(job)?;
    let over = told();
    ready();
    spin(&mut node, &mut pool, &records, &over);
    tell(records.part(None));
    Ok(())
}
