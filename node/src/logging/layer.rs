// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writes the events of `tracing` macros as lines of the log.

use super::line::{Line, floor_char_boundary};
use super::output;
use super::severity::{LEVELS, LogSeverity};
use std::fmt;
use tautline_rt::clock::wall_ns;
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Metadata, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::layer::Context;

/// A layer that logs the events of `tracing`: the target `a::b` becomes the logger `a.b`, with that logger's level; fields
/// follow the message. Spans are not shown.
///
/// ```
/// use tautline::logging::TracingLayer;
/// use tracing_subscriber::layer::SubscriberExt;
///
/// let subscriber = tracing_subscriber::registry().with(TracingLayer::new());
/// tracing::subscriber::with_default(subscriber, || tracing::warn!(speed = 2.5, "too fast"));
/// ```
#[derive(Clone, Debug, Default)]
pub struct TracingLayer(());

impl TracingLayer {
    /// # Real-time
    /// Setup only: starts the thread that writes the log lines of real-time threads.
    pub fn new() -> TracingLayer {
        output::start();
        TracingLayer(())
    }
}

/// Maximum length of a compared target: a longer one is truncated, and has the level of the loggers above it.
const TARGET_BYTES: usize = 128;

/// A target with `.` for `::`, without allocating.
struct Logger {
    bytes: [u8; TARGET_BYTES],
    used: usize,
}

impl Logger {
    fn new(target: &str) -> Logger {
        let mut logger = Logger { bytes: [0; TARGET_BYTES], used: 0 };
        for part in target.split("::").flat_map(|part| [".", part]).skip(1) {
            let len = floor_char_boundary(part, TARGET_BYTES - logger.used);
            logger.bytes[logger.used..logger.used + len].copy_from_slice(&part.as_bytes()[..len]);
            logger.used += len;
        }
        logger
    }

    fn name(&self) -> &str {
        str::from_utf8(&self.bytes[..self.used]).unwrap_or_default()
    }
}

fn severity(metadata: &Metadata<'_>) -> LogSeverity {
    match *metadata.level() {
        Level::ERROR => LogSeverity::Error,
        Level::WARN => LogSeverity::Warn,
        Level::INFO => LogSeverity::Info,
        _ => LogSeverity::Debug,
    }
}

impl<S: Subscriber> Layer<S> for TracingLayer {
    fn on_event(&self, event: &Event<'_>, _context: Context<'_, S>) {
        let metadata = event.metadata();
        let (logger, severity) = (Logger::new(metadata.target()), severity(metadata));
        if !LEVELS.enabled(logger.name(), severity) {
            return;
        }
        let (file, line) = (metadata.file().unwrap_or_default(), metadata.line().unwrap_or_default());
        let line = Line { time_ns: wall_ns(), severity, logger: logger.name(), text: "", file, line };
        output::log(line, format_args!("{}", Text(event)));
    }
}

/// An event's message and its fields.
struct Text<'e>(&'e Event<'e>);

impl fmt::Display for Text<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        struct Message<'w, 'f>(&'w mut fmt::Formatter<'f>);
        impl Visit for Message<'_, '_> {
            fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
                if field.name() == "message" {
                    let _ = write!(self.0, "{value:?}");
                }
            }
        }
        struct Others<'w, 'f>(&'w mut fmt::Formatter<'f>);
        impl Visit for Others<'_, '_> {
            fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
                if field.name() != "message" {
                    let _ = write!(self.0, " {}={value:?}", field.name());
                }
            }
        }
        self.0.record(&mut Message(f));
        self.0.record(&mut Others(f));
        f.write_str("")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn targets_are_loggers() {
        assert_eq!(
            Logger::new("tautline_transport::doorbell::hot").name(),
            "tautline_transport.doorbell.hot"
        );
        assert_eq!(Logger::new("ä::".repeat(100).as_str()).name().len(), TARGET_BYTES);
    }
}
