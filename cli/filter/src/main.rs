// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut-filter PROGRAM`: which messages somebody wants, said in jq's language. `taut topic echo --filter` starts it.
//!
//! It writes one line, empty or what is wrong with the program. Then it answers each line, a message as JSON, by one: `true`, `false`, or why the
//! program cannot be applied to it.
#![forbid(unsafe_code)]

use jaq_core::load::{Arena, File, Loader};
use jaq_core::{Compiler, Ctx, Vars, data, unwrap_valr};
use jaq_json::{Val, read};
use std::io::{self, BufRead, Write};
use std::process::ExitCode;

fn main() -> ExitCode {
    let Some(program) = std::env::args().nth(1) else {
        eprintln!("taut-filter: started by `taut topic echo --filter PROGRAM`");
        return ExitCode::from(2);
    };
    // Whoever asks has gone if nothing can be written.
    if answer(&program).is_ok() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

fn answer(program: &str) -> io::Result<()> {
    let mut out = io::stdout().lock();
    let filter = match Filter::new(program) {
        Ok(filter) => filter,
        Err(reason) => return writeln!(out, "{}", reason.replace('\n', " ")),
    };
    writeln!(out)?;
    out.flush()?;
    for line in io::stdin().lock().lines() {
        match filter.accepts(&line?) {
            Ok(is_wanted) => writeln!(out, "{is_wanted}")?,
            Err(reason) => writeln!(out, "{}", reason.replace('\n', " "))?,
        }
        out.flush()?;
    }
    Ok(())
}

/// A program that gives something else than false and null for what is wanted.
struct Filter {
    program: jaq_core::Filter<data::JustLut<Val>>,
    text: String,
}

impl Filter {
    fn new(text: &str) -> Result<Self, String> {
        let wrong = |what: String| format!("'{text}' is no program of jq's: {what}");
        let definitions = jaq_core::defs().chain(jaq_std::defs()).chain(jaq_json::defs());
        let functions = jaq_core::funs().chain(jaq_std::funs()).chain(jaq_json::funs());
        let arena = Arena::default();
        let modules = Loader::new(definitions)
            .load(&arena, File { code: text, path: () })
            .map_err(|_| wrong("its parts do not fit together".into()))?;
        let program = Compiler::default().with_funs(functions).compile(modules);
        let program = program.map_err(|errors| {
            let names = errors.iter().flat_map(|(_, all)| all.iter().map(|(name, _)| format!("'{name}'")));
            wrong(format!("it does not know {}", names.collect::<Vec<_>>().join(", ")))
        })?;
        Ok(Filter { program, text: text.to_owned() })
    }

    /// Whether a message, as JSON, is wanted.
    ///
    /// # Errors
    /// The program cannot be applied to it.
    fn accepts(&self, json: &str) -> Result<bool, String> {
        let refuse = |reason: String| format!("'{}' cannot be applied to a message: {reason}", self.text);
        let message = read::parse_single(json.as_bytes()).map_err(|error| refuse(error.to_string()))?;
        let context = Ctx::<data::JustLut<Val>>::new(&self.program.lut, Vars::new([]));
        for given in self.program.id.run((context, message)).map(unwrap_valr) {
            match given.map_err(|error| refuse(error.to_string()))? {
                Val::Null | Val::Bool(false) => {}
                _ => return Ok(true),
            }
        }
        Ok(false)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn predicates_and_selections_both_say_what_is_wanted() {
        let message = r#"{"a":3,"b":{"c":[1,2]},"s":"x"}"#;
        for (program, accepts) in [
            (".a > 2", true),
            (".a > 3", false),
            ("select(.b.c | length == 2)", true),
            ("select(.s == \"y\")", false),
            (".s | test(\"^x$\")", true),
            (".nothing", false),
            (".b.c | any(. == 2)", true),
        ] {
            assert_eq!(Filter::new(program).unwrap().accepts(message).unwrap(), accepts, "{program}");
        }
        for wrong in [".a >", "unknown_function", "| .a"] {
            assert!(Filter::new(wrong).is_err(), "{wrong}");
        }
        assert!(Filter::new(".s.t").unwrap().accepts(message).is_err());
    }
}
