// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which topics are mirrored: `--allow` and `--deny`.

use zenoh::key_expr::keyexpr;

/// Patterns of topic names: `*` stands for what is between two slashes, `**` for any number of such parts.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Filter {
    allow: Vec<String>,
    deny: Vec<String>,
}

/// A pattern that cannot be one.
#[derive(Debug, thiserror::Error)]
#[error("'{pattern}' is no pattern of topic names: {reason}; write like /camera/** or /*/odom")]
pub struct PatternError {
    /// The pattern.
    pub pattern: String,
    /// Why not.
    pub reason: String,
}

impl Filter {
    /// Without `allow` every topic is allowed; what matches `deny` is not.
    ///
    /// # Errors
    /// [`PatternError`].
    pub fn new(allow: &[String], deny: &[String]) -> Result<Self, PatternError> {
        let all =
            |patterns: &[String]| patterns.iter().map(|pattern| parse(pattern)).collect::<Result<_, _>>();
        Ok(Filter { allow: all(allow)?, deny: all(deny)? })
    }

    /// Whether `topic`, a fully qualified name, is mirrored.
    pub fn allows(&self, topic: &str) -> bool {
        let Ok(topic) = keyexpr::new(topic.trim_start_matches('/')) else { return false };
        let matches = |pattern: &String| keyexpr::new(pattern.as_str()).is_ok_and(|p| p.intersects(topic));
        (self.allow.is_empty() || self.allow.iter().any(matches)) && !self.deny.iter().any(matches)
    }
}

fn parse(pattern: &str) -> Result<String, PatternError> {
    let refuse = |reason: String| PatternError { pattern: pattern.into(), reason };
    let rest = pattern.strip_prefix('/').ok_or_else(|| refuse("it does not begin with '/'".into()))?;
    keyexpr::new(rest).map_err(|error| refuse(error.to_string()))?;
    Ok(rest.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn filter(allow: &[&str], deny: &[&str]) -> Filter {
        let strings = |patterns: &[&str]| patterns.iter().map(|&p| p.into()).collect::<Vec<String>>();
        Filter::new(&strings(allow), &strings(deny)).unwrap()
    }

    #[test]
    fn allowed_and_denied() {
        assert!(Filter::default().allows("/a/b"));
        let filter = filter(&["/camera/**", "/*/odom"], &["/camera/raw"]);
        let allowed = ["/camera", "/camera/rgb/image", "/base/odom"];
        let denied = ["/camera/raw", "/odom", "/a/b/odom", "/cameras", "/", ""];
        assert!(allowed.iter().all(|topic| filter.allows(topic)));
        assert!(!denied.iter().any(|topic| filter.allows(topic)));
    }

    #[test]
    fn patterns_that_are_none() {
        for pattern in ["", "camera", "/", "/a//b", "/a/", "/a#"] {
            let error = Filter::new(&[pattern.into()], &[]).unwrap_err();
            assert!(error.to_string().contains(&format!("'{pattern}'")), "{error}");
        }
    }
}
