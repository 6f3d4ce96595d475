// SPDX-License-Identifier: MIT OR Apache-2.0
//! Files of bags.

use rustix::fs::{MemfdFlags, memfd_create};
use std::fs::File;
use std::os::fd::AsRawFd;
use std::os::unix::fs::FileExt;
use std::path::PathBuf;
use std::sync::LazyLock;
use tautline_bag::{BagError, Event, FileReader, Ordered, index_of};

/// A file in memory, and where it can be opened.
static FILE: LazyLock<(File, PathBuf)> = LazyLock::new(|| {
    let file = File::from(memfd_create("bag", MemfdFlags::CLOEXEC).expect("a file in memory"));
    let path = format!("/proc/self/fd/{}", file.as_raw_fd()).into();
    (file, path)
});

/// A file is read to its end, whatever is in it; what it says is in it is what was read, and reading it again finds the same.
pub fn bag(input: &[u8]) {
    let (file, path) = &*FILE;
    file.set_len(0).expect("it is ours");
    file.write_all_at(input, 0).expect("there is memory");
    let _ = index_of(path).expect("damage is no error");
    let Ok(mut reader) = FileReader::open(path) else { return };
    let (mut messages, mut bytes) = (0, 0);
    let mut ordered = Ordered::open(path, &mut |_| {}).expect("it was a file before");
    while let Some(message) = ordered.next_message().expect("damage is no error") {
        assert!(message.topic < ordered.topics().len());
    }
    let read = reader.read(&mut |event| {
        if let Event::Message(message) = event {
            (messages, bytes) = (messages + 1, bytes + message.cdr.len());
        }
        Ok::<_, BagError>(())
    });
    read.expect("damage is no error");
    let summary = reader.summary();
    assert_eq!((summary.messages, summary.bytes), (messages, input.len() as u64));
    assert_eq!(summary.topics.values().map(|(_, count)| count).sum::<u64>(), messages);
    let mut again = FileReader::open(path).expect("it was one before");
    again.read(&mut |_| Ok::<_, BagError>(())).expect("damage is no error");
    assert_eq!((again.summary(), again.damage()), (summary, reader.damage()));
}
