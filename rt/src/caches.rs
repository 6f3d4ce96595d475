// SPDX-License-Identifier: MIT OR Apache-2.0
//! The sizes of the processor's caches, and copies that go around them.

use crate::host;
use std::fs;
use std::path::Path;
use std::sync::OnceLock;

/// The sizes of the caches on the way of a buffer from one core to another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Caches {
    /// The second level, which is a core's own on most processors.
    pub l2_bytes: usize,
    /// The third level; 0 if there is none.
    pub l3_bytes: usize,
}

/// The sizes assumed on machines whose kernel does not describe the caches.
const UNKNOWN: Caches = Caches { l2_bytes: 512 << 10, l3_bytes: 8 << 20 };

/// [`copy_to_shared`] copies this length and more in one instruction.
const LONG_BYTES: usize = 256 << 10;

impl Caches {
    /// The largest of the first and the last core, as the kernel describes them, or 512 KiB and 8 MiB if it does not. Read once.
    pub fn of_machine() -> Caches {
        static CACHES: OnceLock<Caches> = OnceLock::new();
        *CACHES.get_or_init(|| Caches::read(Path::new("/sys/devices/system/cpu")).unwrap_or(UNKNOWN))
    }

    fn read(folder: &Path) -> Option<Caches> {
        let cores = host::online_cores().unwrap_or_default();
        let read = |core: usize| {
            let cache = |index: usize| {
                let read = |name| {
                    fs::read_to_string(folder.join(format!("cpu{core}/cache/index{index}/{name}"))).ok()
                };
                Some((read("level")?.trim().parse::<u32>().ok()?, bytes(read("size")?.trim())?))
            };
            (0..).map_while(cache).collect::<Vec<_>>()
        };
        let caches: Vec<_> =
            [cores.iter().next(), cores.iter().last()].into_iter().flatten().flat_map(read).collect();
        let of_level = |level| caches.iter().filter(|cache| cache.0 == level).map(|cache| cache.1).max();
        Some(Caches { l2_bytes: of_level(2)?, l3_bytes: of_level(3).unwrap_or(0) })
    }
}

/// Parses a size as the kernel writes it: `1024K`.
fn bytes(text: &str) -> Option<usize> {
    let (number, unit) = match text.strip_suffix(['K', 'M', 'G']) {
        Some(number) => (number, 10 * (1 + "KMG".find(&text[number.len()..])?)),
        None => (text, 0),
    };
    number.parse::<usize>().ok()?.checked_shl(unit as u32)
}

/// Copies into memory that another core has read and will read, such as a sample.
///
/// From 256 KiB with `rep movsb`, where the processor says that this is fast: it does not read what it overwrites. On some processors the C
/// library's copy does, from the size of the second-level cache on, and then fetches each line from the cache of the core that read it.
///
/// # Real-time
/// Wait-free; no allocation; no syscall.
///
/// # Panics
/// If the lengths differ.
pub fn copy_to_shared(to: &mut [u8], from: &[u8]) {
    #[cfg(target_arch = "x86_64")]
    if from.len() >= LONG_BYTES && std::arch::is_x86_feature_detected!("ermsb") {
        assert_eq!(to.len(), from.len(), "what is copied fits");
        // SAFETY: both are that long, and do not overlap, for one of them is `&mut`; the direction flag is clear, as everywhere.
        unsafe {
            std::arch::asm!(
                "rep movsb",
                inout("rcx") from.len() => _, inout("rdi") to.as_mut_ptr() => _, inout("rsi") from.as_ptr() => _,
                options(nostack, preserves_flags)
            );
        }
        return;
    }
    to.copy_from_slice(from);
}

/// A prefetch instruction: of x86-64 and of aarch64.
macro_rules! prefetch {
    ($address:expr, $x86_64:literal, $aarch64:literal) => {
        // SAFETY: a hint, which faults at no address. Processors that do not know it do nothing.
        #[cfg(all(any(target_arch = "x86_64", target_arch = "aarch64"), not(miri)))]
        unsafe {
            #[cfg(target_arch = "x86_64")]
            std::arch::asm!(concat!($x86_64, " [{}]"), in(reg) $address.as_ptr(), options(nostack, preserves_flags, readonly));
            #[cfg(target_arch = "aarch64")]
            std::arch::asm!(concat!("prfm ", $aarch64, ", [{}]"), in(reg) $address.as_ptr(), options(nostack, preserves_flags, readonly));
        }
        #[cfg(any(miri, not(any(target_arch = "x86_64", target_arch = "aarch64"))))]
        let _ = $address;
    };
}

/// Has the cache fetch the line at an address from the core that read it, to be written soon. Nothing is read or written.
///
/// # Real-time
/// Wait-free; no syscall; at most one instruction, which waits for nothing.
#[inline(always)]
pub fn fetch_to_write(address: std::ptr::NonNull<u8>) {
    prefetch!(address, "prefetchw", "pstl1keep");
}

/// Like [`fetch_to_write`], to be read soon.
///
/// # Real-time
/// Wait-free; no syscall; at most one instruction, which waits for nothing.
#[inline(always)]
pub fn fetch_to_read(address: std::ptr::NonNull<u8>) {
    prefetch!(address, "prefetcht0", "pldl1keep");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_as_the_kernel_writes_them() {
        let folder = std::env::temp_dir().join(format!("taut_caches_{}", std::process::id()));
        let core = host::online_cores().unwrap().iter().next().unwrap();
        assert_eq!(Caches::read(&folder), None);
        for (index, level, size) in [(0, "1", "48K"), (1, "1", "32K"), (2, "2", "1024K"), (3, "3", "32M")] {
            let cache = folder.join(format!("cpu{core}/cache/index{index}"));
            fs::create_dir_all(&cache).unwrap();
            fs::write(cache.join("level"), format!("{level}\n")).unwrap();
            fs::write(cache.join("size"), format!("{size}\n")).unwrap();
        }
        assert_eq!(Caches::read(&folder), Some(Caches { l2_bytes: 1 << 20, l3_bytes: 32 << 20 }));
        fs::remove_dir_all(folder.join(format!("cpu{core}/cache/index3"))).unwrap();
        assert_eq!(Caches::read(&folder), Some(Caches { l2_bytes: 1 << 20, l3_bytes: 0 }));
        fs::remove_dir_all(&folder).unwrap();
        for text in ["", "K", "x", "-1K", "99999999999999999999K"] {
            assert_eq!(bytes(text), None, "{text}");
        }
    }

    #[test]
    fn copies_of_any_length_are_whole() {
        for len in [0, 1, 63, 4096, LONG_BYTES - 1, LONG_BYTES, LONG_BYTES + 5] {
            let from: Vec<u8> = (0..len + 3).map(|n| (n % 251) as u8).collect();
            let mut to = vec![0; len + 3];
            copy_to_shared(&mut to[1..=len], &from[2..len + 2]);
            assert_eq!(to[1..=len], from[2..len + 2]);
            assert_eq!([to[0], to[len + 1], to[len + 2]], [0; 3], "{len}: nothing beside it");
        }
    }
}
