// SPDX-License-Identifier: MIT OR Apache-2.0
//! The file system that a guest starts with: an archive in the format that the kernel reads (cpio, newc).

use crate::debian::Architecture;
use crate::files;
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::process::Command;

/// From the packages of a system: tools and libraries.
const FILES: [&str; 6] =
    ["bin/busybox", "bin/flock", "bin/unshare", "lib/libc.so.6", "lib/libm.so.6", "lib/libgcc_s.so.1"];

/// Such an archive while it is written.
pub struct Image {
    out: BufWriter<File>,
    entries: u32,
    folders: BTreeSet<PathBuf>,
    /// A program, and where it puts what it has made.
    strip: String,
    stripped: PathBuf,
}

impl Image {
    /// With the first process and what programs need.
    pub fn new(path: &Path, system: &Path, architecture: Architecture) -> io::Result<Image> {
        let (out, stripped) = (BufWriter::new(File::create(path)?), path.with_extension("stripped"));
        let strip = architecture.tool("strip");
        let mut image = Image { out, entries: 0, folders: BTreeSet::new(), strip, stripped };
        image.file("init", include_bytes!("init.sh"))?;
        for file in FILES.into_iter().chain([architecture.loader()]) {
            image.file(file, &fs::read(find(system, file)?)?)?;
        }
        Ok(image)
    }

    /// A file, and the folders that it is in.
    pub fn file(&mut self, name: &str, content: &[u8]) -> io::Result<()> {
        let above: Vec<_> =
            Path::new(name).ancestors().skip(1).filter(|path| path.parent().is_some()).collect();
        for folder in above.into_iter().rev() {
            if self.folders.insert(folder.to_owned()) {
                self.entry(&folder.display().to_string(), 0o040_755, &[])?;
            }
        }
        self.entry(name, 0o100_755, content)
    }

    /// A program, without its symbols.
    pub fn program(&mut self, name: &str, from: &Path) -> io::Result<()> {
        let status = Command::new(&self.strip).arg("-o").arg(&self.stripped).arg(from).status()?;
        if !status.success() {
            return Err(io::Error::other(format!("{} {}: {status}", self.strip, from.display())));
        }
        let content = fs::read(&self.stripped)?;
        self.file(name, &content)
    }

    pub fn finish(mut self) -> io::Result<()> {
        self.entry("TRAILER!!!", 0, &[])?;
        let _ = fs::remove_file(&self.stripped);
        self.out.flush()
    }

    fn entry(&mut self, name: &str, mode: u32, content: &[u8]) -> io::Result<()> {
        self.entries += 1;
        let len = |bytes: usize| u32::try_from(bytes).map_err(io::Error::other);
        // Number, mode, user, group, links, time, length, devices, length of the name with its zero, checksum.
        let fields =
            [self.entries, mode, 0, 0, 1, 0, len(content.len())?, 0, 0, 0, 0, len(name.len() + 1)?, 0];
        let head = fields.map(|field| format!("{field:08x}")).concat();
        for part in [format!("070701{head}{name}\0").as_bytes(), content] {
            self.out.write_all(part)?;
            self.out.write_all(&[0; 3][..part.len().next_multiple_of(4) - part.len()])?;
        }
        Ok(())
    }
}

/// The kernel of a system.
pub fn kernel(system: &Path) -> Result<PathBuf, String> {
    let boot = system.join("boot");
    let names = fs::read_dir(&boot).map_err(files::at(&boot))?;
    let mut kernels =
        names.flatten().filter(|file| file.file_name().to_string_lossy().starts_with("vmlinuz"));
    kernels.next().map(|kernel| kernel.path()).ok_or_else(|| format!("{} has no kernel", boot.display()))
}

/// The file of a system with the same name as this one, wherever its Debian puts it.
fn find(system: &Path, file: &str) -> io::Result<PathBuf> {
    let name = Path::new(file).file_name();
    // No link to what is in another package.
    let found = files::below(system)?.into_iter().find(|path| path.file_name() == name && path.is_file());
    found.ok_or_else(|| io::Error::other(format!("{} has no {file}", system.display())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_begin_at_multiples_of_four_and_folders_come_before_their_files() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("image");
        let (out, stripped) = (BufWriter::new(File::create(&path).unwrap()), folder.path().join("none"));
        let mut image = Image { out, entries: 0, folders: BTreeSet::new(), strip: String::new(), stripped };
        image.file("a/b/c", b"12345").unwrap();
        image.file("a/b/d", b"").unwrap();
        image.finish().unwrap();
        let archive = fs::read(path).unwrap();
        let (mut at, mut names) = (0, Vec::new());
        while at < archive.len() {
            assert_eq!(&archive[at..at + 6], b"070701");
            let field = |index: usize| {
                let digits = std::str::from_utf8(&archive[at + 6 + 8 * index..][..8]).unwrap();
                usize::from_str_radix(digits, 16).unwrap()
            };
            let (mode, len, name_len) = (field(1), field(6), field(11));
            let name = String::from_utf8_lossy(&archive[at + 110..][..name_len - 1]).into_owned();
            names.push(format!("{name} {mode:o} {len}"));
            at = (at + 110 + name_len).next_multiple_of(4) + len.next_multiple_of(4);
        }
        assert_eq!(names, ["a 40755 0", "a/b 40755 0", "a/b/c 100755 5", "a/b/d 100755 0", "TRAILER!!! 0 0"]);
    }
}
