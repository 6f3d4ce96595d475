// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut man`: writes a manual page for each verb from its help text.

use crate::bridge_ros::BRIDGE;
use crate::sibling::{GATEWAY, Sibling, WITH_VERBS};
use crate::verb::{Failure, Outcome};
use clap::{Args, Command};
use clap_mangen::Man;
use clap_mangen::roff::{Roff, roman};
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process;

/// Writes the manual pages: taut.1, taut-topic.1, taut-topic-echo.1 and so on
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut man ~/.local/share/man/man1     then: man taut-topic-echo
  taut man man && man -l man/taut.1")]
pub struct ManArgs {
    /// The folder; created if it does not exist
    #[arg(value_name = "DIR", value_hint = clap::ValueHint::DirPath)]
    folder: PathBuf,
}

/// Writes the pages of `taut`. The programs of separate verbs write their own pages, and those of the gateway and the bridge are their help
/// texts. If such a program is missing, a page names it.
pub fn run(args: &ManArgs, command: Command) -> Outcome {
    let mut written = write(args, command, true)?;
    for (sibling, verbs) in WITH_VERBS {
        let program = sibling.path();
        match process::Command::new(&program).arg("man").arg(&args.folder).output() {
            Ok(output) if output.status.success() => {
                let said = String::from_utf8_lossy(&output.stdout);
                let pages = said.trim().parse::<usize>().unwrap_or_default();
                // These pages replace the ones that name the program.
                written += pages.saturating_sub(verbs.len());
            }
            Ok(output) => {
                let words = String::from_utf8_lossy(&output.stderr);
                return Err(Failure::unusable(format!("{}: {}", program.display(), words.trim())));
            }
            Err(error) => {
                let reason = sibling.error(&program, &error);
                eprintln!("taut: the pages of {} have no options: {reason}", verbs.join(", "));
            }
        }
    }
    for sibling in [&GATEWAY, &BRIDGE] {
        if let Err(reason) = write_help(args, sibling) {
            eprintln!("taut: the page of {} has no options: {reason}", sibling.program);
        }
    }
    Ok(writeln!(crate::print::stdout(), "Wrote {written} pages to {}", args.folder.display())?)
}

/// Replaces the page of a separate program by one with its help text.
///
/// # Errors
/// The reason why it has none.
fn write_help(args: &ManArgs, sibling: &Sibling) -> Result<(), String> {
    let program = sibling.path();
    let mut command = process::Command::new(&program);
    // Without colours.
    command.arg("--help").env_remove("CLICOLOR_FORCE").env("NO_COLOR", "1");
    let output = command.output().map_err(|error| sibling.error(&program, &error).to_string())?;
    if !output.status.success() {
        return Err(String::from_utf8_lossy(&output.stderr).trim().to_owned());
    }
    let help = String::from_utf8_lossy(&output.stdout);
    let (about, rest) = help.split_once('\n').unwrap_or((&help, ""));
    let mut page = Roff::new();
    page.control("SH", ["NAME"]).text([roman(format!("{} - {about}", sibling.program))]);
    page.control("SH", ["DESCRIPTION"]).control("nf", []);
    for line in rest.lines() {
        page.text([roman(line)]);
    }
    page.control("fi", []).control("SH", ["SEE ALSO"]).text([roman("taut(1)")]);
    let mut text = title(sibling.program, env!("CARGO_PKG_VERSION")).into_bytes();
    // Writing to memory cannot fail.
    let _ = page.to_writer(&mut text);
    let path = args.folder.join(format!("{}.1", sibling.program));
    crate::replace::write(&path, &text)
        .map_err(|error| format!("{} cannot be written: {error}", path.display()))
}

/// Writes the pages of a program's verbs, and prints how many.
pub fn write_verbs(args: &ManArgs, command: Command) -> Outcome {
    let written = write(args, command, false)?;
    Ok(writeln!(crate::print::stdout(), "{written}")?)
}

fn write(args: &ManArgs, command: Command, with_top: bool) -> Outcome<usize> {
    let mut command = command.disable_help_subcommand(true);
    command.build();
    let version = command.get_version().unwrap_or_default().to_owned();
    let failed =
        |path: &Path, error| Failure::unusable(format!("{} cannot be written: {error}", path.display()));
    fs::create_dir_all(&args.folder).map_err(|error| failed(&args.folder, error))?;
    let mut pages = Vec::new();
    collect(&command, &version, None, &mut pages);
    // The first page is that of the command itself.
    pages.drain(..usize::from(!with_top));
    for (name, page) in &pages {
        let path = args.folder.join(name);
        crate::replace::write(&path, page).map_err(|error| failed(&path, error))?;
    }
    Ok(pages.len())
}

/// Writes a command's page and those of its verbs; `above` is the name of the parent's page.
fn collect(command: &Command, version: &str, above: Option<&str>, pages: &mut Vec<(String, Vec<u8>)>) {
    let name = command.get_display_name().unwrap_or_else(|| command.get_name());
    pages.push((format!("{name}.1"), page(command, name, version, above)));
    for verb in command.get_subcommands().filter(|verb| !verb.is_hide_set()) {
        collect(verb, version, Some(name), pages);
    }
}

fn page(command: &Command, name: &str, version: &str, above: Option<&str>) -> Vec<u8> {
    let mut page = title(name, version).into_bytes();
    // Writing to memory cannot fail.
    let _ = sections(&Man::new(command.clone()), command, above, &mut page);
    page
}

/// clap_mangen omits an empty date from its title, which shifts the fields after it.
fn title(name: &str, version: &str) -> String {
    format!(".TH \"{}\" \"1\" \"\" \"taut {version}\" \"Tautline\"\n", name.to_uppercase())
}

fn sections(man: &Man, command: &Command, above: Option<&str>, page: &mut Vec<u8>) -> io::Result<()> {
    man.render_name_section(page)?;
    man.render_synopsis_section(page)?;
    man.render_description_section(page)?;
    if command.get_arguments().any(|argument| !argument.is_hide_set()) {
        man.render_options_section(page)?;
    }
    if command.has_subcommands() {
        man.render_subcommands_section(page)?;
    }
    let help = command.get_after_long_help().or(command.get_after_help()).map(ToString::to_string);
    let mut more = Roff::new();
    for part in help.unwrap_or_default().split("\n\n") {
        if let Some(examples) = part.strip_prefix("Examples:\n") {
            // Examples stay unchanged, one on each line.
            more.control("SH", ["EXAMPLES"]).control("nf", []);
            for line in examples.lines() {
                more.text([roman(line.strip_prefix("  ").unwrap_or(line))]);
            }
            more.control("fi", []);
        } else if let Some(codes) = part.strip_prefix("Exit codes: ") {
            more.control("SH", ["EXIT STATUS"]).text([roman(codes)]);
        } else if !part.is_empty() {
            more.control("SH", ["NOTES"]).text([roman(part)]);
        }
    }
    if let Some(above) = above {
        more.control("SH", ["SEE ALSO"]).text([roman(format!("{above}(1)"))]);
    }
    more.to_writer(page)
}
