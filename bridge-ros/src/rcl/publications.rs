// SPDX-License-Identifier: MIT OR Apache-2.0
//! Identifies the publisher of a message with Cyclone DDS, whose messages have an instance handle of this process where ROS's graph has
//! GIDs. Its list of publications, a built-in topic of every participant, has both.

use super::error::RclError;
use libloading::Library;
use std::collections::HashMap;
use std::ffi::{c_char, c_void};
use std::path::Path;
use std::time::{Duration, Instant};
use tautline_transport::Gid;

/// The RMW that needs this.
pub(crate) const RMW: &str = "rmw_cyclonedds_cpp";
/// The library that links its DDS, in every version.
const LIBRARY: &str = "librmw_cyclonedds_cpp.so";

/// `dds_entity_t`.
type Entity = i32;
/// `DDS_BUILTIN_TOPIC_DCPSPUBLICATION`, and its name.
const PUBLICATIONS: Entity = 0x7fff_0003;
const TOPIC: &[u8] = b"DCPSPublication\0";
/// `DDS_ALIVE_INSTANCE_STATE`.
const ALIVE: u32 = 16;

/// `dds_sample_info_t`, of Cyclone DDS 0.9 to 11.
#[repr(C)]
#[derive(Clone, Copy, Default)]
struct SampleInfo {
    sample_state: u32,
    view_state: u32,
    instance_state: u32,
    valid_data: bool,
    source_timestamp: i64,
    instance_handle: u64,
    publication_handle: u64,
    disposed_generation_count: u32,
    no_writers_generation_count: u32,
    sample_rank: u32,
    generation_rank: u32,
    absolute_generation_rank: u32,
}

/// The functions of Cyclone DDS that are used.
struct Dds {
    create_participant: unsafe extern "C" fn(u32, *const c_void, *const c_void) -> Entity,
    create_reader: unsafe extern "C" fn(Entity, Entity, *const c_void, *const c_void) -> Entity,
    get_topic: unsafe extern "C" fn(Entity) -> Entity,
    get_name: unsafe extern "C" fn(Entity, *mut c_char, usize) -> i32,
    take: unsafe extern "C" fn(Entity, *mut *mut c_void, *mut SampleInfo, usize, u32) -> i32,
    return_loan: unsafe extern "C" fn(Entity, *mut *mut c_void, i32) -> i32,
    delete: unsafe extern "C" fn(Entity) -> i32,
    _library: Library,
}

impl Dds {
    fn load(library: &Path) -> Result<Self, libloading::Error> {
        // SAFETY: rcl has already loaded it. dds.h has these signatures in all versions since 0.9.
        unsafe {
            let library = Library::new(library)?;
            Ok(Dds {
                create_participant: *library.get(b"dds_create_participant\0")?,
                create_reader: *library.get(b"dds_create_reader\0")?,
                get_topic: *library.get(b"dds_get_topic\0")?,
                get_name: *library.get(b"dds_get_name\0")?,
                take: *library.get(b"dds_take\0")?,
                return_loan: *library.get(b"dds_return_loan\0")?,
                delete: *library.get(b"dds_delete\0")?,
                _library: library,
            })
        }
    }
}

/// How long an ended publisher is remembered: its last messages may be taken later.
const GONE_TIME: Duration = Duration::from_secs(60);
/// Changes of the list taken at once.
const TURN: usize = 64;

/// The list of publications of a domain.
pub(super) struct Publications {
    dds: Dds,
    participant: Entity,
    reader: Entity,
    /// By handle, with the time when its end was seen.
    known: HashMap<u64, (Gid, Option<Instant>)>,
}

impl Publications {
    /// The list of `domain`, in which the RMW already has a participant and has configured DDS.
    pub(super) fn new(domain: u32) -> Result<Self, RclError> {
        Self::of(domain, Path::new(LIBRARY))
    }

    fn of(domain: u32, library: &Path) -> Result<Self, RclError> {
        let error =
            |code, reason| RclError { what: "reading Cyclone DDS's list of publications", code, reason };
        let dds = Dds::load(library).map_err(|reason| error(0, reason.to_string()))?;
        let none = std::ptr::null();
        // SAFETY: DDS's protocol; null means default QoS and no listener. The name is written into the array, and fits.
        let (participant, reader, name) = unsafe {
            let participant = (dds.create_participant)(domain, none, none);
            let reader = (dds.create_reader)(participant, PUBLICATIONS, none, none);
            let mut name = [0; TOPIC.len()];
            (dds.get_name)((dds.get_topic)(reader), name.as_mut_ptr(), name.len());
            (participant, reader, name.map(|char| char as u8))
        };
        let publications = Publications { dds, participant, reader, known: HashMap::new() };
        match (reader, name == TOPIC) {
            (..0, _) => Err(error(reader, "Cyclone DDS returned no reader".to_owned())),
            (_, false) => Err(error(0, "unknown topic number: use Cyclone DDS 0.9 to 11".to_owned())),
            (_, true) => Ok(publications),
        }
    }

    /// The GID of a message's publisher; the default GID, which no publisher has, for an unknown handle.
    ///
    /// # Real-time
    /// A look-up. Before the first message of a publisher: O(changes of the list), and allocates.
    pub(super) fn gid(&mut self, handle: u64) -> Gid {
        while !self.known.contains_key(&handle) && self.read() == TURN {}
        self.known.get(&handle).map(|(gid, _)| *gid).unwrap_or_default()
    }

    /// Reads all changes, and forgets publishers that ended long ago.
    pub(super) fn refresh(&mut self) {
        while self.read() == TURN {}
        self.known.retain(|_, (_, gone)| gone.is_none_or(|since| since.elapsed() < GONE_TIME));
    }

    /// Takes at most one turn of changes. Returns their number.
    fn read(&mut self) -> usize {
        let mut samples = [std::ptr::null_mut::<c_void>(); TURN];
        let mut infos = [SampleInfo::default(); TURN];
        // SAFETY: both arrays have this length; with null pointers DDS lends the samples until they are returned below.
        let lent = unsafe {
            (self.dds.take)(self.reader, samples.as_mut_ptr(), infos.as_mut_ptr(), TURN, TURN as u32)
        };
        // An error is negative.
        let count = usize::try_from(lent).unwrap_or(0);
        for (sample, info) in samples.iter().zip(&infos).take(count) {
            // SAFETY: `dds_builtintopic_endpoint_t` begins with the GID, which is set even if nothing else is valid.
            let gid = Gid(unsafe { sample.cast::<[u8; 16]>().read_unaligned() });
            let gone = (info.instance_state != ALIVE).then(Instant::now);
            self.known.insert(info.instance_handle, (gid, gone));
        }
        if count > 0 {
            // SAFETY: returns the loan.
            unsafe { (self.dds.return_loan)(self.reader, samples.as_mut_ptr(), lent) };
        }
        count
    }
}

impl Drop for Publications {
    fn drop(&mut self) {
        // SAFETY: its own participant, with the reader; an invalid one is an error.
        unsafe { (self.dds.delete)(self.participant) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::ffi::{CStr, CString};
    use std::io::{BufRead, BufReader};
    use std::process::{Command, Stdio};

    const DOMAIN: u32 = 77;
    /// On this host only.
    const CONFIG: &CStr = c"<General><AllowMulticast>false</AllowMulticast><Interfaces><NetworkInterface name='lo'/></Interfaces></General>\
        <Discovery><LeaseDuration>1s</LeaseDuration><ParticipantIndex>auto</ParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers></Discovery>";
    const WRITER: &str = "
import dataclasses, sys
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
@dataclasses.dataclass
class Text(IdlStruct):
    text: str
participant = DomainParticipant(int(sys.argv[1]))
writer = DataWriter(participant, Topic(participant, 'text', Text))
print(writer.guid.hex, flush=True)
sys.stdin.read()
";

    fn until(
        publications: &mut Publications,
        gid: Gid,
        is_so: impl Fn(Option<&(Gid, Option<Instant>)>) -> bool,
    ) {
        let end = Instant::now() + Duration::from_secs(60);
        loop {
            publications.refresh();
            if is_so(publications.known.values().find(|(known, _)| *known == gid)) {
                return;
            }
            assert!(Instant::now() < end, "{gid:?} in {:?}", publications.known);
            std::thread::yield_now();
        }
    }

    /// With the Cyclone DDS of a Python package, because PyPI has no RMW for it.
    #[test]
    fn a_writer_of_another_process_is_listed_until_after_its_end() {
        let target = std::env::var_os("CARGO_TARGET_DIR")
            .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../target"), Into::into);
        let venv = target.join("ros/venv");
        let python = venv.join("bin/python");
        let folders = std::fs::read_dir(venv.join("lib")).into_iter().flatten().flatten();
        // Of whatever version its Python is.
        let mut libraries =
            folders.map(|entry| entry.path().join("site-packages/cyclonedds/.libs/libddsc.so"));
        let Some(library) = libraries.find(|library| library.is_file()) else {
            let missing = format!("no Cyclone DDS in {}: run `cargo xtask ros`", venv.display());
            assert!(std::env::var_os("CI").is_none(), "CI: {missing}");
            return eprintln!("skipped: {missing}");
        };
        // SAFETY: DDS's own function, of this signature; the text lives through the call, and the library for ever.
        unsafe {
            let library = Library::new(&library).unwrap();
            let create_domain: libloading::Symbol<unsafe extern "C" fn(u32, *const c_char) -> Entity> =
                library.get(b"dds_create_domain\0").unwrap();
            assert!(create_domain(DOMAIN, CONFIG.as_ptr()) > 0);
            std::mem::forget(library);
        }
        let mut publications = Publications::of(DOMAIN, &library).unwrap();
        let mut writer = Command::new(python)
            .args(["-c", WRITER, &DOMAIN.to_string()])
            .env("CYCLONEDDS_URI", CString::from(CONFIG).into_string().unwrap())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut said = String::new();
        BufReader::new(writer.stdout.take().unwrap()).read_line(&mut said).unwrap();
        let gid = Gid(u128::from_str_radix(said.trim(), 16).expect(&said).to_be_bytes());
        until(&mut publications, gid, |found| matches!(found, Some((_, None))));
        let handle = *publications.known.iter().find(|(_, (known, _))| *known == gid).unwrap().0;
        drop(writer.stdin.take());
        assert!(writer.wait().unwrap().success());
        until(&mut publications, gid, |found| matches!(found, Some((_, Some(_)))));
        assert_eq!(publications.gid(handle), gid);
        assert_eq!(publications.gid(handle + 1_000_000), Gid::default());
    }
}
