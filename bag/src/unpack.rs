// SPDX-License-Identifier: MIT OR Apache-2.0
//! Decompresses zstd data, and no more than the disk has room for.

use crate::parts::opened;
use crate::{BagError, MOST_BYTES};
use rustix::fs::statvfs;
use std::fs::File;
use std::io::{self, BufReader, Read, Write};
use std::path::Path;

/// The maximum ratio of compression. Recordings do not reach it; data that were made to fill a disk do.
const MOST_RATIO: u64 = 1000;
/// Below this number of bytes, nothing is refused.
const HARMLESS: u64 = 256 << 20;
/// The space on the disk that is left to others.
const RESERVE: u64 = 64 << 20;
/// The number of bytes between two checks of the free space.
const STEP: usize = 1 << 20;

/// Limits how many bytes are decompressed, by the number of compressed ones.
#[derive(Default)]
pub struct Allowance {
    packed: u64,
    unpacked: u64,
}

impl Allowance {
    /// # Errors
    /// They are too many.
    fn take(&mut self, path: &Path, unpacked: u64) -> Result<(), BagError> {
        self.unpacked += unpacked;
        if self.unpacked <= HARMLESS.max(self.packed.saturating_mul(MOST_RATIO)) {
            return Ok(());
        }
        let reason = format!(
            "what is compressed in it becomes more than {MOST_RATIO} times as long, to fill a disk; if that is as it should be, unpack it \
             with `zstd -d`"
        );
        Err(BagError::no_bag(path, reason))
    }

    /// Decompresses a message of a bag into `unpacked`.
    ///
    /// # Errors
    /// It is not what zstd wrote, or too long.
    pub fn message(&mut self, path: &Path, packed: &[u8], unpacked: &mut Vec<u8>) -> Result<(), BagError> {
        unpacked.clear();
        let result = zstd::Decoder::with_buffer(packed)
            .and_then(|decoder| decoder.take(MOST_BYTES as u64 + 1).read_to_end(unpacked));
        let fail = |error| BagError::no_bag(path, format!("a message cannot be decompressed: {error}"));
        result.map_err(fail)?;
        if unpacked.len() > MOST_BYTES {
            let reason = format!("a message is longer than {MOST_BYTES} bytes when it is decompressed");
            return Err(BagError::no_bag(path, reason));
        }
        self.packed += packed.len() as u64;
        self.take(path, unpacked.len() as u64)
    }
}

/// Decompresses the file `from` into the new file `to`; `go_on` is called from time to time, and stops it with `false`.
///
/// # Errors
/// It cannot be read or written, is not what zstd wrote, or too long for the disk.
pub fn unpack_file(from: &Path, to: &Path, go_on: &mut dyn FnMut() -> bool) -> Result<(), BagError> {
    let (file, packed) = opened(from)?;
    let mut allowance = Allowance { packed, unpacked: 0 };
    let mut file = BufReader::with_capacity(STEP, file);
    let no_bag = |error: io::Error| BagError::no_bag(from, format!("it cannot be decompressed: {error}"));
    let mut decoder = zstd::Decoder::with_buffer(&mut file).map_err(no_bag)?;
    let mut out = File::options().write(true).create_new(true).open(to).map_err(BagError::write(to))?;
    let mut step = vec![0; STEP];
    loop {
        let mut filled = 0;
        while filled < STEP {
            match decoder.read(&mut step[filled..]) {
                Ok(0) => break,
                Ok(read) => filled += read,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(no_bag(error)),
            }
        }
        if filled == 0 {
            return Ok(());
        }
        if !go_on() {
            return Err(BagError::Interrupted);
        }
        allowance.take(from, filled as u64)?;
        room(to, filled as u64)?;
        out.write_all(&step[..filled]).map_err(BagError::write(to))?;
    }
}

/// Checks that the disk of `path` has room for this number of bytes, and for others.
///
/// # Errors
/// [`BagError::NoRoom`].
pub fn room(path: &Path, bytes: u64) -> Result<(), BagError> {
    let folder = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let disk = statvfs(folder).map_err(|error| BagError::write(path)(error.into()))?;
    let free = disk.f_bavail.saturating_mul(disk.f_frsize);
    // File systems that do not know their size report no blocks at all.
    if disk.f_blocks > 0 && free < bytes + RESERVE {
        return Err(BagError::NoRoom { path: folder.to_owned(), bytes });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_made_to_fill_a_disk_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let [from, to] = ["bomb.db3.zstd", "bomb.db3"].map(|name| folder.path().join(name));
        let mut encoder = zstd::Encoder::new(File::create(&from).unwrap(), 1).unwrap();
        io::copy(&mut io::repeat(0).take(HARMLESS + (1 << 20)), &mut encoder).unwrap();
        encoder.finish().unwrap();
        let error = unpack_file(&from, &to, &mut || true).unwrap_err();
        assert!(error.to_string().contains("more than 1000 times as long"), "{error}");
        assert!(to.metadata().unwrap().len() <= HARMLESS);
        assert!(matches!(
            unpack_file(&from, &to.with_extension("x"), &mut || false),
            Err(BagError::Interrupted)
        ));
    }

    #[test]
    fn messages_are_bounded_together() {
        let (path, mut unpacked) = (Path::new("bag"), Vec::new());
        let packed = zstd::encode_all(&*vec![0; 100 << 20], 1).unwrap();
        let mut allowance = Allowance::default();
        for _ in 0..2 {
            allowance.message(path, &packed, &mut unpacked).unwrap();
            assert_eq!(unpacked.len(), 100 << 20);
        }
        assert!(allowance.message(path, &packed, &mut unpacked).is_err());
        let error = allowance.message(path, b"no frame", &mut unpacked).unwrap_err();
        assert!(error.to_string().contains("a message cannot be decompressed"), "{error}");
    }
}
