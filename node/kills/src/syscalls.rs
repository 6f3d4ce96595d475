// SPDX-License-Identifier: MIT OR Apache-2.0
//! Repeats each scene, and each time kills its process at another one of its system calls: before it, after it, or a moment later; or
//! stalls it there for seconds. Then its friend must go on, a newcomer must find a correct domain, and nothing of the process may be left.

use crate::folder::{has_gone, listing, of_dead, stolen};
use crate::inspector::{Graph, Met};
use crate::place::Place;
use crate::process::{Complaints, HELD_BY_IDLE, PATIENCE, Process, Stage, kill, lock, ms, threads, wait};
use crate::scenes::Scene;
use crate::tracer::{self, End, Point, When};
use crate::{Common, Result};
use clap::{Args, ValueEnum};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;
use std::time::{Duration, Instant};

/// Time limit for reading the graph, for a message between new endpoints of the friend and of a newcomer, and for a full queue.
const ANSWER: Duration = Duration::from_millis(100);
/// Time limit for files of dead processes to stay.
const STAY: Duration = Duration::from_millis(50);
/// The number of first system calls with which a process, with a few more, creates the domain that it joins: it stalls at every other one.
const JOINING: usize = 20;
/// Number of domains in which scenes are played at the same time.
const LANES: u32 = 2;

#[derive(Args, Debug)]
pub struct Options {
    /// At how many points, evenly spread over all there are; of those some are beyond the end
    #[arg(long, value_name = "N", default_value_t = 2400)]
    points: usize,
    /// At all points
    #[arg(long)]
    all: bool,
    #[command(flatten)]
    common: Common,
    /// At one point, 20 times: the scene, the number of the call, and before, after or soon after it, or stall: it waits there and goes on
    #[arg(long, value_name = "SCENE:CALL:WHEN", value_parser = parse)]
    at: Option<Job>,
}

#[derive(Clone, Copy, Debug)]
struct Job {
    scene: Scene,
    point: Point,
}

impl std::fmt::Display for Job {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let when = match self.point.when {
            When::Before => "before",
            When::After => "after",
            When::Soon(_) => "soon",
            When::Stall => "stall",
        };
        write!(f, "{}:{}:{when}", self.scene.name(), self.point.call)
    }
}

fn parse(text: &str) -> std::result::Result<Job, String> {
    let parts: Vec<_> = text.split(':').collect();
    let [scene, call, when] = parts[..] else { return Err("it is SCENE:CALL:WHEN".into()) };
    let when = match when {
        "before" => When::Before,
        "after" => When::After,
        "soon" => When::Soon(Duration::ZERO),
        "stall" => When::Stall,
        _ => return Err(format!("'{when}' is not before, after, soon or stall")),
    };
    let call = call.parse().map_err(|_| format!("'{call}' is no number"))?;
    Ok(Job { scene: Scene::from_str(scene, false)?, point: Point { call, when } })
}

/// The outcomes of the points of a scene.
#[derive(Clone, Debug, Default)]
struct Outcome {
    killed: usize,
    stalled: usize,
    survived: usize,
    /// The longest times, by what took them.
    longest: BTreeMap<&'static str, Duration>,
}

impl Outcome {
    fn note(&mut self, what: &'static str, time: Duration) {
        let longest = self.longest.entry(what).or_default();
        *longest = time.max(*longest);
    }

    fn join(&mut self, other: &Outcome) {
        self.killed += other.killed;
        self.stalled += other.stalled;
        self.survived += other.survived;
        other.longest.iter().for_each(|(what, time)| self.note(what, *time));
    }
}

pub fn run(options: &Options) -> Result<()> {
    let seed = options.common.seed.unwrap_or_else(rand::random);
    let mut random = SmallRng::seed_from_u64(seed);
    let place = Place::new()?;
    let stage = Stage { domain: 1, complaints: Complaints::collect()? };
    let start = Instant::now();
    let jobs = match options.at {
        Some(job) => vec![job; 20],
        None => plan(options, &stage, &mut random)?,
    };
    println!("{} points, seed {seed}", jobs.len());
    for &scene in Scene::value_variants() {
        let mut jobs: Vec<Job> = jobs.iter().filter(|job| job.scene == scene).copied().collect();
        for job in jobs.iter_mut().filter(|job| matches!(job.point.when, When::Soon(_))) {
            job.point.when = Point::soon(&mut random);
        }
        if jobs.is_empty() {
            continue;
        }
        let outcome = play(scene, &jobs, options, &stage).map_err(|error| format!("{error}; seed {seed}"))?;
        let Outcome { killed, stalled, survived, longest } = outcome;
        let longest: Vec<_> = longest.iter().map(|(what, time)| format!("{what} {}", ms(*time))).collect();
        println!(
            "{:>6}: killed at {killed} points, kept waiting at {stalled} ({survived} more were beyond its end); at most: {}",
            scene.name(),
            longest.join(", ")
        );
    }
    place.check()?;
    println!("{:.1} s; nothing is left", start.elapsed().as_secs_f64());
    Ok(())
}

/// Selects the points: each call of each scene, in each way, or `options.points` of them; and those at which the process only stalls.
fn plan(options: &Options, stage: &Stage, random: &mut SmallRng) -> Result<Vec<Job>> {
    let mut all = Vec::new();
    for &scene in Scene::value_variants() {
        let mut lane = Lane::start(scene, stage.clone())?;
        let mut calls = 0;
        for _ in 0..3 {
            let end = lane.play(None)?;
            calls = calls.max(end.calls);
        }
        lane.finish()?;
        println!("{}: {calls} system calls", scene.name());
        let points = (1..=calls).flat_map(|call| {
            [When::Before, When::After, When::Soon(Duration::ZERO)].map(|when| Point { call, when })
        });
        all.extend(points.map(|point| Job { scene, point }));
    }
    let stalls = (1..=JOINING).step_by(2).map(|call| Point { call, when: When::Stall });
    let stalls = stalls.map(|point| Job { scene: Scene::Warden, point });
    if options.all || all.len() <= options.points {
        return Ok(all.into_iter().chain(stalls).collect());
    }
    // Every `step`th point, from a random one on.
    let step = all.len() as f64 / options.points.max(1) as f64;
    let first = random.random_range(0.0..1.0);
    let chosen = (0..options.points).map(|n| all[((n as f64 + first) * step) as usize]);
    Ok(chosen.chain(stalls).collect())
}

fn play(scene: Scene, jobs: &[Job], options: &Options, stage: &Stage) -> Result<Outcome> {
    let (next, outcome) = (AtomicUsize::new(0), Mutex::new(Outcome::default()));
    let play = |domain: u32| -> Result<()> {
        let mut lane = Lane::start(scene, Stage { domain, ..stage.clone() })?;
        lane.has_limits = !options.common.no_limits;
        while let Some(job) = jobs.get(next.fetch_add(1, Ordering::Relaxed)) {
            lane.at = job.to_string();
            if let Err(error) = lane.play(Some(job.point)) {
                // The other lanes need not go on.
                next.store(jobs.len(), Ordering::Relaxed);
                let (listing, said, at) = (listing(domain), stage.complaints.text(), &lane.at);
                return Err(format!("{error}\nat {at}\n{listing}{said}").into());
            }
        }
        lock(&outcome).join(&lane.outcome);
        lane.finish()
    };
    thread::scope(|scope| {
        let lanes: Vec<_> = (1..=LANES).map(|domain| scope.spawn(move || play(domain))).collect();
        lanes.into_iter().try_for_each(|lane| lane.join().unwrap_or_else(|_| Err("a lane panicked".into())))
    })?;
    Ok(lock(&outcome).clone())
}

/// A domain in which a scene is played over and over.
struct Lane {
    scene: Scene,
    stage: Stage,
    friend: Process,
    /// Number of files that the friend had open at the start.
    friends_files: usize,
    inspector: Process,
    outcome: Outcome,
    has_limits: bool,
    at: String,
}

impl Lane {
    fn start(scene: Scene, stage: Stage) -> Result<Self> {
        let (mut friend, inspector) = (stage.start("scene-friend")?, stage.start("inspector")?);
        if scene != Scene::Warden {
            friend.order("join")?;
        }
        let friends_files = friend.holdings().files;
        let (outcome, has_limits, at) = Default::default();
        Ok(Lane { scene, stage, friend, friends_files, inspector, outcome, has_limits, at })
    }

    /// Plays the scene once, and checks what it left.
    fn play(&mut self, point: Option<Point>) -> Result<End> {
        let mut killed = self.stage.start(&format!("scene-{}", self.scene.name()))?;
        let pid = killed.id();
        let (told, ended) = std::sync::mpsc::channel();
        let (end, direct) = thread::scope(|scope| -> Result<_> {
            let (start, started) = std::sync::mpsc::channel();
            scope.spawn(move || told.send(tracer::follow(pid, point, &start)));
            killed.was_reaped();
            if started.recv().is_ok() {
                // The process may be killed before it reads the command.
                let _ = killed.tell("go");
            }
            let direct = match self.scene {
                Scene::Warden => self.direct(&mut killed),
                _ => Ok(None),
            };
            let end = ended.recv_timeout(2 * PATIENCE);
            if end.is_err() {
                let hangs = format!("it hangs: {}", threads(pid));
                kill(pid)?;
                return Err(hangs.into());
            }
            Ok((end??, direct?))
        })?;
        if let Some(number) = end.number {
            self.at += &format!(" (system call {number})");
        }
        if let Some(code) = end.code.filter(|code| *code != 0) {
            return Err(format!("it ended by itself with {code}").into());
        }
        match (end.is_killed, end.is_stalled) {
            (true, _) => self.outcome.killed += 1,
            (_, true) => self.outcome.stalled += 1,
            _ => self.outcome.survived += 1,
        }
        self.check(&end, pid, direct)?;
        Ok(end)
    }

    /// Directs the other processes while the warden plays. Returns the victim, if it has died, and the time of its death.
    fn direct(&mut self, warden: &mut Process) -> Result<Option<(u32, Instant)>> {
        if warden.hear_within(2 * PATIENCE).is_none() {
            return Ok(None);
        }
        self.friend.order("join")?;
        let mut victim = self.stage.start("scene-victim")?;
        victim.order("join")?;
        victim.kill()?;
        let died = Some((victim.id(), Instant::now()));
        // The warden may have been killed meanwhile.
        let _ = warden.tell("next");
        if warden.hear_within(2 * PATIENCE).is_some() {
            self.friend.order("leave")?;
            let _ = warden.tell("end");
            while warden.hear_within(2 * PATIENCE).is_some() {}
        }
        Ok(died)
    }

    fn check(&mut self, end: &End, pid: u32, victim: Option<(u32, Instant)>) -> Result<()> {
        let (start, before) = (Instant::now(), stolen());
        if self.scene == Scene::Warden {
            if end.code.is_some() {
                has_gone(self.stage.domain)?;
            }
            if end.code.is_some() || victim.is_none() || !self.friend.ask::<bool>("has_joined")? {
                self.friend.order("join")?;
            }
        }
        for (pid, died) in [Some((pid, end.at)), victim].into_iter().flatten() {
            // The process that cleans up may have joined later.
            let since = if self.scene == Scene::Warden { start.max(died) } else { died };
            // The start of the last check that found files: the check that finds none may have taken long itself.
            let mut stayed = Duration::ZERO;
            loop {
                let begin = since.elapsed();
                let left = of_dead(self.stage.domain, pid);
                if left.is_empty() {
                    break;
                }
                if begin > PATIENCE / 4 {
                    return Err(format!("files of {pid}, which is dead, stay: {left:?}").into());
                }
                stayed = begin;
                thread::sleep(Duration::from_micros(200));
            }
            self.within(STAY, stayed, before, "files of the dead")?;
        }
        let own: Met = self.friend.ask("meet")?;
        let Graph { took, of_process, .. } = self.inspector.ask(&format!("graph {pid}"))?;
        let met: Met = self.inspector.ask("meet")?;
        let full: Duration = self.friend.ask("full")?;
        if of_process > 0 {
            return Err(format!("the graph has {of_process} things of a process that is dead").into());
        }
        self.within(ANSWER, took, before, "graph")?;
        self.within(ANSWER, own.answered, before, "the friend's own message")?;
        let newcomer = self.within(ANSWER, met.answered, before, "a newcomer's message");
        newcomer.map_err(|error| format!("{error}: {met:?}"))?;
        self.within(ANSWER, full, before, "a publisher held up")?;
        if self.scene == Scene::Warden {
            self.friend.order("leave")?;
            has_gone(self.stage.domain)?;
        }
        Ok(())
    }

    /// Records a time, and checks that it is within its limit plus the steal.
    fn within(
        &mut self,
        limit: Duration,
        time: Duration,
        stolen_before: Duration,
        what: &'static str,
    ) -> Result<()> {
        self.outcome.note(what, time);
        if time <= limit || time <= limit + stolen().saturating_sub(stolen_before) {
            return Ok(());
        }
        let late = format!("{what}: {}, more than {}", ms(time), ms(limit));
        if self.has_limits {
            return Err(late.into());
        }
        println!("       {late}, at {}", self.at);
        Ok(())
    }

    fn finish(mut self) -> Result<()> {
        let mut holdings = self.friend.holdings();
        // The friend may have another process's files open at this moment.
        let is_as_before = || {
            holdings = self.friend.holdings();
            Ok(holdings.files <= self.friends_files && holdings.removed.len() <= HELD_BY_IDLE)
        };
        let released = wait("the friend to have what it had", PATIENCE, is_as_before);
        released.map_err(|error| format!("{error}: {} files, and {holdings:?}", self.friends_files))?;
        self.inspector.finish()?;
        self.friend.finish()
    }
}
