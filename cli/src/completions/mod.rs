// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut completions`: the scripts through which shells request completions, and the candidates.
//!
//! A script calls `COMPLETE=SHELL taut -- WORDS` at each press of the tab key. The words are read once by clap's engine, which
//! knows what may stand where, and once as a `Line`, from which the completers of arguments (`live`) take the domain, the
//! node or the topic.

mod asked;
mod line;
mod live;
mod paths;

pub use live::{
    action_servers, action_types, actions, components, fields, interfaces, message_types, nodes, nodes_with,
    packages, parameters, servers, service_types, services, topic_types, topics, transitions,
    types_of_service,
};

use crate::sibling::WITH_VERBS;
use crate::verb::{Failure, Outcome};
use asked::{ASKED, Asked};
use clap::{Args, Command};
use clap_complete::engine::{CompletionCandidate, complete};
use clap_complete::env::{EnvCompleter, Shells};
use line::Line;
use std::env;
use std::ffi::{OsStr, OsString};
use std::fs::OpenOptions;
use std::io::{self, Write};
use std::path::Path;
use std::process::ExitCode;
use std::time::Instant;

/// The variable that names the calling shell.
const VARIABLE: &str = "COMPLETE";
/// The variable in which the scripts of clap_complete for bash and zsh pass the index of the word to complete.
const INDEX: &str = "_CLAP_COMPLETE_INDEX";
/// The variable in which bash, zsh and elvish pass the separator of candidates.
const SEPARATOR: &str = "_CLAP_IFS";
const SHELLS: Shells<'static> = Shells::builtins();

/// Prints the script with which a shell completes the arguments of `taut`
///
/// It completes verbs, options, and the names that exist in the domain of --domain or of the environment: topics, nodes, services,
/// actions, types, fields, transitions and parameters. Parameters are requested from their node, which has 60 ms to answer.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  source <(taut completions bash)           now; as a line of ~/.bashrc: always
  source <(taut completions zsh)            in ~/.zshrc, behind compinit
  taut completions fish | source            in ~/.config/fish/completions/taut.fish
  eval (taut completions elvish | slurp)    in ~/.config/elvish/rc.elv
  taut completions powershell | Out-String | Invoke-Expression    in $PROFILE

A file that is loaded at the first use: echo 'source <(taut completions bash)' > ~/.local/share/bash-completion/completions/taut")]
pub struct CompletionsArgs {
    #[arg(value_name = "SHELL", help = "The shell")]
    shell: clap_complete::Shell,
}

/// Prints the script.
pub fn run(args: &CompletionsArgs) -> Outcome {
    let name = args.shell.to_string();
    let shell = SHELLS.completer(&name).ok_or_else(|| Failure::unusable(format!("no script for {name}")))?;
    Ok(io::stdout().write_all(&script(shell)?)?)
}

/// Prints candidates if a shell called this program for them, as it does at each press of the tab key. Call this before anything else.
pub fn answer(command: impl Fn() -> Command) -> Option<ExitCode> {
    let since = Instant::now();
    // Other programs use a variable of this name, too.
    let shell = SHELLS.completer(env::var_os(VARIABLE)?.to_str()?)?;
    let words: Vec<OsString> = env::args_os().skip_while(|word| word != "--").skip(1).collect();
    let answer = if words.is_empty() {
        script(shell)
    } else {
        // Only candidates may appear on the user's line, so standard error is discarded.
        if let Ok(null) = OpenOptions::new().write(true).open("/dev/null") {
            let _ = rustix::stdio::dup2_stderr(null);
        }
        let index = env::var(INDEX).ok().and_then(|index| index.parse().ok());
        let index = index.unwrap_or(words.len() - 1).min(words.len());
        if index > 1 {
            become_program_of(&words[1]);
        }
        candidates(command(), shell.name(), words, index, since)
            .map(|candidates| written(shell.name(), &candidates))
    };
    let done = answer.and_then(|text| io::stdout().write_all(&text));
    Some(if done.is_ok() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Replaces this process by the program that has this verb. Returns if none has it, if this is that program, or if it cannot be started.
fn become_program_of(verb: &OsStr) {
    let is_its = |verbs: &[&str]| verbs.iter().any(|name| *name == verb);
    let Some((sibling, _)) = WITH_VERBS.iter().find(|(_, verbs)| is_its(verbs)) else { return };
    if env::current_exe().is_ok_and(|own| own.file_name() != Some(sibling.program.as_ref())) {
        sibling.become_it(&env::args_os().skip(1).collect::<Vec<_>>());
    }
}

/// The script. It calls this program by name if the shell found it in PATH, otherwise by its path.
fn script(shell: &dyn EnvCompleter) -> io::Result<Vec<u8>> {
    const PROGRAM: &str = "taut_program";
    let program = env::args_os().next().unwrap_or_else(|| "taut".into());
    let path = Path::new(&program);
    let path = if path.components().count() > 1 { std::path::absolute(path)? } else { path.to_owned() };
    let path = path.to_string_lossy();
    let mut script = Vec::new();
    if shell.name() != "bash" {
        shell.write_registration(VARIABLE, "taut", "taut", &path, &mut script)?;
        return Ok(script);
    }
    // clap_complete quotes a path if necessary, and then puts double quotes around it.
    shell.write_registration(VARIABLE, "taut", "taut", PROGRAM, &mut script)?;
    let quoted = format!("'{}'", path.replace('\'', r"'\''"));
    let script = String::from_utf8_lossy(&script).replace(&format!("\"{PROGRAM}\""), &quoted);
    // Elements of lists have brackets, which bash must not expand as file patterns.
    Ok(script.replacen("COMPREPLY=( $( ", "local -; set -f; COMPREPLY=( $( ", 1).into_bytes())
}

fn candidates(
    mut command: Command,
    shell: &str,
    mut words: Vec<OsString>,
    mut index: usize,
    since: Instant,
) -> io::Result<Vec<CompletionCandidate>> {
    let before = if shell == "bash" { join(&mut words, &mut index) } else { 0 };
    // zsh leaves out an empty last word.
    if words.len() == index {
        words.push(OsString::new());
    }
    command.build();
    let line = Line::of(&command, &words, index);
    let asks_for_options = words[index].as_encoded_bytes().starts_with(b"-");
    let takes_word = line.takes_word;
    let replaces = ["bash", "fish", "powershell"].contains(&shell);
    let is_raw = ["bash", "powershell"].contains(&shell);
    let _ = ASKED.set(Asked { line, since, replaces, is_raw });
    let mut found = complete(&mut command, words, index, env::current_dir().ok().as_deref())?;
    if !asks_for_options && takes_word {
        found.retain(|candidate| !candidate.get_value().as_encoded_bytes().starts_with(b"-"));
    }
    let shortened = |candidate: CompletionCandidate| {
        let value = candidate.get_value().to_string_lossy().get(before..).map(str::to_owned);
        CompletionCandidate::new(value.unwrap_or_default())
    };
    Ok(if before == 0 { found } else { found.into_iter().map(shortened).collect() })
}

/// Bash splits `--option=value` into three words. Returns the length of the part of the word that bash does not pass.
fn join(words: &mut Vec<OsString>, index: &mut usize) -> usize {
    let (mut before, mut place) = (0, 2);
    while place < words.len() {
        let is_long = words[place - 1].as_encoded_bytes().starts_with(b"--") && words[place - 1] != "--";
        if !is_long || words[place] != "=" {
            place += 1;
            continue;
        }
        let value = if place + 1 < words.len() { words.remove(place + 1) } else { OsString::new() };
        words.remove(place);
        let option = &mut words[place - 1];
        option.push("=");
        if *index == place || *index == place + 1 {
            before = option.len();
        }
        option.push(value);
        *index -= index.saturating_sub(place - 1).min(2);
    }
    before
}

/// Prints the candidates in the format of each shell.
fn written(shell: &str, candidates: &[CompletionCandidate]) -> Vec<u8> {
    let one = |candidate: &CompletionCandidate| {
        let value = candidate.get_value().to_string_lossy();
        let help = candidate.get_help().map(ToString::to_string).unwrap_or_default();
        let help = help.lines().next().filter(|help| !help.is_empty());
        match (shell, help) {
            ("zsh", help) => {
                let help = help.map(|help| format!(":{}", help.replace('\\', r"\\")));
                value.replace('\\', r"\\").replace(':', r"\:") + &help.unwrap_or_default()
            }
            ("fish" | "powershell", Some(help)) => format!("{value}\t{help}"),
            _ => value.into_owned(),
        }
    };
    let separator = env::var(SEPARATOR).unwrap_or_else(|_| "\n".into());
    candidates.iter().map(one).collect::<Vec<_>>().join(&separator).into_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bash_splits_options_and_their_values() {
        let joined = |words: &[&str], mut index| {
            let mut words: Vec<OsString> = words.iter().map(OsString::from).collect();
            let before = join(&mut words, &mut index);
            (
                words.into_iter().map(|word| word.into_string().unwrap()).collect::<Vec<_>>().join(" "),
                index,
                before,
            )
        };
        type Joined<'a> = (&'a str, usize, usize);
        let cases: [(&[&str], usize, Joined); 6] = [
            (
                &["taut", "topic", "--domain", "=", "7", "echo", "/i"],
                6,
                ("taut topic --domain=7 echo /i", 4, 0),
            ),
            (
                &["taut", "topic", "--domain", "=", "7", "echo", "/i"],
                1,
                ("taut topic --domain=7 echo /i", 1, 0),
            ),
            (&["taut", "topic", "echo", "--field", "=", "po"], 5, ("taut topic echo --field=po", 3, 8)),
            (&["taut", "topic", "echo", "--field", "="], 4, ("taut topic echo --field=", 3, 8)),
            (
                &["taut", "topic", "--domain", "=", "7", "echo", "--field", "=", "po"],
                8,
                ("taut topic --domain=7 echo --field=po", 4, 8),
            ),
            (&["taut", "topic", "pub", "a", "=", "b"], 5, ("taut topic pub a = b", 5, 0)),
        ];
        for (words, index, (line, now, before)) in cases {
            assert_eq!(joined(words, index), (line.to_owned(), now, before));
        }
    }

    #[test]
    fn shells_read_candidates_each_in_their_way() {
        let candidates = [
            CompletionCandidate::new("/a:b").help(Some("One\nand more".into())),
            CompletionCandidate::new("/c"),
        ];
        for (shell, text) in [("bash", "/a:b\n/c"), ("zsh", "/a\\:b:One\n/c"), ("fish", "/a:b\tOne\n/c")] {
            assert_eq!(String::from_utf8(written(shell, &candidates)).unwrap(), text, "{shell}");
        }
    }
}
