// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whose a message is, as Cyclone DDS tells it: by an instance handle of this process, where ROS's graph has identifiers. Both are in
//! its list of publications, a topic that every participant has.

use super::error::RclError;
use libloading::Library;
use std::collections::HashMap;
use std::ffi::{c_char, c_void};
use std::path::Path;
use std::time::{Duration, Instant};
use tautline_transport::Gid;

/// The RMW whose messages are told apart so.
pub(crate) const RMW: &str = "rmw_cyclonedds_cpp";
/// Through which its DDS is found, whatever version of it.
const LIBRARY: &str = "librmw_cyclonedds_cpp.so";

/// `dds_entity_t`.
type Entity = i32;
/// `DDS_BUILTIN_TOPIC_DCPSPUBLICATION`, and what it is called.
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

/// What is used of Cyclone DDS.
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
        // SAFETY: rcl has it loaded already. The functions are those of dds.h, of these signatures in all versions since 0.9.
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

/// How long a publisher that has gone is known: its last messages may be taken after that.
const GONE_TIME: Duration = Duration::from_secs(60);
/// Changes of the list that are taken at once.
const TURN: usize = 64;

/// The list of publications of a domain.
pub(super) struct Publications {
    dds: Dds,
    participant: Entity,
    reader: Entity,
    /// By handle, each with when it was seen that it has gone.
    known: HashMap<u64, (Gid, Option<Instant>)>,
}

impl Publications {
    /// Of `domain`, in which the RMW has a participant already: it knows best how the domain is configured.
    pub(super) fn new(domain: u32) -> Result<Self, RclError> {
        Self::of(domain, Path::new(LIBRARY))
    }

    fn of(domain: u32, library: &Path) -> Result<Self, RclError> {
        let error =
            |code, reason| RclError { what: "reading Cyclone DDS's list of publications", code, reason };
        let dds = Dds::load(library).map_err(|reason| error(0, reason.to_string()))?;
        let none = std::ptr::null();
        // SAFETY: DDS's protocol; no QoS and no listener are the default. The name is written into the array, and ends there.
        let (participant, reader, name) = unsafe {
            let participant = (dds.create_participant)(domain, none, none);
            let reader = (dds.create_reader)(participant, PUBLICATIONS, none, none);
            let mut name = [0; TOPIC.len()];
            (dds.get_name)((dds.get_topic)(reader), name.as_mut_ptr(), name.len());
            (participant, reader, name.map(|char| char as u8))
        };
        let publications = Publications { dds, participant, reader, known: HashMap::new() };
        match (reader, name == TOPIC) {
            (..0, _) => Err(error(reader, "it gives no reader of it".to_owned())),
            (_, false) => {
                Err(error(0, "another topic has its place: this version of it is not known".to_owned()))
            }
            (_, true) => Ok(publications),
        }
    }

    /// The identifier of a message's publisher; the default one, which nobody has, if the list has none of that handle.
    ///
    /// # Real-time
    /// A look-up. Before the first message of a publisher: O(changes of the list), and allocates.
    pub(super) fn gid(&mut self, handle: u64) -> Gid {
        while !self.known.contains_key(&handle) && self.read() == TURN {}
        self.known.get(&handle).map(|(gid, _)| *gid).unwrap_or_default()
    }

    /// Takes what changed, and forgets who went long ago.
    pub(super) fn refresh(&mut self) {
        while self.read() == TURN {}
        self.known.retain(|_, (_, gone)| gone.is_none_or(|since| since.elapsed() < GONE_TIME));
    }

    /// Takes a turn of what changed. Returns how many changes that were.
    fn read(&mut self) -> usize {
        let mut samples = [std::ptr::null_mut::<c_void>(); TURN];
        let mut infos = [SampleInfo::default(); TURN];
        // SAFETY: as many as said; of null pointers DDS lends the samples, until they are given back below.
        let lent = unsafe {
            (self.dds.take)(self.reader, samples.as_mut_ptr(), infos.as_mut_ptr(), TURN, TURN as u32)
        };
        // An error is less than none.
        let count = usize::try_from(lent).unwrap_or(0);
        for (sample, info) in samples.iter().zip(&infos).take(count) {
            // SAFETY: `dds_builtintopic_endpoint_t` begins with the identifier, and has it also when nothing else is valid.
            let gid = Gid(unsafe { sample.cast::<[u8; 16]>().read_unaligned() });
            let gone = (info.instance_state != ALIVE).then(Instant::now);
            self.known.insert(info.instance_handle, (gid, gone));
        }
        if count > 0 {
            // SAFETY: what was lent.
            unsafe { (self.dds.return_loan)(self.reader, samples.as_mut_ptr(), lent) };
        }
        count
    }
}

impl Drop for Publications {
    fn drop(&mut self) {
        // SAFETY: its own, with the reader; an error if it is none.
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
    /// Nobody but this host.
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

    /// With the Cyclone DDS of a Python package: an RMW on it is not to be had so.
    #[test]
    fn a_writer_of_another_process_is_listed_until_after_its_end() {
        let target = std::env::var_os("CARGO_TARGET_DIR")
            .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../target"), Into::into);
        let python = target.join("ros/venv/bin/python");
        let library = target.join("ros/venv/lib/python3.11/site-packages/cyclonedds/.libs/libddsc.so");
        if !library.is_file() {
            assert!(
                std::env::var_os("CI").is_none(),
                "CI needs {}: run `cargo xtask ros`",
                library.display()
            );
            return eprintln!("skipped: no {}: run `cargo xtask ros`", library.display());
        }
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
