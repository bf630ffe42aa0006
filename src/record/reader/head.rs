//! The head of a recording: without it no step means anything, so it is sound or nothing is read.

use super::super::format::{Build, Digest, FILE_MAGIC, FORMAT_VERSION, FileHead, Metadata, Origin, unpadded};
use super::source::{Source, bytes, fixed};
use crate::encoding::first_unknown_field;
use crate::scenario::share::{MAX_CONTROLLERS, MAX_COORDINATORS};
use crate::scenario::{DecodeError, Scenario, ScenarioFault, keep, kept, scenario_hash};
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
    #[error(
        "its records are others than this program's (schema {found:016x}, expected {expected:016x}): {differences}; {builds}"
    )]
    OtherSchema {
        /// Ours.
        expected: u64,
        /// The file's.
        found: u64,
        /// Where they differ.
        differences: String,
        /// Who wrote it, and who reads it.
        builds: Builds,
    },
    /// The metadata cannot be decoded.
    #[error("the metadata cannot be read: {error}; {builds}")]
    Metadata {
        /// Why.
        error: DecodeError,
        /// Who wrote it, and who reads it.
        builds: Builds,
    },
    /// The scenario cannot be decoded.
    #[error("the scenario in it cannot be read: {error}; {builds}")]
    Scenario {
        /// Why.
        error: DecodeError,
        /// Who wrote it, and who reads it.
        builds: Builds,
    },
    /// The scenario has a setting that this program does not have.
    #[error("the scenario in it has {field}, which this program does not know; {builds}")]
    UnknownField {
        /// Its name.
        field: String,
        /// Who wrote it, and who reads it.
        builds: Builds,
    },
    /// The scenario is none that the loader would have let pass.
    #[error("the scenario in it is not valid: {0}")]
    BadScenario(#[from] ScenarioFault),
    /// The metadata contradicts the scenario.
    #[error("the metadata contradicts itself: {0}")]
    Contradiction(&'static str),
}

/// Who wrote a recording, if that can be read, and who reads it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Builds(Option<Box<Build>>);

impl std::fmt::Display for Builds {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.0 {
            Some(writer) => write!(f, "written by {writer}, this is {}", Build::own()),
            None => write!(f, "it does not say by whom it was written, this is {}", Build::own()),
        }
    }
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
        let origin = unpadded::<Origin>(&bytes).ok();
        let builds = Builds(origin.as_ref().map(|origin| Box::new(origin.build.clone())));
        let expected = ipc_schemas::schema_hash();
        if head.schema_hash != expected {
            let theirs = origin.map(|origin| origin.schema).unwrap_or_default();
            let differences = differences(&theirs, &ipc_schemas::schema_text());
            return Err(OpenError::OtherSchema { expected, found: head.schema_hash, differences, builds });
        }
        let metadata: Metadata = match unpadded(&bytes) {
            Ok(metadata) => metadata,
            Err(error) => return Err(OpenError::Metadata { error, builds }),
        };
        let scenario = Arc::new(sound_scenario(&metadata, builds)?);
        Ok(Head { metadata, scenario, first: begin + head.metadata, first_link: head.digest })
    }
}

/// What differs between the records of a file and ours, the first few fields.
fn differences(theirs: &str, ours: &str) -> String {
    const SHOWN: usize = 5;
    // Fields are indented below the name and size of their record.
    fn fields(text: &str) -> Vec<(&str, &str)> {
        let mut record = "";
        let line = |line: &'_ str| line.starts_with(' ');
        text.lines()
            .map(|text| {
                if !line(text) {
                    record = text.split(' ').next().unwrap_or_default();
                }
                (record, text.trim())
            })
            .collect()
    }
    let (theirs, ours) = (fields(theirs), fields(ours));
    let only = |here: &[(&str, &str)], there: &[(&str, &str)], whose: &str| -> Vec<String> {
        let line = |(record, text): &(&str, &str)| format!("{record}: {whose} has `{text}`");
        here.iter().filter(|entry| !there.contains(entry)).map(line).collect()
    };
    let mut all = only(&theirs, &ours, "the file");
    all.truncate(SHOWN);
    let mut own = only(&ours, &theirs, "this program");
    own.truncate(SHOWN);
    all.append(&mut own);
    if all.is_empty() { "which fields it does not say".to_owned() } else { all.join(", ") }
}

fn sound_scenario(metadata: &Metadata, builds: Builds) -> Result<Scenario, OpenError> {
    let scenario = match kept(&metadata.scenario) {
        Ok(scenario) => scenario,
        Err(error) => return Err(OpenError::Scenario { error, builds }),
    };
    scenario.check()?;
    if scenario_hash(&scenario) != metadata.scenario_hash {
        if let Some(field) = first_unknown_field(&metadata.scenario, &keep(&scenario)) {
            return Err(OpenError::UnknownField { field, builds });
        }
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
