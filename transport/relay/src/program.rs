// SPDX-License-Identifier: MIT OR Apache-2.0
//! The program around a relay: shows statistics until a signal ends it.

use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use signal_hook::iterator::Signals;
use std::fmt;
use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tautline_rt::terminal::{Escaped, escaped};
use tautline_transport::MAX_DOMAIN;

/// A flag that the first SIGINT, SIGTERM or unignored SIGHUP sets. A second one over 200 ms later exits with 128 plus the signal number.
pub fn stop_on_signals() -> Result<Arc<AtomicBool>, SignalError> {
    let stop = Arc::new(AtomicBool::new(false));
    let mut signals = Signals::new(tautline_rt::termination_signals())?;
    let asked = stop.clone();
    std::thread::Builder::new().name("signals".into()).spawn(move || {
        let mut first = None;
        for signal in signals.forever() {
            asked.store(true, Ordering::Relaxed);
            if first.get_or_insert_with(Instant::now).elapsed() > ONE_STOP {
                signal_hook::low_level::exit(128 + signal);
            }
        }
    })?;
    Ok(stop)
}

/// Signal handlers cannot be installed.
#[derive(Debug, thiserror::Error)]
#[error("signal handlers cannot be installed: {0}")]
pub struct SignalError(#[from] io::Error);

/// Signals within this time count as one: a shell may signal a program twice, as a process and as a member of its group.
const ONE_STOP: Duration = Duration::from_millis(200);

/// Reads `stats` at every `interval` until `stop`, and shows them: as a status line from `line` on a terminal, or as lines of JSON.
/// Also returns when the reader of the output has exited. Another error of the output, such as a full disk, is said, and printing goes on.
pub fn show_until<S: Serialize>(
    stop: &AtomicBool,
    interval: Duration,
    is_json: bool,
    stats: impl Fn() -> S,
    line: impl Fn(&S) -> String,
) {
    let bar = Bar::new(is_json);
    let mut next = Instant::now() + interval;
    let mut is_cut_off = false;
    while !stop.load(Ordering::Relaxed) {
        let patience = next.saturating_duration_since(Instant::now()).min(Duration::from_millis(50));
        std::thread::sleep(patience);
        if Instant::now() >= next {
            next += interval;
            if is_json {
                match print(&stats(), is_cut_off) {
                    Ok(()) => is_cut_off = false,
                    Err(error) if error.kind() == io::ErrorKind::BrokenPipe => return,
                    Err(error) => {
                        if !std::mem::replace(&mut is_cut_off, true) {
                            say(format_args!("the statistics cannot be printed, retrying: {error}"));
                        }
                    }
                }
            } else {
                // Names and reasons may come from other hosts.
                bar.0.set_message(escaped(&line(&stats())).replace('\n', " "));
                bar.0.tick();
            }
        }
    }
}

/// Standard error, with control characters escaped, because parts of the text may come from other hosts.
pub fn stderr() -> Escaped<io::StderrLock<'static>> {
    Escaped::new(io::stderr().lock())
}

/// Writes a line to [`stderr`]. Unlike `eprintln!`, it does not panic if standard error is closed or full.
pub fn say(text: fmt::Arguments<'_>) {
    let _ = writeln!(stderr(), "{text}");
}

/// Prints a line. If the last one `is_cut_off`, this one starts after it.
fn print(stats: &impl Serialize, is_cut_off: bool) -> io::Result<()> {
    let text = serde_json::to_string(stats).map_err(io::Error::other)?;
    let start = if is_cut_off { "\n" } else { "" };
    let mut out = Escaped::new(io::stdout().lock());
    // In one piece: standard output would keep the start of a line that cannot be written, and repeat it.
    out.write_all(format!("{start}{text}\n").as_bytes())?;
    out.flush()
}

/// The status line, which is drawn only on a terminal.
struct Bar(ProgressBar);

impl Bar {
    fn new(is_hidden: bool) -> Self {
        let bar = if is_hidden { ProgressBar::hidden() } else { ProgressBar::new_spinner() };
        // The template is valid.
        let style = ProgressStyle::with_template("{wide_msg}");
        bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_spinner()));
        Bar(bar)
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        self.0.finish_and_clear();
    }
}

/// The domain from the first of these environment variables that is set.
///
/// # Errors
/// [`DomainError`]: not a domain.
pub fn domain_of(variables: &[&'static str]) -> Result<Option<u32>, DomainError> {
    for &variable in variables {
        let value = std::env::var_os(variable).unwrap_or_default().to_string_lossy().into_owned();
        if !value.is_empty() {
            let domain = value.parse().ok().filter(|&domain| domain <= MAX_DOMAIN);
            return domain.map(Some).ok_or(DomainError { variable, value });
        }
    }
    Ok(None)
}

/// An environment variable with an invalid domain.
#[derive(Debug, thiserror::Error)]
#[error("{variable}={value} is not a domain: set it to a number from 0 to {MAX_DOMAIN}")]
pub struct DomainError {
    variable: &'static str,
    value: String,
}

/// Parses the seconds between two prints of the statistics.
///
/// # Errors
/// Not a number in range.
pub fn parse_interval(text: &str) -> Result<f64, String> {
    let seconds = text.parse().ok().filter(|seconds| (0.1..=3600.0).contains(seconds));
    seconds.ok_or_else(|| "from 0.1 to 3600 seconds".into())
}

/// A count with its noun: `1 topic`, `2 topics`.
pub fn counted(count: usize, one: &str, many: &str) -> String {
    format!("{count} {}", if count == 1 { one } else { many })
}

/// A rate such as `80.0 kB/s`.
pub(crate) fn rate(bytes_per_s: f64) -> String {
    match bytes_per_s {
        b if b >= 1e6 => format!("{:.1} MB/s", b / 1e6),
        b if b >= 1e3 => format!("{:.1} kB/s", b / 1e3),
        b => format!("{b:.0} B/s"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_read_well() {
        assert_eq!([0.0, 999.0, 80e3, 1.25e6].map(rate), ["0 B/s", "999 B/s", "80.0 kB/s", "1.2 MB/s"]);
        assert_eq!([1, 0, 2].map(|n| counted(n, "link", "links")), ["1 link", "0 links", "2 links"]);
    }

    #[test]
    fn an_interval_is_in_bounds() {
        assert_eq!(parse_interval("0.5"), Ok(0.5));
        assert!(["0", "NaN", "3601", "x"].iter().all(|text| parse_interval(text).is_err()));
    }
}
