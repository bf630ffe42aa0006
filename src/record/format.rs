//! The file around the blocks.
//!
//! ```text
//! FileHead | metadata | (block | Seal)* | EndHead | index | footer | digest | Tail
//! ```
//!
//! Every byte is under a checksum: file head and metadata under one digest, each block under its own, the end
//! section under another, the tail under a third. Each block's seal also carries a link, the digest of the
//! link before it and the block's own digest; the first link is the digest of the file's head. So a block
//! can be read by itself, and what has been exchanged is noticed by everything after it.

use crate::encoding;
use crate::scenario::{Scenario, scenario_hash};
use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::{Xxh3, xxh3_64};
use zerocopy::{FromBytes, Immutable, IntoBytes};

/// First bytes of a recording.
pub const FILE_MAGIC: [u8; 8] = *b"CZLOG\r\n\x1a";
/// The version of the format: 3 since metadata and footer name their fields. A new field there is no new version;
/// records have a version of their own, the schema hash.
pub const FORMAT_VERSION: u32 = 3;

pub(super) const END_MAGIC: [u8; 8] = *b"CZend\0\0\x01";
pub(super) const TAIL_MAGIC: [u8; 8] = *b"CZtail\0\x01";

/// A digest: XXH3, 128 bits, little-endian.
pub(super) type Digest = [u8; 16];

/// The digest of pieces, one after the other.
pub(super) fn digest(pieces: &[&[u8]]) -> Digest {
    let mut hasher = Xxh3::new();
    pieces.iter().for_each(|piece| hasher.update(piece));
    hasher.digest128().to_le_bytes()
}

/// What a file starts with.
#[derive(Clone, Copy, Debug, FromBytes, IntoBytes, Immutable)]
#[repr(C)]
pub(super) struct FileHead {
    pub magic: [u8; 8],
    pub version: u32,
    pub reserved: u32,
    pub schema_hash: u64,
    /// Bytes of the metadata that follow, a multiple of 8.
    pub metadata: u64,
    /// Of the fields above and the metadata; also the link before the first block.
    pub digest: Digest,
}

impl FileHead {
    pub fn new(schema_hash: u64, metadata: &[u8]) -> FileHead {
        let mut head = FileHead {
            magic: FILE_MAGIC,
            version: FORMAT_VERSION,
            reserved: 0,
            schema_hash,
            metadata: metadata.len() as u64,
            digest: [0; 16],
        };
        head.digest = head.digest_with(metadata);
        head
    }

    pub fn digest_with(&self, metadata: &[u8]) -> Digest {
        let own = self.as_bytes();
        digest(&[&own[..own.len() - size_of::<Digest>()], metadata])
    }
}

/// What follows every block.
#[derive(Clone, Copy, Debug, FromBytes, IntoBytes, Immutable)]
#[repr(C)]
pub(super) struct Seal {
    /// Of the block.
    pub digest: Digest,
    /// Of the link before and the digest.
    pub link: Digest,
}

impl Seal {
    pub fn new(link: &Digest, block: &[u8]) -> Seal {
        let digest = digest(&[block]);
        Seal { digest, link: next_link(link, &digest) }
    }
}

pub(super) fn next_link(link: &Digest, block: &Digest) -> Digest {
    digest(&[link, block])
}

/// What the end section starts with.
#[derive(Clone, Copy, Debug, FromBytes, IntoBytes, Immutable)]
#[repr(C)]
pub(super) struct EndHead {
    pub magic: [u8; 8],
    /// Number of index entries.
    pub entries: u64,
    /// Bytes of the footer, a multiple of 8.
    pub footer: u64,
    /// XXH3-64 of the fields above.
    pub check: u64,
}

impl EndHead {
    pub fn new(entries: usize, footer: usize) -> EndHead {
        let mut head = EndHead { magic: END_MAGIC, entries: entries as u64, footer: footer as u64, check: 0 };
        head.check = head.checksum();
        head
    }

    pub fn checksum(&self) -> u64 {
        xxh3_64(&self.as_bytes()[..size_of::<EndHead>() - size_of::<u64>()])
    }

    /// Bytes of the whole end section with its digest; `None` when no file is that long.
    pub fn section(&self) -> Option<u64> {
        let index = self.entries.checked_mul(size_of::<Entry>() as u64)?;
        let fixed = (size_of::<EndHead>() + size_of::<Digest>()) as u64;
        index.checked_add(self.footer)?.checked_add(fixed)
    }
}

/// Where a step's block is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromBytes, IntoBytes, Immutable)]
#[repr(C)]
pub(super) struct Entry {
    pub step: u64,
    /// Bytes from the start of the file.
    pub offset: u64,
}

/// The last bytes of a file that was closed in order.
#[derive(Clone, Copy, Debug, FromBytes, IntoBytes, Immutable)]
#[repr(C)]
pub(super) struct Tail {
    pub magic: [u8; 8],
    /// Where the end section starts.
    pub end: u64,
    /// XXH3-64 of the fields above.
    pub check: u64,
}

impl Tail {
    pub fn new(end: u64) -> Tail {
        let mut tail = Tail { magic: TAIL_MAGIC, end, check: 0 };
        tail.check = tail.checksum();
        tail
    }

    pub fn checksum(&self) -> u64 {
        xxh3_64(&self.as_bytes()[..size_of::<Tail>() - size_of::<u64>()])
    }
}

/// What a recording is of: written at its beginning.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Metadata {
    /// Who wrote the file.
    pub build: Build,
    /// The layouts of its records, as [`ipc_schemas::schema_text`] gives them.
    pub schema: String,
    /// The scenario, as [`crate::scenario::keep`] gives it.
    #[serde(with = "serde_bytes")]
    pub scenario: Vec<u8>,
    /// Its hash.
    pub scenario_hash: u64,
    /// Its name.
    pub scenario_name: String,
    /// The text it was read from, for people; the arrival traces it names are in `scenario` only.
    pub scenario_text: String,
    /// What the command line changed in that text: `key=value`.
    pub overrides: Vec<String>,
    /// Seed of all random streams.
    pub seed: u64,
    /// Step length, ns.
    pub dt_ns: u64,
    /// Run id of all frames.
    pub run_id: u64,
    /// Number of coordinator processes.
    pub coordinators: u32,
    /// Number of controller processes, plug-ins included.
    pub controllers: u32,
    /// When the run began, s since 1970.
    pub created_unix_s: u64,
    /// Who moved the vehicles, where it was not the world itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub played_by: Option<String>,
}

/// What a program was built from, and how.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Build {
    /// Version of the package.
    pub version: String,
    /// Commit of the sources, with a `+` when they differed from it, or `unknown`.
    pub commit: String,
    /// Processor architecture and operating system.
    pub target: String,
    /// `release` or `debug`.
    pub profile: String,
}

impl Build {
    /// This program.
    pub fn own() -> Build {
        Build {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            commit: env!("CZ_COMMIT").to_owned(),
            target: format!("{}-{}", std::env::consts::ARCH, std::env::consts::OS),
            profile: if cfg!(debug_assertions) { "debug" } else { "release" }.to_owned(),
        }
    }
}

impl Build {
    /// Whether both may behave alike for all that is known: version and commit are the same.
    pub fn is_as(&self, other: &Build) -> bool {
        (&self.version, &self.commit) == (&other.version, &other.commit)
    }
}

impl std::fmt::Display for Build {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Build { version, commit, target, profile } = self;
        write!(f, "control-zones {version} (commit {commit}, {target}, {profile})")
    }
}

/// What can be said of a file whose metadata cannot be read.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub(super) struct Origin {
    pub build: Build,
    pub schema: String,
}

impl Metadata {
    /// The metadata of a run that begins now.
    pub fn new(scenario: &Scenario, source: ScenarioSource, run_id: u64, processes: Processes) -> Metadata {
        let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        Metadata {
            schema: ipc_schemas::schema_text(),
            scenario: crate::scenario::keep(scenario),
            scenario_hash: scenario_hash(scenario),
            scenario_name: scenario.name.clone(),
            scenario_text: source.text,
            overrides: source.overrides,
            seed: scenario.seed,
            dt_ns: scenario.dt_ns,
            run_id,
            coordinators: processes.coordinators,
            controllers: processes.controllers,
            build: Build::own(),
            created_unix_s: now.map_or(0, |t| t.as_secs()),
            played_by: None,
        }
    }
}

/// What a scenario was read from.
#[derive(Clone, Debug, Default)]
pub struct ScenarioSource {
    /// Text of the scenario file; empty when there is none.
    pub text: String,
    /// Changes to it: `key=value`.
    pub overrides: Vec<String>,
}

/// Numbers of processes, or of roles where all is one process.
#[derive(Clone, Copy, Debug)]
pub struct Processes {
    /// Coordinators.
    pub coordinators: u32,
    /// Controllers, plug-ins included.
    pub controllers: u32,
}

/// What is known at the end of a recording: written when it is closed in order.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Footer {
    /// Number of steps in the file.
    pub steps: u64,
    /// State hash of the last of them.
    pub state_hash: u64,
    /// How the run ended.
    pub end: RunEnd,
    /// Steps that are not in the file because the recorder could not keep up: first and last of each range.
    pub missing: Vec<(u64, u64)>,
    /// The last block's link.
    pub link: [u8; 16],
    /// What happened to the run beside its steps, as far as it came to its end; none in older recordings.
    #[serde(default)]
    pub events: Vec<RunEvent>,
}

/// Something that happened to a run, beside its steps.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunEvent {
    /// The step that was under way, or was next.
    pub step: u64,
    /// What.
    pub kind: RunEventKind,
    /// In words.
    pub text: String,
    /// The controllers it is about, one bit each; none where it is about others.
    #[serde(default)]
    pub controllers: u64,
}

/// What happens to runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RunEventKind {
    /// Somebody begins not to answer by the deadline.
    Missed,
    /// The first frames of a sender were refused.
    Refused,
    /// A process took another's place.
    Replaced,
    /// Somebody steered the run.
    Steered,
    /// A controller's process ended in the middle of the run, which goes on.
    Exited,
}

/// How a recorded run ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum RunEnd {
    /// By itself.
    Finished,
    /// By a signal.
    Interrupted,
    /// It failed.
    Failed {
        /// What it said.
        reason: String,
    },
}

impl std::fmt::Display for RunEnd {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            RunEnd::Finished => f.write_str("the run finished"),
            RunEnd::Interrupted => f.write_str("the run was interrupted"),
            RunEnd::Failed { reason } => write!(f, "the run failed: {reason}"),
        }
    }
}

/// A value as bytes, filled up with zeros to a multiple of 8, behind the number of its own bytes.
pub(super) fn padded(value: &impl Serialize) -> Vec<u8> {
    let mut bytes = vec![0; 8];
    encoding::keep_onto(&mut bytes, value);
    let length = bytes.len() as u64 - 8;
    bytes[..8].copy_from_slice(&length.to_le_bytes());
    bytes.resize(bytes.len().next_multiple_of(8), 0);
    bytes
}

/// The value of such bytes.
pub(super) fn unpadded<T: serde::de::DeserializeOwned>(bytes: &[u8]) -> Result<T, encoding::DecodeError> {
    let (length, rest) = bytes.split_first_chunk::<8>().unwrap_or((&[0; 8], &[]));
    let own = usize::try_from(u64::from_le_bytes(*length)).ok().and_then(|n| rest.get(..n));
    encoding::kept(own.unwrap_or_default())
}
