// SPDX-License-Identifier: MIT OR Apache-2.0
//! The macros that log.

/// Behind the other log macros.
#[doc(hidden)]
#[macro_export]
macro_rules! __log {
    ($severity:expr, $logger:expr, $($text:tt)+) => {{
        static SITE: $crate::__private::Site = $crate::__private::Site::new(file!(), line!());
        match &$logger {
            target => {
                if SITE.permits($severity, target) {
                    SITE.log($severity, target, format_args!($($text)+));
                }
            }
        }
    }};
}

/// Logs a line at debug level: `log_debug!(node.logger(), "x is {x}")`. The arguments are only evaluated if the line is
/// logged.
#[macro_export]
macro_rules! log_debug {
    ($logger:expr, $($text:tt)+) => { $crate::__log!($crate::LogSeverity::Debug, $logger, $($text)+) };
}

/// Logs a line at info level: see [`log_debug!`].
#[macro_export]
macro_rules! log_info {
    ($logger:expr, $($text:tt)+) => { $crate::__log!($crate::LogSeverity::Info, $logger, $($text)+) };
}

/// Logs a line at warn level: see [`log_debug!`].
#[macro_export]
macro_rules! log_warn {
    ($logger:expr, $($text:tt)+) => { $crate::__log!($crate::LogSeverity::Warn, $logger, $($text)+) };
}

/// Logs a line at error level: see [`log_debug!`].
#[macro_export]
macro_rules! log_error {
    ($logger:expr, $($text:tt)+) => { $crate::__log!($crate::LogSeverity::Error, $logger, $($text)+) };
}

/// Logs a line at fatal level: see [`log_debug!`].
#[macro_export]
macro_rules! log_fatal {
    ($logger:expr, $($text:tt)+) => { $crate::__log!($crate::LogSeverity::Fatal, $logger, $($text)+) };
}
