// SPDX-License-Identifier: MIT OR Apache-2.0
//! The build stamp of a library: plain bytes at the start of its only symbol, read from the file before any of its code runs.

use crate::error::ComponentError;
use object::{Object, ObjectSegment, ObjectSymbol};
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

/// The name of the symbol that a library of components exports.
pub(crate) const SYMBOL: &str = "TAUTLINE_COMPONENTS";
/// Maximum length of a file that is read.
const MAX_BYTES: u64 = 1 << 30;
/// Length of the stamp in bytes.
pub const STAMP_BYTES: usize = 256;

const TEXT: &str = concat!(
    "tautline component 1\n",
    env!("TAUTLINE_RUSTC"),
    "\n",
    "Tautline ",
    env!("CARGO_PKG_VERSION"),
    "\n",
    env!("TAUTLINE_TARGET"),
    "\n"
);

/// The stamp of this build of Tautline, and of components built with it.
pub const STAMP: [u8; STAMP_BYTES] = padded(TEXT.as_bytes());

const fn padded(text: &[u8]) -> [u8; STAMP_BYTES] {
    let mut stamp = [0; STAMP_BYTES];
    let mut at = 0;
    // A text that is too long does not compile.
    while at < text.len() {
        stamp[at] = text[at];
        at += 1;
    }
    stamp
}

/// Reads the stamp of the library in the file `path` and compares it with this process's. Nothing in the library runs.
pub(crate) fn check(path: &Path) -> Result<(), ComponentError> {
    let unreadable = |source| ComponentError::Read { path: path.into(), source };
    let refuse = |reason: &str| ComponentError::NoLibrary { path: path.into(), reason: reason.into() };
    // Checked before it is opened: a FIFO would wait for a writer, a device may have no end.
    if !path.metadata().map_err(unreadable)?.is_file() {
        return Err(refuse("it is not a regular file"));
    }
    match read(path).map_err(unreadable)? {
        Some(bytes) => check_bytes(path, &bytes),
        None => Err(refuse("it is longer than 1 GiB, the most that is read")),
    }
}

/// Reads a file; `None` if it is longer than a library may be.
fn read(path: &Path) -> io::Result<Option<Vec<u8>>> {
    let file = File::open(path)?;
    if file.metadata()?.len() > MAX_BYTES {
        return Ok(None);
    }
    let mut bytes = Vec::new();
    // The file may grow meanwhile.
    file.take(MAX_BYTES + 1).read_to_end(&mut bytes)?;
    Ok((bytes.len() as u64 <= MAX_BYTES).then_some(bytes))
}

fn check_bytes(path: &Path, bytes: &[u8]) -> Result<(), ComponentError> {
    let refuse = |reason: String| ComponentError::NoLibrary { path: path.into(), reason };
    let file = object::File::parse(bytes).map_err(|error| refuse(error.to_string()))?;
    let symbol = file.dynamic_symbols().find(|symbol| symbol.is_definition() && symbol.name() == Ok(SYMBOL));
    let Some(symbol) = symbol else { return Err(ComponentError::NoEntryPoint { path: path.into() }) };
    let stamp = file
        .segments()
        .find_map(|segment| segment.data_range(symbol.address(), STAMP_BYTES as u64).ok().flatten())
        .ok_or_else(|| refuse(format!("the bytes of its symbol {SYMBOL} are not in the file")))?;
    if stamp == STAMP {
        return Ok(());
    }
    let (found, own) = (describe(stamp), describe(&STAMP));
    Err(ComponentError::OtherBuild { path: path.into(), found, own })
}

/// The lines of a stamp after the first. The bytes come from another build.
fn describe(stamp: &[u8]) -> String {
    let text = String::from_utf8_lossy(stamp);
    let lines: Vec<_> = text.trim_end_matches('\0').lines().collect();
    match lines.as_slice() {
        ["tautline component 1", rest @ ..] if !rest.is_empty() => rest.join(", ").escape_debug().to_string(),
        _ => "something that is no stamp of this version".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stamp_names_compiler_version_and_target() {
        let text = describe(&STAMP);
        assert!(text.starts_with("rustc ") && text.contains("Tautline 0."), "{text}");
        assert_eq!(describe(&[0; STAMP_BYTES]), "something that is no stamp of this version");
        assert_eq!(describe(&[255; 3]), "something that is no stamp of this version");
    }

    #[test]
    fn what_has_no_end_is_not_read() {
        let folder = std::env::temp_dir();
        let long = folder.join(format!("tautline_long_library_{}", std::process::id()));
        let fifo = folder.join(format!("tautline_fifo_{}", std::process::id()));
        // Without a block on the disk.
        File::create(&long).unwrap().set_len(MAX_BYTES + 1).unwrap();
        assert!(std::process::Command::new("mkfifo").arg(&fifo).status().unwrap().success());
        let errors =
            [&long, &fifo, Path::new("/dev/zero"), &folder].map(|path| check(path).unwrap_err().to_string());
        for path in [&long, &fifo] {
            std::fs::remove_file(path).unwrap();
        }
        assert!(errors[0].contains("longer than 1 GiB"), "{}", errors[0]);
        assert!(errors[1..].iter().all(|error| error.contains("not a regular file")), "{errors:?}");
    }

    #[test]
    fn what_is_no_library_of_components_is_refused() {
        let path = Path::new("libx.so");
        let error = |bytes: &[u8]| check_bytes(path, bytes).unwrap_err().to_string();
        assert!(error(b"no ELF").contains("libx.so is not a shared library"), "{}", error(b"no ELF"));
        assert!(error(&[]).contains("libx.so is not a shared library"));
        // This program is ELF, and no component.
        let own = std::fs::read("/proc/self/exe").unwrap();
        assert!(error(&own).contains("no entry point"), "{}", error(&own));
        for end in [4, 16, 64, 1000, own.len() / 2] {
            assert!(check_bytes(path, &own[..end]).is_err());
        }
    }
}
