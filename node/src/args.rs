// SPDX-License-Identifier: MIT OR Apache-2.0
//! ROS 2's command line: the arguments between `--ros-args` and `--`, or the end
//! (<https://design.ros2.org/articles/ros_command_line_arguments.html>).

use crate::error::{Error, Result};
use crate::logging::LogSeverity;
use crate::remap::RemapRules;
use crate::values::ParameterValue;
use crate::values::yaml::{self, NodeParameters};
use std::path::Path;

/// The settings of a command line for the nodes of a context.
#[derive(Clone, Debug, Default)]
pub(crate) struct Arguments {
    /// The arguments that are the program's own.
    pub(crate) others: Vec<String>,
    pub(crate) remap: RemapRules,
    /// In the order of the command line; of two values the later one counts.
    pub(crate) parameters: NodeParameters,
    /// The level of all loggers, or of the named logger and those below it.
    pub(crate) log_levels: Vec<(Option<String>, LogSeverity)>,
    pub(crate) enclave: Option<String>,
    pub(crate) outputs: Outputs,
}

/// The outputs of log lines, where the command line sets them.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Outputs {
    pub(crate) rosout: Option<bool>,
    pub(crate) console: Option<bool>,
}

impl Arguments {
    /// # Errors
    /// [`Error::Argument`] with the argument that is not understood; [`Error::Parameter`] for a parameter file.
    pub(crate) fn parse(arguments: impl IntoIterator<Item = String>) -> Result<Arguments> {
        let mut parsed = Arguments::default();
        let mut rules = Vec::new();
        let mut arguments = arguments.into_iter();
        let mut for_ros = false;
        while let Some(argument) = arguments.next() {
            match argument.as_str() {
                "--ros-args" => for_ros = true,
                "--" if for_ros => for_ros = false,
                _ if for_ros => parsed.one(&argument, &mut arguments, &mut rules)?,
                _ => parsed.others.push(argument),
            }
        }
        parsed.remap = RemapRules::parse(&rules)?;
        Ok(parsed)
    }

    fn one(
        &mut self,
        argument: &str,
        rest: &mut impl Iterator<Item = String>,
        rules: &mut Vec<String>,
    ) -> Result<()> {
        let mut value = |expected: &str| {
            rest.next()
                .filter(|value| !matches!(value.as_str(), "--" | "--ros-args"))
                .ok_or_else(|| refuse(argument, format!("{expected} is missing after it")))
        };
        match argument {
            "-r" | "--remap" => rules.push(value("FROM:=TO")?),
            "-p" | "--param" => {
                let rule = value("NAME:=VALUE")?;
                self.parameters
                    .push(parameter(&rule).map_err(|reason| refuse(&format!("{argument} {rule}"), reason))?);
            }
            "--params-file" => {
                self.parameters.extend(yaml::read_parameter_file(Path::new(&value("a file")?))?);
            }
            "--log-level" => {
                let rule = value("LEVEL or LOGGER:=LEVEL")?;
                let (logger, level) = match rule.split_once(":=") {
                    Some((logger, level)) => (Some(logger.to_owned()), level),
                    None => (None, rule.as_str()),
                };
                let expected = "a level is debug, info, warn, error or fatal";
                let parsed = level.parse().map_err(|()| refuse(&format!("{argument} {rule}"), expected));
                self.log_levels.push((logger, parsed?));
            }
            "-e" | "--enclave" => self.enclave = Some(value("a path")?),
            "--enable-rosout-logs" => self.outputs.rosout = Some(true),
            "--disable-rosout-logs" => self.outputs.rosout = Some(false),
            "--enable-stdout-logs" => self.outputs.console = Some(true),
            "--disable-stdout-logs" => self.outputs.console = Some(false),
            // Accepted without effect: there is no external logging library.
            "--disable-external-lib-logs" => {}
            _ => {
                let known = "it is none of -r, -p, --params-file, --log-level, -e, --[en|dis]able-rosout-logs, \
                             --[en|dis]able-stdout-logs; arguments of the program stand before --ros-args or after --";
                return Err(refuse(argument, known));
            }
        }
        Ok(())
    }
}

fn refuse(argument: &str, reason: impl Into<String>) -> Error {
    Error::Argument { argument: argument.to_owned(), reason: reason.into() }
}

/// `name:=value` or `node:name:=value`.
fn parameter(rule: &str) -> Result<NodeParameter, String> {
    let (name, value) = rule.split_once(":=").ok_or("there is no ':=' between a name and a value")?;
    let (node, name) = name.split_once(':').unwrap_or(("/**", name));
    if node.is_empty() || name.is_empty() {
        return Err("a name is missing before ':='".into());
    }
    Ok((node.to_owned(), vec![(name.to_owned(), yaml::read_value(value)?)]))
}

type NodeParameter = (String, Vec<(String, ParameterValue)>);

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(line: &str) -> Result<Arguments> {
        Arguments::parse(line.split_whitespace().map(str::to_owned))
    }

    #[test]
    fn a_command_line_is_taken_apart() {
        let line = "prog -x --ros-args -p gain:=1.5 --remap a:=b -p cam:rate:=30 -e /front -- -p y \
                    --ros-args --log-level warn --log-level cam.driver:=DEBUG --disable-rosout-logs";
        let parsed = parse(line).unwrap();
        assert_eq!(parsed.others, ["prog", "-x", "-p", "y"]);
        assert_eq!(
            parsed.parameters,
            [
                ("/**".to_owned(), vec![("gain".to_owned(), ParameterValue::Double(1.5))]),
                ("cam".to_owned(), vec![("rate".to_owned(), ParameterValue::Integer(30))]),
            ]
        );
        assert_eq!(parsed.remap, RemapRules::parse(&["a:=b"]).unwrap());
        assert_eq!(
            parsed.log_levels,
            [(None, LogSeverity::Warn), (Some("cam.driver".to_owned()), LogSeverity::Debug)]
        );
        assert_eq!(parsed.enclave.as_deref(), Some("/front"));
        assert_eq!((parsed.outputs.rosout, parsed.outputs.console), (Some(false), None));
        assert!(parse("prog -p --params-file").unwrap().parameters.is_empty());
    }

    #[test]
    fn a_bad_argument_is_named() {
        for (line, expected) in [
            ("--ros-args -p", "'-p' is not understood: NAME:=VALUE is missing after it"),
            ("--ros-args -p -- x", "NAME:=VALUE is missing"),
            ("--ros-args -p gain=1", "'-p gain=1' is not understood: there is no ':='"),
            ("--ros-args -p gain:=", "'-p gain:=' is not understood: there is no value"),
            ("--ros-args -p a:=[1,x]", "here are integer and string (x)"),
            ("--ros-args -p :=1", "a name is missing"),
            ("--ros-args --log-level loud", "'--log-level loud' is not understood: a level is debug"),
            ("--ros-args -r x", "'x'"),
            ("--ros-args --speed 1", "'--speed' is not understood: it is none of -r"),
            ("--ros-args --params-file /nowhere/p.yaml", "parameter file /nowhere/p.yaml: No such file"),
        ] {
            let error = parse(line).unwrap_err().to_string();
            assert!(error.contains(expected), "{line}: {error}");
        }
    }
}
