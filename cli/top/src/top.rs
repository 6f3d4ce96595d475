// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut top`: shows the present state of a domain.

use crate::picture::{Gatherer, Order, Picture};
use crate::screen::{self, View};
use clap::Args;
use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEventKind, KeyModifiers};
use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::Errno;
use std::io::{self, IsTerminal, Write};
use std::time::{Duration, Instant};
use taut_cli::verb::{CommonArgs, End, Failure, Outcome, time};

/// Shows callbacks, topics and cores as they are now: response times beside their bounds, rates, losses, load
///
/// Does not subscribe and disturbs no process: it reads their statistics in shared memory. Response times are those of the jobs since the
/// previous refresh; the maximum is that of all jobs. Bounds are those that `taut check` computes from the processes' system files, while
/// these have the text with which the processes run. Violations are red.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut top
  taut top --sort trouble --filter camera
  taut top --once                          one picture, of a second
  taut top --once --json | jq '.topics[] | select(.rate_hz < 10)'

Keys: q quit, s next order, / filter (enter keeps, esc forgets it), space freeze, tab other table, arrows and page keys scroll.")]
pub struct TopArgs {
    #[command(flatten)]
    common: CommonArgs,
    /// Interval between refreshes
    #[arg(long, value_name = "TIME", default_value = "1s", value_parser = time)]
    every: Duration,
    /// The order of callbacks and topics
    #[arg(long, value_enum, value_name = "ORDER", default_value_t)]
    sort: Order,
    /// Show only rows whose name or program contains this text
    #[arg(long, value_name = "TEXT", default_value = "")]
    filter: String,
    /// Print the state once; without this, --json prints one line at each refresh
    #[arg(long)]
    once: bool,
}

/// The maximum delay of the response to a key.
const KEYS: Duration = Duration::from_millis(50);

pub fn run(args: &TopArgs) -> Outcome {
    let end = End::of(&args.common)?;
    let mut gatherer = Gatherer::new(args.common.domain()?)?;
    let first = gatherer.refresh()?;
    if args.once || args.common.json {
        return print(args, &mut gatherer, &end);
    }
    if !io::stdout().is_terminal() || !io::stdin().is_terminal() {
        return Err(Failure::unusable("this is no terminal: `taut top --once` prints one picture"));
    }
    end_with_terminal();
    // Restores the terminal, also after a panic.
    let mut terminal = ratatui::try_init()?;
    let shown = show(args, &mut gatherer, first, &mut terminal, &end);
    ratatui::restore();
    shown
}

fn print(args: &TopArgs, gatherer: &mut Gatherer, end: &End) -> Outcome {
    loop {
        end.pause(args.every);
        let mut picture = gatherer.refresh()?;
        picture.arrange(&args.filter, args.sort);
        let mut out = taut_cli::print::stdout();
        match args.common.json {
            true => writeln!(out, "{}", serde_json::to_string(&picture)?)?,
            false => screen::print(&picture, &mut out)?,
        }
        out.flush()?;
        if args.once || end.is_reached() {
            return Ok(());
        }
    }
}

fn show(
    args: &TopArgs,
    gatherer: &mut Gatherer,
    mut picture: Picture,
    terminal: &mut DefaultTerminal,
    end: &End,
) -> Outcome {
    let mut view = View { order: args.sort, filter: args.filter.clone(), ..View::default() };
    let mut next = Instant::now() + args.every.min(Duration::from_millis(200));
    while !end.is_reached() {
        let mut shown = picture.clone();
        shown.arrange(&view.filter, view.order);
        terminal.draw(|frame| screen::draw(frame, &shown, &mut view))?;
        let mut is_same = true;
        while is_same && !end.is_reached() {
            if event::poll(KEYS.min(next.saturating_duration_since(Instant::now())))? {
                is_same = false;
                if !answer(&event::read()?, &mut view) {
                    return Ok(());
                }
            }
            if Instant::now() >= next {
                next = Instant::now() + args.every;
                if !view.is_frozen {
                    picture = gatherer.refresh()?;
                    is_same = false;
                }
            }
        }
    }
    Ok(())
}

/// Ends the process when its terminal closes, because crossterm would read from it without end.
fn end_with_terminal() {
    std::thread::spawn(|| {
        let stdin = io::stdin();
        // A hang-up is reported without being requested.
        let mut input = [PollFd::new(&stdin, PollFlags::empty())];
        while let Err(Errno::INTR) = poll(&mut input, None) {}
        // There is no terminal left to print to.
        std::process::exit(2);
    });
}

/// Handles a key. Returns false if the key ends the program.
fn answer(event: &Event, view: &mut View) -> bool {
    let Event::Key(key) = event else { return true };
    if key.kind == KeyEventKind::Release {
        return true;
    }
    if key.modifiers.contains(KeyModifiers::CONTROL) && key.code == KeyCode::Char('c') {
        return false;
    }
    if view.is_typing {
        match key.code {
            KeyCode::Enter => view.is_typing = false,
            KeyCode::Esc => (view.is_typing, view.filter) = (false, String::new()),
            KeyCode::Backspace => drop(view.filter.pop()),
            KeyCode::Char(character) => view.filter.push(character),
            _ => {}
        }
        return true;
    }
    let table = if view.is_on_topics { &mut view.topics } else { &mut view.callbacks };
    match key.code {
        KeyCode::Char('q') | KeyCode::Esc => return false,
        KeyCode::Char('s') => view.order = view.order.next(),
        KeyCode::Char('/') => view.is_typing = true,
        KeyCode::Char(' ') => view.is_frozen = !view.is_frozen,
        KeyCode::Tab => view.is_on_topics = !view.is_on_topics,
        KeyCode::Down => table.select_next(),
        KeyCode::Up => table.select_previous(),
        KeyCode::PageDown => table.scroll_down_by(10),
        KeyCode::PageUp => table.scroll_up_by(10),
        _ => {}
    }
    true
}
