// SPDX-License-Identifier: MIT OR Apache-2.0
//! Parses the user's incomplete command line.

use clap::{Arg, Command};
use std::ffi::OsString;
use tautline::Context;

/// The words after the verb, without the word to complete.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Line {
    /// Words without a dash.
    pub words: Vec<String>,
    /// The number of such words before the word to complete.
    pub place: usize,
    /// Whether the word to complete may be one without a dash.
    pub takes_word: bool,
    /// The values of options, by the options' identifiers.
    options: Vec<(String, String)>,
}

impl Line {
    /// Parses the words of a command; `index` is the index of the word to complete.
    pub fn of(command: &Command, words: &[OsString], index: usize) -> Self {
        let mut line = Line::default();
        let (mut verb, mut is_escaped) = (command, false);
        let mut words = words.iter().map(|word| word.to_string_lossy().into_owned()).enumerate().skip(1);
        while let Some((place, word)) = words.next() {
            let mut value_of = |option: &Arg, value: Option<&str>| {
                let value = match value {
                    Some(value) => Some(value.to_owned()),
                    None => words.next().filter(|(place, _)| *place != index).map(|(_, value)| value),
                };
                value.map(|value| (option.get_id().to_string(), value))
            };
            if place == index {
                line.place = line.words.len();
                line.takes_word = verb.has_subcommands() || takes_word(verb, line.place);
            } else if is_escaped {
                line.words.push(word);
            } else if word == "--" {
                is_escaped = true;
            } else if let Some(option) = word.strip_prefix("--") {
                let (name, value) =
                    option.split_once('=').map_or((option, None), |(name, value)| (name, Some(value)));
                let option = option_of(verb, |option| {
                    option.get_long_and_visible_aliases().is_some_and(|names| names.contains(&name))
                });
                line.options.extend(option.and_then(|option| value_of(option, value)));
            } else if word.len() > 1
                && word.starts_with('-')
                && !word[1..].starts_with(|c: char| c.is_ascii_digit())
            {
                // Several flags; the value of the last one may be the next word.
                let found = word.char_indices().skip(1).find_map(|(at, letter)| {
                    let option = option_of(verb, |option| option.get_short() == Some(letter))?;
                    Some((option, &word[at + letter.len_utf8()..]))
                });
                if let Some((option, rest)) = found {
                    let value = rest.strip_prefix('=').unwrap_or(rest);
                    line.options.extend(value_of(option, Some(value).filter(|value| !value.is_empty())));
                }
            } else if let Some(next) = verb.find_subcommand(&word).filter(|_| line.words.is_empty()) {
                verb = next;
            } else {
                line.words.push(word);
            }
        }
        line
    }

    /// The last value of an option.
    pub fn option(&self, id: &str) -> Option<&str> {
        self.options(id).last()
    }

    /// All values of an option.
    pub fn options(&self, id: &str) -> impl Iterator<Item = &str> {
        self.options.iter().filter(move |(option, _)| option == id).map(|(_, value)| value.as_str())
    }

    pub fn domain(&self) -> Option<u32> {
        match self.option("domain") {
            Some(domain) => domain.parse().ok(),
            None => Context::domain_of_environment().ok(),
        }
    }
}

/// An option with a value.
fn option_of(verb: &Command, is_it: impl Fn(&Arg) -> bool) -> Option<&Arg> {
    let takes_value = |option: &Arg| option.get_num_args().is_some_and(|values| values.takes_values());
    verb.get_arguments().find(|option| takes_value(option) && is_it(option))
}

fn takes_word(verb: &Command, place: usize) -> bool {
    let most = |argument: &Arg| argument.get_num_args().map_or(1, |values| values.max_values());
    verb.get_positionals().map(most).fold(0, usize::saturating_add) > place
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    fn line(text: &str) -> Line {
        let mut command = crate::Cli::command();
        command.build();
        let words: Vec<OsString> = text.split(' ').map(OsString::from).collect();
        let index = words.iter().position(|word| word == "?").unwrap();
        Line::of(&command, &words, index)
    }

    #[test]
    fn words_and_options_are_told_apart() {
        let line_of = |text| {
            let Line { words, place, takes_word, options } = line(text);
            let options: Vec<_> = options.into_iter().map(|(id, value)| format!("{id}={value}")).collect();
            (words.join(" "), place, takes_word, options.join(" "))
        };
        for (text, words, place, takes_word, options) in [
            ("taut ?", "", 0, true, ""),
            ("taut topic ?", "", 0, true, ""),
            ("taut topic list ?", "", 0, false, ""),
            ("taut topic --domain 7 echo ?", "", 0, true, "domain=7"),
            ("taut topic echo ? --domain=7 --once", "", 0, true, "domain=7"),
            ("taut topic echo /a ?", "/a", 1, false, ""),
            ("taut topic echo --field ? /a", "/a", 0, false, ""),
            ("taut topic echo --field x.y -n 3 /a ?", "/a", 1, false, "field=x.y count=3"),
            ("taut topic pub /a -w3 -r=5 ?", "/a", 1, true, "wait=3 rate=5"),
            ("taut topic pub /a -r 5 T ?", "/a T", 2, true, "rate=5"),
            ("taut topic pub /a T {} ?", "/a T {}", 3, false, ""),
            ("taut param set /n gain ?", "/n gain", 2, true, ""),
            ("taut param set /n gain -4 ?", "/n gain -4", 3, false, ""),
            ("taut param describe /n a b ?", "/n a b", 3, true, ""),
            ("taut topic echo -- ? --domain", "--domain", 0, true, ""),
            ("taut topic info list ?", "list", 1, false, ""),
            ("taut nothing -x --none ?", "nothing", 1, true, ""),
        ] {
            let expected = (words.to_owned(), place, takes_word, options.to_owned());
            assert_eq!(line_of(text), expected, "{text}");
        }
    }

    #[test]
    fn the_domain_is_that_of_the_line() {
        assert_eq!(line("taut topic --domain 7 echo ?").domain(), Some(7));
        assert_eq!(line("taut topic echo ? --domain 7 --domain 8").domain(), Some(8));
        assert_eq!(line("taut topic echo ? --domain x").domain(), None);
    }
}
