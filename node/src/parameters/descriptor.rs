// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is said about a parameter besides its value.

use super::{ParameterError, ParameterValue};
use std::fmt;
use std::ops::RangeInclusive;

/// What a parameter is for and what it may be.
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
    /// What the parameter is for.
    pub description: String,
    /// Constraints that only a callback checks, for people to read.
    pub additional_constraints: String,
    /// Whether it keeps the value that it was declared with.
    pub read_only: bool,
    /// Whether it may change its type.
    pub dynamic_typing: bool,
    /// What a number, or each number of an array, may be.
    pub range: Option<ParameterRange>,
}

/// The numbers that a parameter may have.
#[derive(Debug, Clone, Copy, PartialEq)]
#[allow(missing_docs, reason = "a range has ends and a step")]
pub enum ParameterRange {
    /// Those from `from` to `to`, `step` apart unless it is zero.
    Integer { from: i64, to: i64, step: u64 },
    /// Those from `from` to `to`, `step` apart unless it is zero.
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
    /// Nothing said: any value of the parameter's type.
    pub fn new() -> ParameterDescriptor {
        ParameterDescriptor::default()
    }

    /// Says what the parameter is for.
    pub fn description(mut self, description: impl Into<String>) -> ParameterDescriptor {
        self.description = description.into();
        self
    }

    /// Says what a callback checks.
    pub fn additional_constraints(mut self, constraints: impl Into<String>) -> ParameterDescriptor {
        self.additional_constraints = constraints.into();
        self
    }

    /// The parameter keeps the value that it is declared with.
    pub fn read_only(mut self) -> ParameterDescriptor {
        self.read_only = true;
        self
    }

    /// The parameter may change its type. A reader of one type keeps the last value of that type.
    pub fn dynamic_typing(mut self) -> ParameterDescriptor {
        self.dynamic_typing = true;
        self
    }

    /// What the number may be: `0..=10` for an integer, `0.0..=1.0` for a double. Of an array: each of its numbers.
    pub fn range(mut self, range: impl Into<ParameterRange>) -> ParameterDescriptor {
        self.range = Some(range.into());
        self
    }

    /// The numbers of the range are this far apart, counted from its start; its end is always one of them. Without a range
    /// it says nothing.
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

    /// As rclcpp, which takes a number for one of the steps if it is within 100 epsilon.
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
