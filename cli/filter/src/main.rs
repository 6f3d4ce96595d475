// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut-filter PROGRAM` selects messages by a program in jq's language. `taut topic echo --filter` starts it.
//!
//! It writes one line, which is empty or says what is wrong with the program. Then it reads messages, one a line, as JSON with the numbers
//! `NaN`, `Infinity` and `-Infinity`. It writes a line for each: `true`, `false`, or why the program cannot be applied to the message.
#![forbid(unsafe_code)]

mod ieee;

use jaq_core::load::{self, Arena, File, Loader};
use jaq_core::{Compiler, Ctx, Vars, data, unwrap_valr};
use jaq_json::{Val, read};
use std::io::{self, BufRead, Write};
use std::process::ExitCode;

/// The name of the user's program among the definitions.
const PROGRAM: &str = "taut__program";

fn main() -> ExitCode {
    let Some(program) = std::env::args().nth(1) else {
        eprintln!("taut-filter: started by `taut topic echo --filter PROGRAM`");
        return ExitCode::from(2);
    };
    // Writing fails when the program that started this one has ended.
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
            Ok(is_selected) => writeln!(out, "{is_selected}")?,
            Err(reason) => writeln!(out, "{}", reason.replace('\n', " "))?,
        }
        out.flush()?;
    }
    Ok(())
}

/// A program. A message is selected if one of the results is neither false nor null.
struct Filter {
    program: jaq_core::Filter<data::JustLut<Val>>,
    text: String,
}

impl Filter {
    fn new(text: &str) -> Result<Self, String> {
        let wrong = |what: String| format!("'{text}' is not a jq program: {what}");
        let syntax_error = || wrong("syntax error".into());
        let mut body = load::parse(text, |parser| parser.term()).ok_or_else(syntax_error)?;
        ieee::replace(&mut body);
        let program = load::parse::Def { name: PROGRAM, args: Vec::new(), body };
        let library = jaq_core::defs().chain(jaq_std::defs()).chain(jaq_json::defs());
        let mut definitions: Vec<load::parse::Def<&str>> = library.chain(ieee::definitions()).collect();
        definitions.push(program);
        let functions = jaq_core::funs().chain(jaq_std::funs()).chain(jaq_json::funs());
        let arena = Arena::default();
        let modules = Loader::new(definitions)
            .load(&arena, File { code: PROGRAM, path: () })
            .map_err(|_| syntax_error())?;
        let program = Compiler::default().with_funs(functions).compile(modules);
        let program = program.map_err(|errors| {
            let names = errors.iter().flat_map(|(_, all)| all.iter().map(|(name, _)| format!("'{name}'")));
            wrong(format!("it has no function {}", names.collect::<Vec<_>>().join(", ")))
        })?;
        Ok(Filter { program, text: text.to_owned() })
    }

    /// Whether a message, as JSON, is selected.
    ///
    /// # Errors
    /// The program cannot be applied to it.
    fn accepts(&self, json: &str) -> Result<bool, String> {
        let refuse = |reason: String| format!("'{}' cannot be applied to a message: {reason}", self.text);
        let message = read::parse_single(json.as_bytes()).map_err(|error| refuse(error.to_string()))?;
        let context = Ctx::<data::JustLut<Val>>::new(&self.program.lut, Vars::new([]));
        for result in self.program.id.run((context, message)).map(unwrap_valr) {
            match result.map_err(|error| refuse(error.to_string()))? {
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
    fn predicates_and_selections_select() {
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

    #[test]
    fn comparisons_are_those_of_ieee_754() {
        let message =
            r#"{"low":-Infinity,"high":Infinity,"nan":NaN,"one":1,"all":[NaN,2.5,-Infinity],"text":"NaN"}"#;
        for (program, accepts) in [
            (".low < 0", true),
            (".low > 0", false),
            (".low + 1 < 0", true),
            (".high > 1e308", true),
            (".high < 1", false),
            (".high == infinite", true),
            (".nan > 1", false),
            (".nan >= 1", false),
            (".nan < 1", false),
            (".nan <= 1", false),
            ("1 > .nan", false),
            ("1 >= .nan", false),
            ("1 < .nan", false),
            (".nan < .nan", false),
            (".nan == .nan", false),
            (".nan != .nan", true),
            (".nan | isnan", true),
            (".one | isnan", false),
            (".nan | . < 0 or . >= 0", false),
            (".all | map(select(. < 3)) == [2.5, -infinite]", true),
            (".all | any(. > 2)", true),
            (".all | any(. > 3)", false),
            (".all | sort | .[2] == 2.5", true),
            ("if .nan < 0 then true else false end", false),
            ("def below(x): . < x; .nan | below(0)", false),
            ("reduce .all[] as $x (0; if $x < 0 then . + 1 else . end) == 1", true),
            ("[.all[] as $x | $x < 3] == [false, true, true]", true),
            ("\"\\(.nan < 0)\" == \"false\"", true),
            ("{a: (.nan < 0)}.a", false),
            ("[1, 2] < [1, 3] and .text == \"NaN\" and (\"a\" < \"b\") and (null < 1)", true),
        ] {
            assert_eq!(Filter::new(program).unwrap().accepts(message).unwrap(), accepts, "{program}");
        }
    }
}
