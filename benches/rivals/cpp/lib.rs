// SPDX-License-Identifier: MIT OR Apache-2.0
//! The ends of all exchanges for a system with a C or C++ interface: here is what is measured, there what sends and receives.
//! `exchange.hpp` is the other side.
#![allow(missing_docs, reason = "many names say it all")]

use std::ffi::{CStr, CString, c_char, c_int, c_void};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use tautline_exchange::{
    Exchange, Job, Line, Measured, Result, Role, RoundTrips, Sink, Source, Stamp, program, say, stop_flag,
    wait_for_stop,
};
use tautline_rt::clock::monotonic_ns;

/// How often it is looked whether an answer is overdue.
const LOOK: Duration = Duration::from_millis(50);
/// How long what is under way may take to arrive.
const DRAIN: Duration = Duration::from_millis(100);

/// What a system is told.
#[repr(C)]
pub struct CJob {
    mode: *const c_char,
    payload_bytes: usize,
    /// Messages that a queue has room for.
    depth: i32,
    domain: u32,
    is_stream: bool,
    is_round_trips: bool,
    whole: bool,
}

/// Called with what arrives, from any thread.
type Arrive = unsafe extern "C" fn(to: *const c_void, stamp: Stamp);

/// A system's functions. None returns null or an exception: one that fails ends the process.
#[repr(C)]
pub struct System {
    name: *const c_char,
    version: *const c_char,
    participant: unsafe extern "C" fn(job: *const CJob) -> *mut c_void,
    outlet:
        unsafe extern "C" fn(participant: *mut c_void, job: *const CJob, topic: *const c_char) -> *mut c_void,
    /// Sends a message; says whether the system took it.
    send: unsafe extern "C" fn(outlet: *mut c_void, stamp: Stamp) -> bool,
    input: unsafe extern "C" fn(
        participant: *mut c_void,
        job: *const CJob,
        topic: *const c_char,
        arrive: Arrive,
        to: *const c_void,
    ) -> *mut c_void,
    /// Nothing arrives any more.
    close: unsafe extern "C" fn(input: *mut c_void),
    end: unsafe extern "C" fn(participant: *mut c_void),
}

// SAFETY: functions and texts that nobody writes.
unsafe impl Sync for System {}

/// Set when standard input is closed.
static STOP: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// The whole program of a system, whose first argument is a job as JSON, or `version`.
///
/// # Safety
/// The system and its texts are there until the process ends, and its functions are as [`System`] says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn exchange_play(system: &'static System) -> c_int {
    // SAFETY: as the caller says.
    let text = |text| unsafe { CStr::from_ptr(text) }.to_string_lossy();
    if std::env::args().nth(1).as_deref() == Some("version") {
        println!("{}", text(system.version));
        return 0;
    }
    STOP.get_or_init(stop_flag);
    let run = |job: Job| {
        let own = job.clone();
        // The middleware's threads inherit the priority.
        job.as_application(move || play(system, &own))
    };
    c_int::from(program(&text(system.name), run) != std::process::ExitCode::SUCCESS)
}

/// Writes a message.
///
/// # Safety
/// `out` are so many bytes, which nobody else has.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn exchange_write(stamp: Stamp, out: *mut u8, bytes: usize, whole: bool) {
    // SAFETY: as the caller says; they may not have been written before.
    let out = unsafe { std::slice::from_raw_parts_mut(out.cast(), bytes) };
    stamp.write_uninit(out, whole);
}

/// Reads a message; says whether it is as it was written.
///
/// # Safety
/// `bytes` of `from` were written, and nobody writes them meanwhile.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn exchange_read(
    from: *const u8,
    bytes: usize,
    whole: bool,
    stamp: &mut Stamp,
) -> bool {
    // SAFETY: as the caller says.
    let from = unsafe { std::slice::from_raw_parts(from, bytes) };
    // Also of what is damaged, so that it can be named.
    let begins = Stamp::read(from, false).map(|read| *stamp = read);
    begins.and_then(|()| Stamp::read(from, whole)).is_ok()
}

/// Whether the process is to end.
#[unsafe(no_mangle)]
pub extern "C" fn exchange_stopped() -> bool {
    STOP.get().is_some_and(|stop| stop.load(Ordering::Relaxed))
}

fn play(system: &'static System, job: &Job) -> Result<()> {
    let stop = STOP.get_or_init(stop_flag).clone();
    let mode = CString::new(job.way.mode.as_str())?;
    let told = CJob {
        mode: mode.as_ptr(),
        payload_bytes: job.payload_bytes,
        depth: i32::try_from(job.depth())?,
        domain: job.domain,
        is_stream: matches!(job.exchange, Exchange::Stream { .. }),
        is_round_trips: job.exchange == Exchange::RoundTrips,
        whole: job.way.whole,
    };
    // SAFETY: the job lives as long as what is made with it is used.
    let participant = unsafe { (system.participant)(&raw const told) };
    let ends = Ends { system, told: &told, participant };
    match (job.exchange, job.role) {
        (Exchange::RoundTrips, Role::Near) => ends.ask(job),
        (Exchange::RoundTrips, Role::Far) => ends.answer(job, &stop),
        (_, Role::Near) => ends.send_flow(job, stop),
        (_, Role::Far) => ends.receive_flow(job, &stop),
    }
}

/// A participant, which ends with it.
struct Ends<'a> {
    system: &'static System,
    told: &'a CJob,
    participant: *mut c_void,
}

impl Drop for Ends<'_> {
    fn drop(&mut self) {
        // SAFETY: its outlets and inputs are used no more.
        unsafe { (self.system.end)(self.participant) };
    }
}

#[derive(Clone, Copy)]
struct Outlet {
    system: &'static System,
    outlet: *mut c_void,
}

// SAFETY: a system's writers may be used by any thread, one at a time.
unsafe impl Send for Outlet {}
// SAFETY: of round trips one thread at a time sends, for each waits for the other's answer or holds a lock.
unsafe impl Sync for Outlet {}

impl Outlet {
    fn send(&self, stamp: Stamp) -> bool {
        // SAFETY: made by `Ends::outlet`, whose participant has not ended.
        unsafe { (self.system.send)(self.outlet, stamp) }
    }
}

/// What is called with what arrives, until it is dropped.
struct Input<'a> {
    system: &'static System,
    input: *mut c_void,
    _then: Box<Then<'a>>,
}

type Then<'a> = Box<dyn Fn(Stamp) + Sync + 'a>;

impl Drop for Input<'_> {
    fn drop(&mut self) {
        // SAFETY: made by `Ends::input`; from then on `_then` is not called.
        unsafe { (self.system.close)(self.input) };
    }
}

unsafe extern "C" fn arrive(to: *const c_void, stamp: Stamp) {
    // SAFETY: `Ends::input` gave it, and its `Input` still has it.
    let then = unsafe { &*to.cast::<Then<'_>>() };
    then(stamp);
}

impl Ends<'_> {
    fn outlet(&self, topic: &str) -> Result<Outlet> {
        let topic = name(topic)?;
        // SAFETY: the participant is there.
        let outlet = unsafe { (self.system.outlet)(self.participant, self.told, topic.as_ptr()) };
        Ok(Outlet { system: self.system, outlet })
    }

    fn input<'a>(&self, topic: &str, then: impl Fn(Stamp) + Sync + 'a) -> Result<Input<'a>> {
        let (topic, then): (_, Box<Then<'a>>) = (name(topic)?, Box::new(Box::new(then)));
        let to = (&raw const *then).cast();
        // SAFETY: the participant is there, and `then` as long as the input.
        let input = unsafe { (self.system.input)(self.participant, self.told, topic.as_ptr(), arrive, to) };
        Ok(Input { system: self.system, input, _then: then })
    }

    fn ask(&self, job: &Job) -> Result<()> {
        let [to, from] = job.topics();
        let out = self.outlet(&to)?;
        // `None`: enough was measured.
        let trips = Mutex::new((RoundTrips::new(job), true));
        let start = |(trips, goes_on): &mut (RoundTrips, bool)| match trips.start().filter(|_| *goes_on) {
            Some(number) => _ = out.send(Stamp { number, sent_ns: monotonic_ns() }),
            None => *goes_on = false,
        };
        let lock = || trips.lock().unwrap_or_else(PoisonError::into_inner);
        let input = self.input(&from, |answer| {
            let mut trips = lock();
            if trips.0.end(answer.number) {
                start(&mut trips);
            }
        })?;
        start(&mut lock());
        loop {
            std::thread::sleep(LOOK);
            let mut trips = lock();
            if !trips.1 {
                break;
            }
            if trips.0.is_overdue() {
                trips.0.give_up()?;
                start(&mut trips);
            }
        }
        drop(input);
        let (trips, _) = trips.into_inner().unwrap_or_else(PoisonError::into_inner);
        say(&Line::Measured(trips.measured()));
        Ok(())
    }

    fn answer(&self, job: &Job, stop: &AtomicBool) -> Result<()> {
        let [to, from] = job.topics();
        let out = self.outlet(&to)?;
        // Ignored: the other end counts what it misses.
        let answer = move |question: Stamp| _ = out.send(Stamp { sent_ns: monotonic_ns(), ..question });
        let _input = self.input(&from, answer)?;
        say(&Line::Ready(None));
        wait_for_stop(stop);
        Ok(())
    }

    fn send_flow(&self, job: &Job, go: Arc<AtomicBool>) -> Result<()> {
        let topics = 0..job.way.topics;
        let outlets = topics.map(|index| self.outlet(&topic(job, index))).collect::<Result<Vec<_>>>()?;
        let (mut source, mut refused) = (Source::new(job, go), 0);
        while let Some((topic, stamp)) = source.next() {
            refused += u64::from(!outlets[topic].send(stamp));
        }
        say(&Line::Measured(Measured { refused, ..source.measured() }));
        // What is under way is repeated from its history.
        std::thread::sleep(DRAIN);
        Ok(())
    }

    fn receive_flow(&self, job: &Job, stop: &AtomicBool) -> Result<()> {
        let sink = Sink::new(job);
        let mut inputs = Vec::new();
        for (index, inlet) in sink.inlets(job) {
            inputs.push(self.input(&topic(job, index), move |stamp| inlet.arrive(stamp))?);
        }
        say(&Line::Ready(None));
        wait_for_stop(stop);
        drop(inputs);
        say(&Line::Measured(sink.measured()));
        Ok(())
    }
}

fn topic(job: &Job, index: usize) -> String {
    format!("{}/t{index}", job.topic)
}

/// As DDS has them.
fn name(topic: &str) -> Result<CString> {
    Ok(CString::new(topic.trim_start_matches('/'))?)
}
