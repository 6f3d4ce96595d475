// SPDX-License-Identifier: MIT OR Apache-2.0
//! The severity of log lines, and the levels of loggers.

use std::str::FromStr;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU8, Ordering};

/// The severity of a log line; the number is that of `rcl_interfaces/msg/Log`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[allow(missing_docs, reason = "the names say it")]
#[repr(u8)]
pub enum LogSeverity {
    /// For a logger: the level of the logger above it applies.
    Unset = 0,
    Debug = 10,
    Info = 20,
    Warn = 30,
    Error = 40,
    Fatal = 50,
}

tautline_rt::names!(LogSeverity: const ALL: [LogSeverity; 6]; pub const fn name(self) -> &'static str {
    Unset: "UNSET", Debug: "DEBUG", Info: "INFO", Warn: "WARN", Error: "ERROR", Fatal: "FATAL",
});

impl LogSeverity {
    pub(super) fn of_number(number: u32) -> Option<LogSeverity> {
        Self::ALL.into_iter().find(|severity| *severity as u32 == number)
    }
}

/// Accepts upper and lower case.
impl FromStr for LogSeverity {
    type Err = ();

    fn from_str(text: &str) -> Result<LogSeverity, ()> {
        LogSeverity::ALL.into_iter().find(|severity| severity.name().eq_ignore_ascii_case(text)).ok_or(())
    }
}

/// The levels of a process's loggers. A list that only grows, so that reading never waits.
pub(super) struct Levels {
    of_all: AtomicU8,
    first: OnceLock<Box<Named>>,
}

struct Named {
    logger: String,
    level: AtomicU8,
    next: OnceLock<Box<Named>>,
}

pub(super) static LEVELS: Levels = Levels::new();

impl Levels {
    const fn new() -> Levels {
        Levels { of_all: AtomicU8::new(LogSeverity::Info as u8), first: OnceLock::new() }
    }

    /// Sets the level of all loggers without one of their own.
    pub(super) fn set_all(&self, level: LogSeverity) {
        let level = if level == LogSeverity::Unset { LogSeverity::Info } else { level };
        self.of_all.store(level as u8, Ordering::Relaxed);
    }

    /// Sets the level of a logger and those below it. Allocates the first time for each name.
    pub(super) fn set(&self, logger: &str, level: LogSeverity) {
        self.set_one_of(usize::MAX, logger, level);
    }

    /// Like [`set`](Self::set), but returns false if there would be more than `most` loggers with a level of their own. Each makes every
    /// log statement compare one more name.
    pub(super) fn set_one_of(&self, most: usize, logger: &str, level: LogSeverity) -> bool {
        if logger.is_empty() {
            self.set_all(level);
            return true;
        }
        let mut place = &self.first;
        for count in 0.. {
            if count >= most && place.get().is_none() {
                return false;
            }
            let new = || Named { logger: logger.into(), level: AtomicU8::new(0), next: OnceLock::new() };
            let named = place.get_or_init(|| Box::new(new()));
            if named.logger == logger {
                named.level.store(level as u8, Ordering::Relaxed);
                return true;
            }
            place = &named.next;
        }
        false
    }

    /// The level that this logger has of its own; [`LogSeverity::Unset`]: none.
    pub(super) fn own(&self, logger: &str) -> LogSeverity {
        // As in ROS 2, the logger without a name stands for all.
        if logger.is_empty() {
            return LogSeverity::of_number(self.of_all.load(Ordering::Relaxed).into())
                .unwrap_or(LogSeverity::Info);
        }
        let mut place = self.first.get();
        while let Some(named) = place {
            if named.logger == logger {
                let level = named.level.load(Ordering::Relaxed);
                return LogSeverity::of_number(level.into()).unwrap_or(LogSeverity::Unset);
            }
            place = named.next.get();
        }
        LogSeverity::Unset
    }

    /// Whether the logger writes lines of this severity.
    ///
    /// # Real-time
    /// Wait-free: one comparison for each logger with a level of its own. No allocation, no syscall.
    pub(super) fn enabled(&self, logger: &str, severity: LogSeverity) -> bool {
        let (mut level, mut length) = (self.of_all.load(Ordering::Relaxed), 0);
        let mut place = self.first.get();
        while let Some(named) = place {
            let own = named.level.load(Ordering::Relaxed);
            if own != 0 && named.logger.len() >= length && is_below(logger, &named.logger) {
                (level, length) = (own, named.logger.len());
            }
            place = named.next.get();
        }
        severity as u8 >= level
    }
}

/// Whether the logger is `above` or below it: `robot.camera` is below `robot`.
pub(super) fn is_below(logger: &str, above: &str) -> bool {
    logger.strip_prefix(above).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
}

#[cfg(test)]
mod tests {
    use super::*;
    use LogSeverity::*;

    #[test]
    fn a_logger_has_its_own_level_or_that_of_the_nearest_above() {
        let levels = Levels::new();
        assert!(levels.enabled("a", Info) && !levels.enabled("a", Debug));
        levels.set("robot", Error);
        levels.set("robot.camera", Debug);
        for (logger, level) in [
            ("robot", Error),
            ("robot.arm", Error),
            ("robot.camera", Debug),
            ("robot.camera.driver", Debug),
            ("robot2", Info),
            ("robot.cameras", Error),
        ] {
            for severity in [Debug, Info, Warn, Error, Fatal] {
                assert_eq!(levels.enabled(logger, severity), severity >= level, "{logger} {severity:?}");
            }
        }
        levels.set("robot.camera", Unset);
        assert!(!levels.enabled("robot.camera.driver", Warn));
        levels.set_all(Fatal);
        assert!(!levels.enabled("a", Error) && levels.enabled("robot.camera", Error));
    }

    #[test]
    fn no_more_loggers_have_levels_than_may() {
        let levels = Levels::new();
        assert!(levels.set_one_of(2, "a", Debug) && levels.set_one_of(2, "b", Debug));
        assert!(!levels.set_one_of(2, "c", Debug) && levels.set_one_of(2, "b", Error));
        assert_eq!(["a", "b", "c"].map(|logger| levels.own(logger)), [Debug, Error, Unset]);
    }

    #[test]
    fn names_are_read_as_ros_reads_them() {
        assert_eq!("debug".parse(), Ok(Debug));
        assert_eq!("WARN".parse(), Ok(Warn));
        assert_eq!("warning".parse::<LogSeverity>(), Err(()));
    }
}
