// SPDX-License-Identifier: MIT OR Apache-2.0
//! The description of a parameter.

use crate::values::{ParameterError, ParameterValue};
use std::fmt;
use std::ops::RangeInclusive;

/// The purpose of a parameter and its allowed values.
///
/// ```
/// use tautline::ParameterDescriptor;
///
/// let gain = ParameterDescriptor::new().description("of the heading controller").range(0.0..=10.0).step(0.5);
/// let frame = ParameterDescriptor::new().read_only();
/// ```
#[derive(Debug, Clone, Default, PartialEq)]
#[must_use = "give it to Node::declare_parameter_with"]
pub struct ParameterDescriptor {
    /// The purpose of the parameter.
    pub description: String,
    /// Constraints that only a callback checks, as text for the user.
    pub additional_constraints: String,
    /// Whether it keeps its initial value.
    pub read_only: bool,
    /// Whether its type may change.
    pub dynamic_typing: bool,
    /// The range of a number, or of each number of an array.
    pub range: Option<ParameterRange>,
}

/// The range of a parameter's numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
#[allow(missing_docs, reason = "a range has ends and a step")]
pub enum ParameterRange {
    /// From `from` to `to`, in steps of `step` unless it is zero.
    Integer { from: i64, to: i64, step: u64 },
    /// From `from` to `to`, in steps of `step` unless it is zero.
    Double { from: f64, to: f64, step: f64 },
}

impl From<RangeInclusive<i64>> for ParameterRange {
    fn from(range: RangeInclusive<i64>) -> ParameterRange {
        ParameterRange::Integer { from: *range.start(), to: *range.end(), step: 0 }
    }
}

impl From<RangeInclusive<f64>> for ParameterRange {
    fn from(range: RangeInclusive<f64>) -> ParameterRange {
        ParameterRange::Double { from: *range.start(), to: *range.end(), step: 0.0 }
    }
}

impl ParameterDescriptor {
    /// An empty description: allows any value of the parameter's type.
    pub fn new() -> ParameterDescriptor {
        ParameterDescriptor::default()
    }

    /// Sets the purpose of the parameter.
    pub fn description(self, description: impl Into<String>) -> ParameterDescriptor {
        ParameterDescriptor { description: description.into(), ..self }
    }

    /// Describes the constraints that a callback checks.
    pub fn additional_constraints(self, constraints: impl Into<String>) -> ParameterDescriptor {
        ParameterDescriptor { additional_constraints: constraints.into(), ..self }
    }

    /// The parameter keeps its initial value.
    pub fn read_only(self) -> ParameterDescriptor {
        ParameterDescriptor { read_only: true, ..self }
    }

    /// The parameter's type may change. A reader of one type keeps the last value of that type.
    pub fn dynamic_typing(self) -> ParameterDescriptor {
        ParameterDescriptor { dynamic_typing: true, ..self }
    }

    /// The range of the number: `0..=10` for an integer, `0.0..=1.0` for a double. For an array it applies to each
    /// number.
    pub fn range(self, range: impl Into<ParameterRange>) -> ParameterDescriptor {
        ParameterDescriptor { range: Some(range.into()), ..self }
    }

    /// Sets the distance between the numbers of the range, counted from its start; its end is always allowed. Without a
    /// range it has no effect.
    pub fn step(mut self, wanted: impl Into<f64>) -> ParameterDescriptor {
        let wanted = wanted.into();
        match &mut self.range {
            Some(ParameterRange::Integer { step, .. }) => *step = wanted as u64,
            Some(ParameterRange::Double { step, .. }) => *step = wanted,
            None => {}
        }
        self
    }

    /// Whether the parameter `name` may be `value`, besides its type.
    pub(crate) fn check(&self, name: &str, value: &ParameterValue) -> Result<(), ParameterError> {
        let Some(range) = self.range else { return Ok(()) };
        let allowed = match value {
            ParameterValue::Integer(value) => range.has_integer(*value),
            ParameterValue::IntegerArray(values) => values.iter().all(|value| range.has_integer(*value)),
            ParameterValue::Double(value) => range.has_double(*value),
            ParameterValue::DoubleArray(values) => values.iter().all(|value| range.has_double(*value)),
            _ => true,
        };
        if allowed {
            return Ok(());
        }
        Err(ParameterError::OutOfRange {
            name: name.to_owned(),
            value: value.clone(),
            range: range.to_string(),
        })
    }
}

impl ParameterRange {
    fn has_integer(self, value: i64) -> bool {
        match self {
            ParameterRange::Double { .. } => true,
            ParameterRange::Integer { from, to, step } => {
                let in_step = || step == 0 || value == to || value.abs_diff(from).is_multiple_of(step);
                (from..=to).contains(&value) && in_step()
            }
        }
    }

    /// Whether the range has this number: as in rclcpp, a number within 100 epsilon of a step is on the step.
    fn has_double(self, value: f64) -> bool {
        match self {
            ParameterRange::Integer { .. } => true,
            ParameterRange::Double { from, to, step } => {
                let near = |a: f64, b: f64| (a - b).abs() <= 100.0 * f64::EPSILON * (a + b).abs().max(1.0);
                let in_step = || {
                    step == 0.0
                        || near(value, to)
                        || near(((value - from) / step).round() * step + from, value)
                };
                (near(value, from) || near(value, to) || (from..=to).contains(&value)) && in_step()
            }
        }
    }
}

impl fmt::Display for ParameterRange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ParameterRange::Integer { from, to, step: 0 } => write!(f, "{from}..={to}"),
            ParameterRange::Integer { from, to, step } => write!(f, "{from}..={to} in steps of {step}"),
            ParameterRange::Double { from, to, step } if *step == 0.0 => write!(f, "{from:?}..={to:?}"),
            ParameterRange::Double { from, to, step } => write!(f, "{from:?}..={to:?} in steps of {step:?}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_in_their_range() {
        let tens = ParameterDescriptor::new().range(-10..=25).step(10.0);
        for (value, allowed) in
            [(-10, true), (0, true), (20, true), (25, true), (5, false), (30, false), (-20, false)]
        {
            assert_eq!(tens.check("p", &ParameterValue::Integer(value)).is_ok(), allowed, "{value}");
        }
        let tenths = ParameterDescriptor::new().range(0.0..=1.0).step(0.1);
        for (value, allowed) in
            [(0.3, true), (0.1 + 0.2, true), (0.25, false), (1.0, true), (1.1, false), (f64::NAN, false)]
        {
            assert_eq!(tenths.check("p", &ParameterValue::Double(value)).is_ok(), allowed, "{value}");
        }
        let all = ParameterDescriptor::new().range(i64::MIN..=i64::MAX).step(3.0);
        assert!(all.check("p", &ParameterValue::Integer(i64::MAX)).is_ok());
        let error = tens.check("height", &ParameterValue::IntegerArray(vec![0, 7])).unwrap_err();
        assert_eq!(error.to_string(), "parameter 'height': [0, 7] is not in -10..=25 in steps of 10");
    }
}
