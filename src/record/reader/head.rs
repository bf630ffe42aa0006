//! The head of a recording: without it no step means anything, so it is sound or nothing is read.

use super::super::format::{Digest, FILE_MAGIC, FORMAT_VERSION, FileHead, Metadata, unpadded};
use super::source::{Source, bytes, fixed};
use crate::scenario::share::{MAX_CONTROLLERS, MAX_COORDINATORS};
use crate::scenario::{DecodeError, Scenario, ScenarioFault, decode, scenario_hash};
use std::io;
use std::sync::Arc;

/// Why a file cannot be read as a recording at all.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// It cannot be read.
    #[error("cannot read it: {0}")]
    Io(#[from] io::Error),
    /// It does not start as a recording does.
    #[error("not a recording: it does not begin as a .czlog file does")]
    NotARecording,
    /// It was written by another version of the format.
    #[error("the recording has format version {found}, this program reads version {FORMAT_VERSION}")]
    OtherVersion {
        /// The file's.
        found: u32,
    },
    /// The head or the metadata is cut off or damaged; without it no step means anything.
    #[error("the head of the file is {0}")]
    Head(&'static str),
    /// The records have another layout.
    #[error("its records have schema {found:016x}, this program's have {expected:016x}")]
    OtherSchema {
        /// Ours.
        expected: u64,
        /// The file's.
        found: u64,
    },
    /// The metadata cannot be decoded.
    #[error("the metadata cannot be read: {0}")]
    Metadata(DecodeError),
    /// The scenario cannot be decoded.
    #[error("the scenario in it cannot be read: {0}")]
    Scenario(DecodeError),
    /// The scenario is none that the loader would have let pass.
    #[error("the scenario in it is not valid: {0}")]
    BadScenario(#[from] ScenarioFault),
    /// The metadata contradicts the scenario.
    #[error("the metadata contradicts itself: {0}")]
    Contradiction(&'static str),
}

/// What a sound head says.
pub(super) struct Head {
    pub metadata: Metadata,
    pub scenario: Arc<Scenario>,
    /// Where the first block is, and the link before it.
    pub first: u64,
    pub first_link: Digest,
}

impl Head {
    pub fn read<S: Source>(source: &S) -> Result<Head, OpenError> {
        let mut magic = [0; FILE_MAGIC.len()];
        if source.length() < magic.len() as u64 {
            return Err(OpenError::NotARecording);
        }
        source.read_at(0, &mut magic)?;
        if magic != FILE_MAGIC {
            return Err(OpenError::NotARecording);
        }
        let cut_off = OpenError::Head("cut off");
        let Some(head) = fixed::<FileHead, S>(source, 0)? else { return Err(cut_off) };
        if head.version != FORMAT_VERSION {
            return Err(OpenError::OtherVersion { found: head.version });
        }
        let begin = size_of::<FileHead>() as u64;
        let Some(bytes) = bytes(source, begin, head.metadata)? else { return Err(cut_off) };
        if head.digest != head.digest_with(&bytes) {
            return Err(OpenError::Head("damaged"));
        }
        let expected = ipc_schemas::schema_hash();
        if head.schema_hash != expected {
            return Err(OpenError::OtherSchema { expected, found: head.schema_hash });
        }
        let metadata: Metadata = unpadded(&bytes).map_err(OpenError::Metadata)?;
        let scenario = Arc::new(sound_scenario(&metadata)?);
        Ok(Head { metadata, scenario, first: begin + head.metadata, first_link: head.digest })
    }
}

fn sound_scenario(metadata: &Metadata) -> Result<Scenario, OpenError> {
    let scenario = decode(&metadata.scenario).map_err(OpenError::Scenario)?;
    scenario.check()?;
    if scenario_hash(&scenario) != metadata.scenario_hash {
        return Err(OpenError::Contradiction("another scenario hash than the scenario's"));
    }
    if scenario.dt_ns != metadata.dt_ns || scenario.seed != metadata.seed {
        return Err(OpenError::Contradiction("another step or seed than the scenario's"));
    }
    let zones = scenario.network.zones.len() as u32;
    let plugins = scenario.plugins.len() as u32;
    let coordinators = 1..=zones.min(MAX_COORDINATORS);
    let pool = metadata.controllers.checked_sub(plugins);
    let shared_out = pool.is_some_and(|pool| pool <= zones && scenario.controllers(pool) == pool + plugins);
    if !coordinators.contains(&metadata.coordinators) || metadata.controllers > MAX_CONTROLLERS || !shared_out
    {
        return Err(OpenError::Contradiction("numbers of processes the scenario cannot have"));
    }
    Ok(scenario)
}
