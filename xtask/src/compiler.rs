// SPDX-License-Identifier: MIT OR Apache-2.0
//! This program in place of the compiler, by a name of its own: a crate is compiled as clippy's driver does, and documented. What rustdoc says is the
//! compiler's word to cargo, which keeps and repeats it.

use crate::machine;
use std::ffi::OsString;
use std::fs;
use std::io::Result;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::sync::LazyLock;

/// `cargo clippy` gives clippy's driver other arguments: what both built under one name each would build anew for the other.
const NAME: &str = "compiler-of-tests";

/// The folder of rustdoc's JSON, beside that of what is compiled.
const DOCUMENTS: &str = "documents";

/// For cargo's setting `rustc-workspace-wrapper`; `None` without clippy.
pub fn path() -> Option<&'static PathBuf> {
    static PATH: LazyLock<Option<PathBuf>> = LazyLock::new(|| {
        let version = Command::new("clippy-driver").arg("--version").output();
        version.ok().filter(|output| output.status.success())?;
        link().map_err(|error| eprintln!("{NAME} cannot be linked: {error}")).ok()
    });
    PATH.as_ref()
}

/// Links this program to where it stays when cargo builds it anew.
fn link() -> Result<PathBuf> {
    let path = machine::target_dir().join(NAME);
    let file = |path: &Path| fs::metadata(path).map(|found| (found.dev(), found.ino()));
    // Where this program was, a build may have put another.
    if file(&path).ok() != Some(file(Path::new("/proc/self/exe"))?) {
        // Somebody may be running the one before.
        let new = path.with_extension(std::process::id().to_string());
        fs::hard_link(std::env::current_exe()?, &new).and_then(|()| fs::rename(&new, &path))?;
    }
    Ok(path)
}

/// Whether this process has been started in place of the compiler.
pub fn is_meant() -> bool {
    std::env::args_os().next().is_some_and(|own| Path::new(&own).file_name() == Some(NAME.as_ref()))
}

/// Compiles, and documents.
pub fn run() -> ExitCode {
    let arguments: Vec<OsString> = std::env::args_os().skip(1).collect();
    let Some((rustc, arguments)) = arguments.split_first() else {
        eprintln!("{NAME}: cargo runs it in place of the compiler, whose path comes first");
        return ExitCode::from(2);
    };
    let rustc = Path::new(rustc);
    let mut clippy = Command::new(rustc.with_file_name("clippy-driver"));
    clippy.arg(rustc).args(arguments);
    if is_integration_test(arguments) {
        clippy.args(["-C", "opt-level=0"]);
    }
    let compiled = run_as(&mut clippy);
    let is_program = std::env::var_os("CARGO_BIN_NAME").is_some();
    match documentation(arguments, is_program) {
        Some(arguments) if compiled == ExitCode::SUCCESS => {
            let mut rustdoc = Command::new(rustc.with_file_name("rustdoc"));
            // JSON is an option that stable versions keep for nightly ones.
            run_as(rustdoc.args(arguments).env("RUSTC_BOOTSTRAP", "1"))
        }
        _ => compiled,
    }
}

fn run_as(command: &mut Command) -> ExitCode {
    match command.status() {
        // A signal has no code.
        Ok(status) => {
            status.code().and_then(|code| u8::try_from(code).ok()).map_or(ExitCode::FAILURE, ExitCode::from)
        }
        Err(error) => {
            eprintln!("{}: {error}", command.get_program().display());
            ExitCode::FAILURE
        }
    }
}

/// Whether these are a compiler's arguments for a file of a package's `tests/`. Cargo optimises it as it does the package, which takes longer than a
/// run of it gains.
fn is_integration_test(arguments: &[OsString]) -> bool {
    let is_in_tests = |word: &OsString| {
        let path = Path::new(word);
        path.extension().is_some_and(|extension| extension == "rs")
            && path.components().any(|folder| folder.as_os_str() == "tests")
    };
    arguments.iter().any(|word| word == "--test") && arguments.iter().any(is_in_tests)
}

/// From a compiler's arguments those of rustdoc; `None` for what is a test, an example, a build script, no crate, or optimised as a release is, which
/// is compiled without that as well. `is_program`: one of a package's programs. By arguments alone: cargo does not compile again what differs in
/// something else.
fn documentation(arguments: &[OsString], is_program: bool) -> Option<Vec<OsString>> {
    let (mut kept, mut more) = (Vec::new(), vec!["-Zunstable-options", "--output-format", "json"]);
    let (mut name, mut folder, mut is_crate, mut is_macro) = (String::new(), None, false, false);
    let mut words = arguments.iter().peekable();
    while let Some(word) = words.next() {
        let text = word.to_str().unwrap_or_default();
        let value = words.peek().and_then(|value| value.to_str()).unwrap_or_default();
        match (text, value) {
            ("--test", _) | ("-C", "opt-level=3") => return None,
            ("--crate-name", value) if value.starts_with("build_script_") => return None,
            ("--crate-name", value) => name = value.to_owned(),
            // All of a program is private.
            ("--crate-type", "bin") if is_program => {
                more.extend(["--document-private-items", "-Arustdoc::private_intra_doc_links"]);
            }
            ("--crate-type", "bin") => return None,
            // Of which cargo does not tell where it is compiled to, only where it is linked to.
            ("--crate-type", "proc-macro") => is_macro = true,
            ("-C", value) if !is_macro => name += value.strip_prefix("extra-filename=").unwrap_or_default(),
            ("--out-dir", _) => {
                folder = words.next().map(Path::new);
                continue;
            }
            // A library to link with.
            ("-l", _) => {
                words.next();
                continue;
            }
            _ if text.starts_with("--emit=") => {
                is_crate = true;
                continue;
            }
            _ => {}
        }
        kept.push(word.clone());
    }
    let folder = folder.filter(|folder| is_crate && !folder.ends_with("examples"))?;
    kept.extend(more.into_iter().chain(["--out-dir"]).map(Into::into));
    kept.push(folder.with_file_name(DOCUMENTS).join(name).into());
    Some(kept)
}

/// The JSON of the library with this name that cargo has compiled to this file, if it is one of macros or not linked to there.
pub fn document(compiled: &Path, library: &str) -> PathBuf {
    let folder = compiled.parent().unwrap_or(Path::new(""));
    let folder =
        if folder.ends_with("deps") { folder.with_file_name(DOCUMENTS) } else { folder.join(DOCUMENTS) };
    let name = compiled.file_stem().unwrap_or_default().to_string_lossy();
    folder.join(name.strip_prefix("lib").unwrap_or(&name)).join(format!("{library}.json"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(arguments: &str, is_program: bool) -> Option<String> {
        let arguments: Vec<OsString> = arguments.split(' ').map(Into::into).collect();
        let made = documentation(&arguments, is_program)?;
        Some(made.iter().map(|word| word.to_str().unwrap()).collect::<Vec<_>>().join(" "))
    }

    #[test]
    fn a_crate_is_documented_beside_what_is_compiled() {
        let library = "--crate-name a_b a/src/lib.rs --crate-type lib --emit=dep-info,metadata,link -C opt-level=2 -C extra-filename=-12 \
                       --out-dir /t/debug/deps -l static=d --extern c=/t/debug/deps/libc-3.rmeta";
        assert_eq!(
            of(library, false).as_deref(),
            Some(
                "--crate-name a_b a/src/lib.rs --crate-type lib -C opt-level=2 -C extra-filename=-12 --extern c=/t/debug/deps/libc-3.rmeta \
                 -Zunstable-options --output-format json --out-dir /t/debug/documents/a_b-12"
            )
        );
        let found = |compiled: &str| document(Path::new(compiled), "a_b").display().to_string();
        assert_eq!(found("/t/debug/deps/liba_b-12.rmeta"), "/t/debug/documents/a_b-12/a_b.json");
        let macros = of(&library.replace("type lib", "type proc-macro"), false);
        assert!(macros.is_some_and(|made| made.ends_with(" --out-dir /t/debug/documents/a_b")));
        assert_eq!(found("/t/debug/liba_b.so"), "/t/debug/documents/a_b/a_b.json");
    }

    #[test]
    fn tests_of_a_library_are_optimised_as_it_is_and_those_beside_it_are_not() {
        let is_met =
            |words: &str| is_integration_test(&words.split(' ').map(Into::into).collect::<Vec<OsString>>());
        assert!(is_met("--crate-name t a/tests/t.rs --emit=link --test"));
        assert!(!is_met("--crate-name a a/src/lib.rs --emit=link --test"));
        assert!(!is_met("--crate-name t a/tests/t.rs --crate-type bin --emit=link"));
    }

    #[test]
    fn of_programs_all_is_documented_and_of_tests_nothing() {
        let program = "--crate-name p p.rs --crate-type bin --emit=link --out-dir /t/debug/deps";
        assert!(of(program, true).is_some_and(|made| made.contains(" --document-private-items ")));
        assert_eq!(of(program, false), None, "a test that is a program");
        assert_eq!(of(&format!("{program} --test"), true), None);
        assert_eq!(of(&program.replace("deps", "examples"), true), None);
        assert_eq!(of(&program.replace("-name p", "-name build_script_build"), true), None);
        assert_eq!(of(&format!("{program} -C opt-level=3"), true), None);
        assert_eq!(of("- --crate-name ___ --print=file-names", true), None);
    }
}
