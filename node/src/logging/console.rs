// SPDX-License-Identifier: MIT OR Apache-2.0
//! Lines as ROS 2 prints them: `[INFO] [sec.nanosec] [logger]: text`.
//!
//! Environment variables change the format, as in ROS 2: `RCUTILS_CONSOLE_OUTPUT_FORMAT` has `{severity}`, `{time}`,
//! `{time_as_nanoseconds}`, `{name}`, `{message}`, `{file_name}` and `{line_number}`; `RCUTILS_COLORIZED_OUTPUT` is 0 or 1;
//! with `RCUTILS_LOGGING_USE_STDOUT=1` lines go to standard output.

use super::line::Line;
use super::severity::LogSeverity;
use std::io::{IsTerminal, Write};
use std::sync::OnceLock;

const DEFAULT_FORMAT: &str = "[{severity}] [{time}] [{name}]: {message}";

struct Settings {
    format: String,
    coloured: bool,
    stdout: bool,
}

fn settings() -> &'static Settings {
    static SETTINGS: OnceLock<Settings> = OnceLock::new();
    SETTINGS.get_or_init(|| {
        let variable = |name: &str| std::env::var(name).ok().filter(|value| !value.is_empty());
        let stdout = variable("RCUTILS_LOGGING_USE_STDOUT").as_deref() == Some("1");
        let terminal =
            || if stdout { std::io::stdout().is_terminal() } else { std::io::stderr().is_terminal() };
        Settings {
            format: variable("RCUTILS_CONSOLE_OUTPUT_FORMAT").unwrap_or_else(|| DEFAULT_FORMAT.into()),
            coloured: match variable("RCUTILS_COLORIZED_OUTPUT").as_deref() {
                Some("0") => false,
                Some("1") => true,
                _ => terminal(),
            },
            stdout,
        }
    })
}

/// Writes a line. Errors are ignored: a closed console is no reason to stop.
pub(super) fn write(line: &Line<'_>) {
    let Settings { format, coloured, stdout } = settings();
    let text = render(line, format, *coloured);
    let _ = if *stdout {
        std::io::stdout().lock().write_all(text.as_bytes())
    } else {
        std::io::stderr().lock().write_all(text.as_bytes())
    };
}

fn render(line: &Line<'_>, format: &str, coloured: bool) -> String {
    let colour = match line.severity {
        _ if !coloured => "",
        LogSeverity::Debug => "\x1b[32m",
        LogSeverity::Warn => "\x1b[33m",
        LogSeverity::Error | LogSeverity::Fatal => "\x1b[31m",
        LogSeverity::Info | LogSeverity::Unset => "",
    };
    let mut text = colour.to_owned();
    let mut rest = format;
    while let Some(start) = rest.find('{') {
        text.push_str(&rest[..start]);
        rest = &rest[start..];
        let end = rest.find('}').map_or(rest.len(), |end| end + 1);
        let (token, after) = rest.split_at(end);
        match token {
            "{severity}" => text.push_str(line.severity.name()),
            "{time}" => {
                let (sec, nanosec) =
                    (line.time_ns.div_euclid(1_000_000_000), line.time_ns.rem_euclid(1_000_000_000));
                text.push_str(&format!("{sec:010}.{nanosec:09}"));
            }
            "{time_as_nanoseconds}" => text.push_str(&format!("{:019}", line.time_ns)),
            "{name}" => text.push_str(line.logger),
            "{message}" => text.push_str(line.text),
            "{file_name}" => text.push_str(line.file),
            "{line_number}" => text.push_str(&line.line.to_string()),
            // Not available in Rust.
            "{function_name}" => {}
            other => text.push_str(other),
        }
        rest = after;
    }
    text.push_str(rest);
    if !colour.is_empty() {
        text.push_str("\x1b[0m");
    }
    text.push('\n');
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_look_as_those_of_ros() {
        let line = Line {
            time_ns: 1_700_000_000_000_000_042,
            severity: LogSeverity::Warn,
            logger: "robot.arm",
            text: "too {fast}",
            file: "arm.rs",
            line: 7,
        };
        assert_eq!(
            render(&line, DEFAULT_FORMAT, false),
            "[WARN] [1700000000.000000042] [robot.arm]: too {fast}\n"
        );
        assert_eq!(
            render(&line, "{name}: {message} ({file_name}:{line_number}) {x} {", true),
            "\x1b[33mrobot.arm: too {fast} (arm.rs:7) {x} {\x1b[0m\n"
        );
        let info = Line { severity: LogSeverity::Info, ..line };
        assert_eq!(render(&info, "{severity}", true), "INFO\n");
    }
}
