// SPDX-License-Identifier: MIT OR Apache-2.0
//! The terminal while a bag is played: commands and progress.

use super::player::Control;
use crate::record::progress;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;
use taut_cli::verb::{End, Failure, Outcome, time};
use tautline_rt::clock::nanoseconds;

const LOOK: Duration = Duration::from_millis(20);

/// A command typed at the terminal.
#[derive(Debug, PartialEq)]
enum Word {
    Pause,
    Step,
    /// Continue at this time from the bag's start.
    Seek(Duration),
}

fn word(line: &str) -> Result<Word, String> {
    match line.trim().split_once(' ').unwrap_or((line.trim(), "")) {
        ("", _) => Ok(Word::Pause),
        ("n", "") => Ok(Word::Step),
        ("s", to) => Ok(Word::Seek(time(to.trim())?)),
        (other, _) => Err(format!(
            "'{other}' is none of: enter pauses and goes on, n plays one message, s 12 leaps to 12 s"
        )),
    }
}

/// Makes SIGUSR1 pause or resume playing, and SIGUSR2 play one message.
pub fn listen(control: &Arc<Control>) -> Outcome {
    use signal_hook::consts::{SIGUSR1, SIGUSR2};
    let mut signals = signal_hook::iterator::Signals::new([SIGUSR1, SIGUSR2])
        .map_err(|error| Failure::unusable(format!("SIGUSR1 cannot be caught: {error}")))?;
    let control = control.clone();
    std::thread::spawn(move || {
        signals
            .forever()
            .for_each(|signal| obey(&control, 0, &if signal == SIGUSR1 { Word::Pause } else { Word::Step }));
    });
    Ok(())
}

fn obey(control: &Control, start_ns: u64, word: &Word) {
    match word {
        Word::Pause => {
            // Steps for which there was no message do not count for the next pause.
            control.steps.store(0, Ordering::Relaxed);
            control.is_paused.fetch_xor(true, Ordering::Relaxed);
        }
        // A step has a meaning only while paused.
        Word::Step if control.is_paused.load(Ordering::Relaxed) => {
            control.steps.fetch_add(1, Ordering::Relaxed);
        }
        Word::Step => {}
        Word::Seek(to) => {
            control.steps.store(0, Ordering::Relaxed);
            control.seek(start_ns.saturating_add(nanoseconds(*to)));
        }
    }
}

/// Shows the progress and obeys typed commands until the end.
pub fn watch(control: &Arc<Control>, end: &End, start_ns: u64, is_json: bool, is_over: impl Fn() -> bool) {
    let progress = progress(is_json);
    let typed = control.clone();
    crate::terminal::on_line(move |line| match word(line) {
        Ok(word) => obey(&typed, start_ns, &word),
        Err(error) => eprintln!("taut: {error}"),
    });
    while !end.is_reached() && !is_over() {
        let (at_ns, messages) =
            (control.position_ns.load(Ordering::Relaxed), control.published.load(Ordering::Relaxed));
        let seconds = at_ns.saturating_sub(start_ns) as f64 / 1e9;
        let state = if control.is_paused.load(Ordering::Relaxed) { "paused, " } else { "" };
        progress.set_message(format!("{state}at {seconds:.1} s, {messages} messages"));
        end.pause(LOOK);
    }
    progress.finish_and_clear();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_read() {
        assert_eq!([word(""), word("n")], [Ok(Word::Pause), Ok(Word::Step)]);
        assert_eq!(word("s 1.5"), Ok(Word::Seek(Duration::from_millis(1500))));
        for wrong in ["x", "s", "s x", "n 2"] {
            assert!(word(wrong).is_err(), "{wrong}");
        }
    }
}
