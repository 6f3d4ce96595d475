// SPDX-License-Identifier: MIT OR Apache-2.0
//! Loggers, and the functions behind the macros.

use super::line::Line;
use super::output;
use super::rosout::Rosout;
use super::severity::{LEVELS, LogSeverity};
use std::fmt;
use std::hash::{Hash, Hasher};
use std::ops::Deref;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Weak};
use std::time::Duration;
use tautline_rt::clock::{monotonic_ns, wall_ns};

/// A name under which lines are logged. It can be used like r2r's logger, which is a `&str`.
///
/// ```
/// use std::time::Duration;
/// use tautline::{LogSeverity, Logger, log_debug, log_info, log_warn};
///
/// let logger = Logger::new("arm");
/// log_info!(logger, "moved to {:.1}", 0.25);
/// log_info!("another", "any name will do");
/// for attempt in 0..1000 {
///     log_warn!(logger.throttle(Duration::from_secs(1)), "attempt {attempt}"); // at most each second
///     log_info!(logger.once(), "the first attempt");
/// }
/// let driver = logger.child("driver"); // arm.driver: has arm's level unless it gets one
/// driver.set_level(LogSeverity::Debug);
/// log_debug!(driver, "{} bytes", 12);
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Logger {
    name: Arc<str>,
    life: Life,
}

/// Shared by a node's loggers: as long as one of them exists, their lines go to the node's topic. It does not affect their
/// equality.
#[derive(Clone, Debug, Default)]
struct Life(Arc<()>);

impl PartialEq for Life {
    fn eq(&self, _: &Life) -> bool {
        true
    }
}

impl Eq for Life {}

impl Hash for Life {
    fn hash<H: Hasher>(&self, _: &mut H) {}
}

impl Logger {
    /// A logger with this name; `a.b` is below `a`.
    ///
    /// # Real-time
    /// Setup only: allocates, starts the thread that writes the log lines of real-time threads.
    pub fn new(name: impl Into<Arc<str>>) -> Logger {
        output::start();
        Logger { name: name.into(), life: Life::default() }
    }

    pub(crate) fn of_node(fully_qualified_name: &str) -> Logger {
        let name = fully_qualified_name.trim_start_matches('/').replace('/', ".").into();
        Logger { name, life: Life::default() }
    }

    /// Publishes the lines of a node's logger on this topic, as long as the logger or one below it exists.
    pub(crate) fn add_topic(&self, topic: Weak<Rosout>) {
        output::add_topic(&self.name, topic, Arc::downgrade(&self.life.0));
    }

    /// Its name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The logger `name` below this one.
    pub fn child(&self, name: &str) -> Logger {
        Logger { name: format!("{}.{name}", self.name).into(), life: self.life.clone() }
    }

    /// Sets the minimum severity of lines of this logger and the loggers below it; [`LogSeverity::Unset`]: that of the
    /// loggers above it.
    ///
    /// # Real-time
    /// Allocates the first time.
    pub fn set_level(&self, level: LogSeverity) {
        LEVELS.set(&self.name, level);
    }

    /// The level that was set for this logger itself; [`LogSeverity::Unset`]: the level of the loggers above
    /// it applies.
    pub fn level(&self) -> LogSeverity {
        LEVELS.own(&self.name)
    }

    /// Whether a line of this severity would be written.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn is_enabled(&self, severity: LogSeverity) -> bool {
        LEVELS.enabled(&self.name, severity)
    }

    /// Logs only the first line of the statement in which it is used.
    pub fn once(&self) -> Occasional<'_> {
        Occasional { logger: self, period: None }
    }

    /// Logs at most one line per `period` of the statement in which it is used.
    pub fn throttle(&self, period: Duration) -> Occasional<'_> {
        Occasional { logger: self, period: Some(period) }
    }
}

impl Deref for Logger {
    type Target = str;

    fn deref(&self) -> &str {
        &self.name
    }
}

impl fmt::Display for Logger {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name)
    }
}

/// A logger for some of the lines of a statement: see [`Logger::once`] and [`Logger::throttle`].
#[derive(Clone, Copy, Debug)]
#[must_use = "give it to a log macro"]
pub struct Occasional<'l> {
    logger: &'l Logger,
    /// `None`: once.
    period: Option<Duration>,
}

/// The first argument of a log macro: a [`Logger`], a name, or a logger for [some lines](Occasional).
pub trait LogTarget {
    /// The logger's name.
    fn logger(&self) -> &str;

    /// Whether `site` may log now.
    fn permits(&self, _site: &Site) -> bool {
        true
    }
}

impl LogTarget for str {
    fn logger(&self) -> &str {
        self
    }
}

impl LogTarget for String {
    fn logger(&self) -> &str {
        self
    }
}

impl LogTarget for Logger {
    fn logger(&self) -> &str {
        &self.name
    }
}

impl LogTarget for Occasional<'_> {
    fn logger(&self) -> &str {
        self.logger
    }

    fn permits(&self, site: &Site) -> bool {
        site.is_due(self.period, monotonic_ns())
    }
}

impl<T: LogTarget + ?Sized> LogTarget for &T {
    fn logger(&self) -> &str {
        (**self).logger()
    }

    fn permits(&self, site: &Site) -> bool {
        (**self).permits(site)
    }
}

/// A log statement.
#[doc(hidden)]
pub struct Site {
    file: &'static str,
    line: u32,
    /// When it last logged, for statements that do not log every time; zero: never.
    last_ns: AtomicU64,
}

impl Site {
    /// For the macros.
    pub const fn new(file: &'static str, line: u32) -> Site {
        Site { file, line, last_ns: AtomicU64::new(0) }
    }

    /// Whether the line must be written now.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn permits(&self, severity: LogSeverity, target: &impl LogTarget) -> bool {
        LEVELS.enabled(target.logger(), severity) && target.permits(self)
    }

    /// Writes a line.
    ///
    /// # Real-time
    /// In a thread with a real-time policy: wait-free; no allocation, unless a formatted argument allocates. In
    /// other threads: waits until the line is written.
    pub fn log(&self, severity: LogSeverity, target: &impl LogTarget, text: fmt::Arguments<'_>) {
        let (logger, file, line) = (target.logger(), self.file, self.line);
        output::log(Line { time_ns: wall_ns(), severity, logger, text: "", file, line }, text);
    }

    fn is_due(&self, period: Option<Duration>, now_ns: u64) -> bool {
        let last = self.last_ns.load(Ordering::Relaxed);
        let due = match period {
            _ if last == 0 => true,
            None => false,
            Some(period) => u128::from(now_ns.saturating_sub(last)) >= period.as_nanos(),
        };
        // Of several threads only the first one logs.
        due && self
            .last_ns
            .compare_exchange(last, now_ns.max(1), Ordering::Relaxed, Ordering::Relaxed)
            .is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::log_debug;

    #[test]
    fn statements_log_once_or_each_period() {
        let site = Site::new("", 0);
        assert!(site.is_due(None, 5) && !site.is_due(None, 6));
        let site = Site::new("", 0);
        let second = Some(Duration::from_secs(1));
        let due: Vec<_> = (1..=40).filter(|n| site.is_due(second, n * 100_000_000)).collect();
        assert_eq!(due, [1, 11, 21, 31]);
    }

    #[test]
    fn what_is_not_wanted_is_not_formatted() {
        let logger = Logger::of_node("/quiet/node");
        assert_eq!(logger.name(), "quiet.node");
        let mut evaluated = 0;
        log_debug!(logger, "{}", {
            evaluated += 1;
            evaluated
        });
        logger.child("x").set_level(LogSeverity::Debug);
        assert!(logger.child("x").is_enabled(LogSeverity::Debug));
        assert_eq!(evaluated, 0);
    }
}
