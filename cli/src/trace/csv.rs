// SPDX-License-Identifier: MIT OR Apache-2.0
//! A recording as CSV: a line for each event and each created object, in order of time.

use super::recording::Recording;
use std::io::{self, Write};
use tautline_trace::{Description, Event, EventKind};

const HEAD: &str = "time_ns,pid,process,tid,thread,event,object_id,object,parent_id,sequence_number,source_timestamp_ns,\
                    publisher,release_ns,timeout_ns,from_sequence_number,from_publisher";

pub fn write(recording: &Recording, to: &mut dyn Write) -> io::Result<()> {
    writeln!(to, "{HEAD}")?;
    let mut made: Vec<(u32, &Description)> = recording
        .processes
        .iter()
        .flat_map(|(process, of)| of.objects.values().map(|object| (*process, object)))
        .collect();
    made.sort_by_key(|(process, object)| (object.created_ns, *process, object.id));
    let mut made = made.into_iter().peekable();
    for timed in &recording.events {
        while let Some((process, object)) =
            made.next_if(|(_, object)| object.created_ns <= timed.event.time_ns)
        {
            write_made(recording, process, object, to)?;
        }
        let (pid, name) = recording.program(timed.process);
        let thread = quoted(&recording.thread_name(timed.process, timed.tid));
        let Event { time_ns, kind, object, arguments } = timed.event;
        let known = recording.object(timed.process, object);
        let (label, parent) = known.map_or((String::new(), 0), |known| (quoted(&known.name), known.parent.0));
        let [a, b, c] = arguments;
        let more = match kind {
            EventKind::Publish | EventKind::Take | EventKind::Receive => {
                format!("{a},{},{c:016x},,,,", b.cast_signed())
            }
            EventKind::Pass => {
                let publisher = known.map_or(0, |known| tautline_trace::gid_key(known.gid));
                format!("{a},,{publisher:016x},,,{b},{c:016x}")
            }
            EventKind::CallbackStart => format!(",,,{a},,,"),
            EventKind::SpinStart if a != u64::MAX => format!(",,,,{a},,"),
            _ => ",,,,,,".to_owned(),
        };
        writeln!(
            to,
            "{time_ns},{pid},{},{},{thread},{},{},{label},{parent},{more}",
            quoted(name),
            timed.tid,
            kind.name(),
            object.0
        )?;
    }
    for (process, object) in made {
        write_made(recording, process, object, to)?;
    }
    Ok(())
}

fn write_made(recording: &Recording, of: u32, object: &Description, to: &mut dyn Write) -> io::Result<()> {
    let (pid, name) = recording.program(of);
    let publisher = match tautline_trace::gid_key(object.gid) {
        0 => String::new(),
        key => format!("{key:016x}"),
    };
    let (time_ns, kind, id, parent) = (object.created_ns, object.kind.name(), object.id.0, object.parent.0);
    writeln!(
        to,
        "{time_ns},{pid},{},,,{kind}_init,{id},{},{parent},,,{publisher},,,,",
        quoted(name),
        quoted(&object.name)
    )
}

/// A cell of CSV, in quotes if it needs them.
pub fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_needs_it_is_quoted() {
        assert_eq!(quoted("/imu"), "/imu");
        assert_eq!(quoted("a,\"b\""), "\"a,\"\"b\"\"\"");
    }
}
