// SPDX-License-Identifier: MIT OR Apache-2.0
//! Patterns of topic names: `*` matches one part between slashes, `**` any number of parts.

use std::fmt;
use std::str::FromStr;

/// A fully qualified name that may contain `*` and `**`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pattern(String);

/// An invalid pattern.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("'{pattern}' is not a pattern of topic names: {reason}; write like /chatter, /camera/** or /*/odom")]
pub struct PatternError {
    /// The text that was parsed.
    pub pattern: String,
    /// The reason.
    pub reason: &'static str,
}

impl Pattern {
    /// Whether `name`, a fully qualified name, matches.
    pub fn matches(&self, name: &str) -> bool {
        fn parts(text: &str) -> Vec<&str> {
            text.split('/').skip(1).collect()
        }
        let (pattern, name) = (parts(&self.0), parts(name));
        // For each part of the name: whether the pattern so far can end there.
        let mut ends = vec![false; name.len() + 1];
        ends[0] = true;
        for part in pattern {
            if part == "**" {
                let first = ends.iter().position(|end| *end).unwrap_or(ends.len());
                ends.iter_mut().skip(first).for_each(|end| *end = true);
            } else {
                for at in (0..name.len()).rev() {
                    ends[at + 1] = ends[at] && (part == "*" && !name[at].is_empty() || part == name[at]);
                }
                ends[0] = false;
            }
        }
        ends[name.len()]
    }

    /// The name, if there is no wildcard.
    pub fn exact(&self) -> Option<&str> {
        (!self.0.contains('*')).then_some(&*self.0)
    }

    /// The part before a final `/**`, such as `/a/b` for `/a/b/**`, if it has no wildcard.
    pub fn prefix(&self) -> Option<&str> {
        self.0.strip_suffix("/**").filter(|prefix| !prefix.contains('*'))
    }
}

impl FromStr for Pattern {
    type Err = PatternError;

    fn from_str(text: &str) -> Result<Self, PatternError> {
        let refuse = |reason| Err(PatternError { pattern: text.to_owned(), reason });
        let Some(rest) = text.strip_prefix('/') else { return refuse("it does not begin with '/'") };
        for part in rest.split('/') {
            // Characters of topic names, without those with a meaning in patterns or Zenoh's key expressions.
            let is_plain = |c: char| !c.is_control() && !c.is_whitespace() && !":*$?#".contains(c);
            let is_word = part.chars().all(is_plain);
            if part.is_empty() {
                return refuse("a part of it is empty");
            }
            if !matches!(part, "*" | "**") && !is_word {
                return refuse("a part must be '*', '**', or a word without ' ', ':', '*', '$', '?' and '#'");
            }
        }
        Ok(Pattern(text.to_owned()))
    }
}

impl fmt::Display for Pattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// Selects names.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Filter {
    /// If not empty, only names that match one of these are selected.
    pub allow: Vec<Pattern>,
    /// Names that match one of these are never selected.
    pub deny: Vec<Pattern>,
}

impl Filter {
    /// Parses patterns.
    ///
    /// # Errors
    /// The first invalid pattern.
    pub fn new(allow: &[String], deny: &[String]) -> Result<Self, PatternError> {
        let all = |texts: &[String]| texts.iter().map(|text| text.parse()).collect::<Result<_, _>>();
        Ok(Filter { allow: all(allow)?, deny: all(deny)? })
    }

    /// Whether `name`, a fully qualified name, is denied.
    pub fn denies(&self, name: &str) -> bool {
        self.deny.iter().any(|pattern| pattern.matches(name))
    }

    /// Whether `name`, a fully qualified name, is selected.
    pub fn allows(&self, name: &str) -> bool {
        let is_allowed = || self.allow.is_empty() || self.allow.iter().any(|pattern| pattern.matches(name));
        !self.denies(name) && is_allowed()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_matches() {
        let matching = [
            ("/a", "/a"),
            ("/**", "/a/b/c"),
            ("/a/**", "/a"),
            ("/a/**", "/a/b"),
            ("/*/odom", "/base/odom"),
            ("/**/x", "/x"),
            ("/**/b/*", "/a/b/b/c"),
            ("/robot-1/*", "/robot-1/odom"),
        ];
        let others =
            [("/a", "/b"), ("/a", "/a/b"), ("/a/**", "/ab"), ("/*/odom", "/odom"), ("/*/odom", "/a/b/odom")];
        let matches = |pattern: &str, name| pattern.parse::<Pattern>().unwrap().matches(name);
        assert!(matching.into_iter().all(|(pattern, name)| matches(pattern, name)));
        assert!(!others.into_iter().any(|(pattern, name)| matches(pattern, name)));
    }

    #[test]
    fn what_is_no_pattern() {
        for text in ["", "a", "/", "/a//b", "/a/", "/a b", "/a*", "/a$*", "/a#"] {
            let error = text.parse::<Pattern>().unwrap_err().to_string();
            assert!(error.contains(&format!("'{text}'")), "{error}");
        }
    }

    #[test]
    fn allowed_and_denied() {
        assert!(Filter::default().allows("/a/b"));
        let texts = |texts: &[&str]| texts.iter().map(|&text| text.into()).collect::<Vec<String>>();
        let filter = Filter::new(&texts(&["/camera/**", "/*/odom"]), &texts(&["/camera/raw"])).unwrap();
        let allowed = ["/camera", "/camera/rgb/image", "/base/odom"];
        let others = ["/camera/raw", "/odom", "/a/b/odom", "/cameras", "/", ""];
        assert!(allowed.iter().all(|name| filter.allows(name)));
        assert!(!others.iter().any(|name| filter.allows(name)));
    }
}
