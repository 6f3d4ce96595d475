// SPDX-License-Identifier: MIT OR Apache-2.0
//! Processes with every kind of endpoint, each killed at a random instant and replaced. Most of the time survivors run beside them, and
//! count messages; in between there are no survivors, and the warden is killed, too.

use crate::actors::{self, Role};
use crate::folder::{self, Watch};
use crate::inspector::{Graph, Late, Met};
use crate::place::Place;
use crate::process::{Complaints, HELD_BY_IDLE, Holdings, PATIENCE, Process, Stage, kill, ms, wait};
use crate::survivors::{ACTORS_ADD, ACTORS_FIBONACCI, ADD, Asked, FULL, OF_SERVERS_THAT_GO, Received, Sent};
use crate::{Common, Result};
use clap::{Args, ValueEnum};
use rand::rngs::SmallRng;
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use std::process::{Child, Stdio};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

const DOMAIN: u32 = 0;
/// Maximum lifetime of an actor.
const LIFE: Duration = Duration::from_millis(80);
/// Time limit for reading the graph, and for a new participant to create a topic and receive a message on it.
const ANSWER: Duration = Duration::from_millis(100);
/// Time limit for 99 of 100 files of dead processes to stay, without the time for which others had the core that their cleanup needed.
const STAY: Duration = Duration::from_millis(50);
/// The same limit for the other files.
const STAY_LATE: Duration = Duration::from_millis(500);
const CHECK_EVERY: usize = 100;
/// The part that answers newcomers.
const ECHO: &str = "survivor-echo";
/// Number of checks with survivors before one without.
const CHECKS_WITH_SURVIVORS: usize = 4;
/// Processes that live until they are the warden, when there are no survivors.
const IDLE: usize = 2;

#[derive(Args, Debug)]
pub struct Options {
    /// How many processes are killed
    #[arg(long, value_name = "N", default_value_t = 1000)]
    kills: usize,
    #[command(flatten)]
    common: Common,
    /// How many processes there are at once that are killed
    #[arg(long, value_name = "N", default_value_t = 8)]
    actors: usize,
}

pub fn run(options: &Options) -> Result<()> {
    actors::check()?;
    let seed = options.common.seed.unwrap_or_else(rand::random);
    println!("{} kills of {} processes, seed {seed}", options.kills, options.actors);
    let place = Place::new()?;
    let stage = Stage { domain: DOMAIN, complaints: Complaints::collect()? };
    let start = Instant::now();
    let mut run = Run {
        stage: stage.clone(),
        random: SmallRng::seed_from_u64(seed),
        actors: Vec::new(),
        wanted: options.actors,
        has_limits: !options.common.no_limits,
        killed: 0,
        worst: Worst::default(),
    };
    let result = run.run(options.kills);
    let (killed, worst) = (run.killed, run.worst);
    let result = result.map_err(|error| {
        let (listing, said) = (folder::listing(DOMAIN), stage.complaints.text());
        format!("{error}\nafter {killed} kills, seed {seed}\n{listing}{said}")
    });
    drop(run);
    result?;
    place.check()?;
    println!(
        "{killed} kills in {:.1} s; at most: graph {}, a newcomer's message {}, files of the dead {}, {} of {} longer than {STAY:?} plus \
         what their cleanup waited for a core; nothing was lost uncounted, and nothing is left",
        start.elapsed().as_secs_f64(),
        ms(worst.graph),
        ms(worst.met),
        ms(worst.stay),
        worst.late,
        worst.files,
    );
    if !options.common.no_limits && 100 * worst.late > worst.files {
        return Err(format!(
            "more than 1 of 100 files of the dead stayed longer than {STAY:?} plus what their cleanup waited for a core"
        )
        .into());
    }
    Ok(())
}

#[derive(Clone, Copy, Default)]
struct Worst {
    graph: Duration,
    met: Duration,
    stay: Duration,
    files: usize,
    late: usize,
}

struct Run {
    stage: Stage,
    random: SmallRng,
    actors: Vec<Actor>,
    wanted: usize,
    has_limits: bool,
    killed: usize,
    worst: Worst,
}

struct Actor {
    role: Role,
    seed: u64,
    child: Child,
    due: Instant,
}

impl Actor {
    /// Kills the actor; the files that it leaves are watched from now on.
    fn kill(mut self, watch: &Watch) -> Result<()> {
        watch.dies(self.child.id(), || {
            self.child.kill()?;
            self.child.wait()?;
            Ok(())
        })
    }
}

impl Drop for Actor {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Run {
    fn run(&mut self, kills: usize) -> Result<()> {
        for check in 0.. {
            let left = kills.saturating_sub(self.killed);
            if left == 0 {
                return Ok(());
            }
            if check % 2 == 0 {
                self.with_survivors(left.min(CHECKS_WITH_SURVIVORS * CHECK_EVERY))?;
            } else {
                self.without_survivors(left.min(CHECK_EVERY))?;
            }
            folder::has_gone(DOMAIN)?;
        }
        Ok(())
    }

    fn start_actor(&mut self) -> Result<Actor> {
        let role = *Role::value_variants().choose(&mut self.random).expect("there are roles");
        let seed = self.random.random();
        let mut command = self.stage.command(&role.part(), seed)?;
        let child = command.stdin(Stdio::null()).stdout(Stdio::null()).spawn()?;
        let due = Instant::now() + self.random.random_range(Duration::ZERO..=LIFE);
        Ok(Actor { role, seed, child, due })
    }

    fn with_survivors(&mut self, kills: usize) -> Result<()> {
        let mut survivors = Survivors {
            subscription: self.stage.start("survivor-subscription")?,
            publisher: self.stage.start("survivor-publisher")?,
            server: self.stage.start("survivor-server")?,
            client: self.stage.start("survivor-client")?,
        };
        survivors.publisher.tell("go")?;
        survivors.client.tell("go")?;
        thread::sleep(Duration::from_millis(200));
        let before = survivors.all().map(Process::holdings);
        let watch = Watch::start(DOMAIN, STAY)?;
        self.kill(kills, &watch, true, &mut [])?;
        std::mem::take(&mut self.actors).into_iter().try_for_each(|actor| actor.kill(&watch))?;
        wait("files of the dead to go", PATIENCE, || watch.check(PATIENCE).map(|()| watch.is_clean()))?;
        let mut after: [Holdings; 4] = Default::default();
        let is_as_before = || {
            after = survivors.all().map(Process::holdings);
            let is_as_before = |(after, before): (&Holdings, &Holdings)| {
                after.files == before.files && after.removed.len() <= HELD_BY_IDLE
            };
            Ok(after.iter().zip(&before).all(is_as_before))
        };
        let released = wait("survivors to have what they had", PATIENCE, is_as_before);
        released.map_err(|error| format!("{error}: before {before:?}, after {after:#?}"))?;
        survivors.check_messages()?;
        survivors.check_answers()?;
        survivors.finish()
    }

    fn without_survivors(&mut self, kills: usize) -> Result<()> {
        let mut idle = Vec::new();
        for _ in 0..IDLE {
            idle.push(Idle { process: self.stage.start(ECHO)?, is_ready: true });
        }
        let watch = Watch::start(DOMAIN, STAY)?;
        self.kill(kills, &watch, false, &mut idle)?;
        // Kills all at once, so that no process is left to clean up.
        let pids: Vec<u32> = idle.iter().map(|idle| idle.process.id()).collect();
        for pid in self.actors.iter().map(|actor| actor.child.id()).chain(pids) {
            kill(pid)?;
        }
        self.actors.clear();
        idle.clear();
        let mut next = self.stage.start(ECHO)?;
        let is_clean = || Ok(folder::of_none(DOMAIN, &[next.id()]).is_empty());
        wait("the next one to clean up", PATIENCE, is_clean)?;
        next.finish()
    }

    /// Kills actors, each when it is due, and replaces them; checks after each hundred.
    fn kill(&mut self, kills: usize, watch: &Watch, has_survivors: bool, idle: &mut [Idle]) -> Result<()> {
        while self.actors.len() < self.wanted {
            let actor = self.start_actor()?;
            self.actors.push(actor);
        }
        let inspector = self.stage.start("inspector")?;
        let mut looking: Looking = thread::spawn(move || Ok((inspector, None)));
        for kill in 1..=kills {
            let killed = match self.is_warden(idle) {
                Some(index) => self.replace_idle(&mut idle[index], watch),
                None => self.kill_next(watch),
            };
            if killed.is_err() {
                // The inspector ends with the thread's result, before its folder is removed.
                drop(looking.join());
                return killed;
            }
            self.killed += 1;
            if kill % CHECK_EVERY == 0 || kill == kills {
                let (inspector, killed) = (self.note(looking, watch)?, self.killed);
                looking = thread::spawn(move || look(inspector, killed, has_survivors));
            }
        }
        self.note(looking, watch)?.finish()
    }

    /// The index of the idle process that is the warden, if the others can replace it.
    fn is_warden(&mut self, idle: &mut [Idle]) -> Option<usize> {
        for idle in idle.iter_mut().filter(|idle| !idle.is_ready) {
            idle.is_ready = idle.process.hear_within(Duration::ZERO).is_some();
        }
        if idle.iter().any(|idle| !idle.is_ready) || self.random.random_bool(0.5) {
            return None;
        }
        let warden = folder::warden(DOMAIN)?;
        idle.iter().position(|idle| idle.process.id() == warden)
    }

    fn replace_idle(&mut self, idle: &mut Idle, watch: &Watch) -> Result<()> {
        watch.dies(idle.process.id(), || idle.process.kill())?;
        *idle = Idle { process: self.stage.start_without_waiting(ECHO)?, is_ready: false };
        Ok(())
    }

    fn kill_next(&mut self, watch: &Watch) -> Result<()> {
        let next = self.actors.iter().enumerate().min_by_key(|(_, actor)| actor.due);
        let (index, due) = next.map(|(index, actor)| (index, actor.due)).ok_or("there are no actors")?;
        while let Some(left) = due.checked_duration_since(Instant::now()) {
            thread::sleep(left.min(Duration::from_millis(10)));
            watch.check(PATIENCE)?;
        }
        watch.check(PATIENCE)?;
        let mut actor = self.actors.swap_remove(index);
        if let Some(status) = actor.child.try_wait()? {
            let Actor { role, seed, .. } = &actor;
            return Err(format!("an actor ended by itself, {status}: {role:?} of seed {seed}").into());
        }
        actor.kill(watch)?;
        let next = self.start_actor()?;
        self.actors.push(next);
        Ok(())
    }

    /// Waits for the inspector's result and checks it. Returns the inspector for the next check.
    fn note(&mut self, looking: Looking, watch: &Watch) -> Result<Process> {
        let (inspector, hundred) = looking.join().map_err(|_| "the inspection panicked")??;
        let Some(hundred) = hundred else { return Ok(inspector) };
        let stay = watch.take();
        let Hundred { kills, graph, met, late, delay } = &hundred;
        let text = late.as_ref().map_or(String::new(), |late| {
            format!(", {} kept for a late joiner in {}", late.kept, ms(late.took))
        });
        println!(
            "{kills:6} kills: graph of {} nodes, {} ends {}; a newcomer joined {}, made {}, matched {}, got a message {}{text}; {} files of the dead \
             stayed at most {}",
            graph.nodes,
            graph.ends,
            ms(graph.took),
            ms(met.joined),
            ms(met.made),
            ms(met.matched),
            ms(met.answered),
            stay.files,
            ms(stay.worst),
        );
        let worst = &mut self.worst;
        worst.graph = worst.graph.max(graph.took);
        worst.met = worst.met.max(met.answered);
        worst.stay = worst.stay.max(stay.worst);
        worst.files += stay.files;
        worst.late += stay.late.len();
        let limit = ANSWER + *delay;
        if self.has_limits && (graph.took > limit || met.answered > limit) {
            return Err(format!(
                "longer than {ANSWER:?} and the {delay:?} in which the inspector got no core"
            )
            .into());
        }
        if self.has_limits && stay.late.iter().any(|(_, stayed)| *stayed > STAY_LATE) {
            return Err(format!("files of the dead stayed longer than {STAY_LATE:?}: {:?}", stay.late).into());
        }
        match late {
            Some(late) if late.kept < late.expected || late.lost + late.missing > 0 => {
                Err(format!("a late joiner lacks messages that were kept: {late:?}").into())
            }
            _ => Ok(inspector),
        }
    }
}

struct Idle {
    process: Process,
    is_ready: bool,
}

struct Hundred {
    kills: usize,
    graph: Graph,
    met: Met,
    late: Option<Late>,
    /// The time for which the inspector got no core meanwhile.
    delay: Duration,
}

/// A check by the inspector, which runs while other processes are killed.
type Looking = JoinHandle<Result<(Process, Option<Hundred>)>>;

fn look(mut inspector: Process, kills: usize, has_survivors: bool) -> Result<(Process, Option<Hundred>)> {
    let pid = inspector.id();
    // The inspector's first thread does all of the work.
    let delays = || folder::stolen() + folder::waited(pid);
    let before = delays();
    let (graph, met) = (inspector.ask("graph")?, inspector.ask("meet")?);
    let delay = delays().saturating_sub(before);
    let late = if has_survivors { Some(inspector.ask("late")?) } else { None };
    Ok((inspector, Some(Hundred { kills, graph, met, late, delay })))
}

struct Survivors {
    subscription: Process,
    publisher: Process,
    server: Process,
    client: Process,
}

impl Survivors {
    fn all(&self) -> [&Process; 4] {
        [&self.subscription, &self.publisher, &self.server, &self.client]
    }

    /// Checks that each message that was sent has arrived, or is counted as lost.
    fn check_messages(&mut self) -> Result<()> {
        let sent: Sent = self.publisher.ask("stop")?;
        let mut received = Received::default();
        let subscription = &mut self.subscription;
        let all_came = || {
            received = subscription.ask("report")?;
            let Received { numbers, all, .. } = &received;
            Ok(numbers.received + numbers.lost == sent.numbers && all.received == sent.all)
        };
        let came = wait("what was sent to come or be counted", PATIENCE, all_came);
        let Received { numbers, shared, all } = &received;
        let Sent { longest_full_ms, .. } = sent;
        let sums = format!(
            "numbers: {} sent, {} came, {} counted as lost; shared with actors: {} of survivors sent, {} of all came, {} counted as lost, {} \
             missing; keep-all: {} sent, {} came, at most {longest_full_ms} ms full",
            sent.numbers,
            numbers.received,
            numbers.lost,
            sent.shared,
            shared.received,
            shared.lost,
            shared.missing,
            sent.all,
            all.received
        );
        println!("       survivors: {sums}");
        came.map_err(|error| format!("{error}: {sums}"))?;
        let is_right = numbers.missing == numbers.lost
            && shared.missing <= shared.lost
            && all.lost + all.missing == 0
            && numbers.disordered + shared.disordered + all.disordered == 0;
        if is_right { Ok(()) } else { Err(format!("lost uncounted: {received:?} of {sent:?}").into()) }
    }

    /// Checks that each request was answered, or ended with an error.
    fn check_answers(&mut self) -> Result<()> {
        let asked: Asked = self.client.ask("stop")?;
        for (name, answers) in &asked {
            println!(
                "       {name}: {} asked, {} answered, errors {:?}, at most {} ms",
                answers.asked, answers.answered, answers.errors, answers.slowest_ms
            );
        }
        check_answers(&asked)
    }

    fn finish(mut self) -> Result<()> {
        [&mut self.client, &mut self.server, &mut self.publisher, &mut self.subscription]
            .into_iter()
            .try_for_each(Process::finish)
    }
}

fn check_answers(asked: &Asked) -> Result<()> {
    for name in [ADD, ACTORS_ADD, ACTORS_FIBONACCI] {
        let answers = asked.get(name).ok_or_else(|| format!("nothing was asked of {name}"))?;
        if answers.hung + answers.wrong != 0 {
            return Err(
                format!("{name}: not answered, or with the answer to something else: {answers:?}").into()
            );
        }
        // One server of /add always lives; only an actor's server may have a full queue.
        let may_end = |error: &str| error == FULL || name != ADD && OF_SERVERS_THAT_GO.contains(&error);
        if let Some(error) = answers.errors.keys().find(|error| !may_end(error)) {
            return Err(format!("{name}: a request ended with {error}").into());
        }
    }
    Ok(())
}
