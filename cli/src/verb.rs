// SPDX-License-Identifier: MIT OR Apache-2.0
//! What all verbs share: their domain, time limit and output format; how they wait, and how they end.

use clap::{Args, Subcommand};
use std::cell::Cell;
use std::error::Error;
use std::fmt;
use std::io;
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tautline::Context;

/// Options of every verb that reads a domain. They may be given anywhere after the first word.
#[derive(Args, Clone, Debug)]
pub struct CommonArgs {
    /// The domain [default: TAUT_DOMAIN, else ROS_DOMAIN_ID, else 0]
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=232))]
    domain: Option<u32>,
    /// Print JSON: one value, or a line for each value of continuous output
    #[arg(long, global = true)]
    pub json: bool,
    /// End after this time, such as 500ms or 10s
    #[arg(long, global = true, value_name = "TIME", value_parser = time)]
    timeout: Option<Duration>,
}

// A verb with verbs of its own. It has no doc comment, because that would replace the help text, which is the doc comment of `V`. For the
// same reason `verb` is last.
#[derive(Args, Clone, Debug)]
pub struct Verbs<V: Subcommand> {
    #[command(flatten)]
    pub common: CommonArgs,
    #[command(subcommand)]
    pub verb: V,
}

impl CommonArgs {
    pub fn domain(&self) -> Result<u32, tautline::Error> {
        self.domain.map_or_else(Context::domain_of_environment, Ok)
    }

    pub fn is_domain_named(&self) -> bool {
        self.domain.is_some()
    }

    /// Ends the program after `--timeout`, for verbs that do not wait but may take long.
    pub fn bound(&self) {
        let Some(timeout) = self.timeout else { return };
        std::thread::spawn(move || {
            std::thread::sleep(timeout);
            Failure::no(format!("not done after {timeout:?}")).print();
            std::process::exit(1);
        });
    }

    /// The time limit of the verb, if `--timeout` states one.
    pub fn timeout(&self) -> Option<Duration> {
        self.timeout
    }
}

/// A number and its unit.
pub fn time(text: &str) -> Result<Duration, String> {
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let unit_ns = match &text[digits.len()..] {
        "ns" => 1.0,
        "us" => 1e3,
        "ms" => 1e6,
        "s" | "" => 1e9,
        "min" => 60e9,
        "h" => 3600e9,
        other => return Err(format!("'{other}' is no unit of time: ns, us, ms, s, min, h")),
    };
    let number = digits.parse::<f64>().ok().filter(|number| (0.0..1e15).contains(number));
    let number = number.ok_or_else(|| format!("'{digits}' is no number: a time is 500ms or 10s"))?;
    Ok(Duration::from_nanos((number * unit_ns) as u64))
}

/// Why a verb failed. The exit code is 1 if the answer is no, 2 if the arguments cannot be used or the system refuses.
#[derive(Debug)]
pub struct Failure {
    code: u8,
    text: String,
}

pub type Outcome<T = ()> = Result<T, Failure>;

impl Failure {
    pub fn no(text: impl Into<String>) -> Self {
        Failure { code: 1, text: text.into() }
    }

    pub fn unusable(text: impl Into<String>) -> Self {
        Failure { code: 2, text: text.into() }
    }

    /// The failure of a verb that was interrupted before there was an answer.
    pub fn interrupted() -> Self {
        Failure::no("")
    }

    pub fn unreadable(path: &Path, error: &io::Error) -> Self {
        Failure::unusable(format!("`{}` cannot be read: {error}", path.display()))
    }

    pub fn unwritable(path: &Path, error: &io::Error) -> Self {
        Failure::unusable(format!("`{}` cannot be written: {error}", path.display()))
    }

    /// The failure if no `what` is called `name`; suggests the nearest of the names `there`, which `taut LIST` prints.
    pub fn unknown<'n>(what: &str, name: &str, there: impl Iterator<Item = &'n str>, list: &str) -> Self {
        let meant = did_you_mean(name, there);
        Failure::no(format!("there is no {what} '{name}';{meant} `taut {list}` prints which there are"))
    }

    /// Prints the reason and returns the exit code.
    pub fn print(self) -> ExitCode {
        if !self.text.is_empty() {
            eprintln!("taut: {}", self.text);
        }
        ExitCode::from(self.code)
    }
}

/// A question for the nearest name, with a space before it; empty if no name is similar.
pub fn did_you_mean<'n>(name: &str, there: impl Iterator<Item = &'n str>) -> String {
    let alike = there.map(|other| (strsim::jaro_winkler(name, other), other));
    match alike.max_by(|one, other| one.0.total_cmp(&other.0)) {
        Some((likeness, nearest)) if likeness > 0.8 => format!(" did you mean {nearest}?"),
        _ => String::new(),
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl<E: Error + 'static> From<E> for Failure {
    fn from(error: E) -> Self {
        let io = (&error as &(dyn Error + 'static)).downcast_ref::<io::Error>();
        match io {
            // The reader of the output has ended.
            Some(io) if io.kind() == io::ErrorKind::BrokenPipe => Failure { code: 0, text: String::new() },
            Some(io) => Failure::unusable(format!("the result cannot be printed: {io}")),
            None => Failure::unusable(error.to_string()),
        }
    }
}

/// The end of a verb with continuous output: Ctrl-C, SIGTERM, a closed terminal (unless `nohup` started the verb), or a time limit.
pub struct End {
    interrupted: Arc<AtomicBool>,
    timeout: Option<Duration>,
    /// Whether the time limit does not restart.
    is_firm: bool,
    start: Instant,
    is_wait_printed: Cell<bool>,
}

pub enum Waited<T> {
    Ready(T),
    TimedOut,
    Interrupted,
}

/// The polling interval for changes without a notification.
const POLL: Duration = Duration::from_millis(20);
/// The time after which a wait prints what it is waiting for.
const PATIENCE: Duration = Duration::from_secs(1);

impl End {
    /// The end by `--timeout` or a signal. From now on, signals reach this end instead of killing the process.
    pub fn of(common: &CommonArgs) -> Outcome<Self> {
        Self::after(common.timeout)
    }

    /// Ends after this time, unless `--timeout` states another one.
    pub fn within(patience: Duration, common: &CommonArgs) -> Outcome<Self> {
        Self::after(common.timeout.or(Some(patience)))
    }

    /// Ends after this time, or only by a signal.
    ///
    /// # Errors
    /// Signals cannot be caught.
    pub fn after(timeout: Option<Duration>) -> Outcome<Self> {
        let interrupted = Arc::new(AtomicBool::new(false));
        for signal in tautline_rt::termination_signals() {
            signal_hook::flag::register(signal, interrupted.clone())
                .map_err(|error| Failure::unusable(format!("signals cannot be caught: {error}")))?;
        }
        Ok(End {
            interrupted,
            timeout,
            is_firm: false,
            start: Instant::now(),
            is_wait_printed: Cell::new(false),
        })
    }

    /// Ends at this time; later waits do not extend it.
    ///
    /// # Errors
    /// Signals cannot be caught.
    pub fn at(deadline: Instant) -> Outcome<Self> {
        let left = deadline.saturating_duration_since(Instant::now());
        Ok(End { is_firm: true, ..Self::after(Some(left))? })
    }

    pub fn is_reached(&self) -> bool {
        self.interrupted.load(Ordering::Relaxed) || self.left().is_some_and(|left| left.is_zero())
    }

    /// Waits 100 ms or until the end, and returns whether the end is reached.
    pub fn is_reached_soon(&self) -> bool {
        self.pause(5 * POLL);
        self.is_reached()
    }

    pub fn timeout(&self) -> Option<Duration> {
        self.timeout
    }

    pub fn left(&self) -> Option<Duration> {
        self.timeout.map(|timeout| timeout.saturating_sub(self.start.elapsed()))
    }

    /// Sleeps until the end at most; an interruption ends the sleep soon.
    pub fn pause(&self, time: Duration) {
        let end = Instant::now() + self.left().map_or(time, |left| left.min(time));
        loop {
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() || self.interrupted.load(Ordering::Relaxed) {
                return;
            }
            std::thread::sleep(left.min(POLL));
        }
    }

    /// Restarts the time limit, unless the end is [`at`](Self::at) a fixed time.
    pub fn restart(&mut self) {
        if !self.is_firm {
            self.start = Instant::now();
        }
    }

    /// Clears an interruption and sets this time limit from now on.
    pub fn again(&mut self, timeout: Duration) {
        self.interrupted.store(false, Ordering::Relaxed);
        self.timeout = Some(timeout);
        self.restart();
    }

    /// Calls `poll` until it returns a value: periodically, and when this thread is unparked. After a second, prints what it is waiting for.
    ///
    /// # Errors
    /// The time limit passed, a signal came, or `poll` failed.
    pub fn wait<T>(&self, what: impl Fn() -> String, poll: impl FnMut() -> Outcome<Option<T>>) -> Outcome<T> {
        match self.try_wait(&what, poll)? {
            Waited::Ready(found) => Ok(found),
            Waited::Interrupted => Err(Failure::interrupted()),
            Waited::TimedOut => {
                let time = self.timeout.unwrap_or_default();
                Err(Failure::no(format!("waited for {} for {time:?} and gave up", what())))
            }
        }
    }

    /// As [`wait`](Self::wait), but the end is no error.
    ///
    /// # Errors
    /// `poll` failed.
    pub fn try_wait<T>(
        &self,
        what: impl Fn() -> String,
        mut poll: impl FnMut() -> Outcome<Option<T>>,
    ) -> Outcome<Waited<T>> {
        let (start, mut is_printed) = (Instant::now(), false);
        loop {
            if let Some(found) = poll()? {
                return Ok(Waited::Ready(found));
            }
            if self.interrupted.load(Ordering::Relaxed) {
                return Ok(Waited::Interrupted);
            }
            if self.is_reached() {
                return Ok(Waited::TimedOut);
            }
            if start.elapsed() > PATIENCE && !std::mem::replace(&mut is_printed, true) {
                eprintln!("taut: waiting for {} ...", what());
            }
            std::thread::park_timeout(self.left().map_or(POLL, |left| left.min(POLL)));
        }
    }

    /// Prints once, after a second, what is waited for.
    pub fn print_waiting_once(&self, what: impl Fn() -> String) {
        if self.start.elapsed() > PATIENCE && !self.is_wait_printed.replace(true) {
            eprintln!("taut: waiting for {} ...", what());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_read() {
        for (text, ns) in
            [("500ms", 500_000_000), ("1.5s", 1_500_000_000), ("10", 10_000_000_000), ("2us", 2_000)]
        {
            assert_eq!(time(text), Ok(Duration::from_nanos(ns)), "{text}");
        }
        for wrong in ["", "s", "-1s", "5 s", "3parsec", "1e300s", "nan"] {
            assert!(time(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn the_nearest_name_is_suggested() {
        let there = ["/image", "/odometry"];
        let failure = Failure::unknown("topic", "/imgae", there.into_iter(), "topic list");
        assert_eq!(
            (failure.code, &*failure.text),
            (1, "there is no topic '/imgae'; did you mean /image? `taut topic list` prints which there are")
        );
        let failure = Failure::unknown("topic", "/x", there.into_iter(), "topic list");
        assert_eq!(failure.text, "there is no topic '/x'; `taut topic list` prints which there are");
    }

    #[test]
    fn closed_pipes_end_quietly() {
        let closed = Failure::from(io::Error::from(io::ErrorKind::BrokenPipe));
        assert_eq!((closed.code, &*closed.text), (0, ""));
    }
}
