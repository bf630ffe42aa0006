//! What can be wrong with a scenario, each as one message.

use std::fmt;
use std::path::PathBuf;
use thiserror::Error;

/// Where a faulty value was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// A line (from 1) of a scenario file or arrival trace.
    Line {
        /// Path as the user gave it; embedded files start with `<embedded>/`.
        file: String,
        /// Line number, from 1.
        line: u64,
    },
    /// A `--set` of the command line.
    Set(String),
    /// The command line's `--seed`.
    Seed(u64),
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Line { file, line } => write!(f, "{file}:{line}"),
            Self::Set(text) => write!(f, "--set {text}"),
            Self::Seed(seed) => write!(f, "--seed {seed}"),
        }
    }
}

/// Why a scenario was refused. `Display` gives one line: where, which key, the value found, and what was
/// expected.
#[derive(Debug, Error)] // Box<str>: a String more per field and clippy's limit on errors is passed
pub enum ScenarioError {
    /// There is no embedded scenario of that name.
    #[error(
        "{name}: no such scenario; expected one of {known}, or the path of a TOML file{}",
        did_you_mean(.suggestion)
    )]
    UnknownScenario {
        /// Name as given.
        name: String,
        /// All embedded names.
        known: String,
        /// The nearest one.
        suggestion: Option<Box<str>>,
    },
    /// The scenario file cannot be read.
    #[error("{}: cannot read the scenario file: {source}", .path.display())]
    Read {
        /// Path as given.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The text is not TOML.
    #[error("{place}: not valid TOML: {message}")]
    Syntax {
        /// Where.
        place: Place,
        /// The parser's message.
        message: String,
    },
    /// A `--set` that is not `key=value`, or addresses something that does not exist.
    #[error("--set {set}: {message}")]
    Override {
        /// The text after `--set`.
        set: String,
        /// What is wrong, and what was expected.
        message: String,
    },
    /// A key the schema does not have.
    #[error("{place}: {key} = {found}: unknown key; expected {expected}{}", did_you_mean(.suggestion))]
    UnknownKey {
        /// Where.
        place: Place,
        /// Dotted path of the key.
        key: Box<str>,
        /// Its value.
        found: Box<str>,
        /// The keys that are known there.
        expected: Box<str>,
        /// The nearest known key.
        suggestion: Option<Box<str>>,
    },
    /// A key without which there is no scenario.
    #[error("{place}: {key}: missing key; expected {expected}")]
    MissingKey {
        /// Where the table it belongs to starts.
        place: Place,
        /// Dotted path of the key.
        key: Box<str>,
        /// What it should have been.
        expected: Box<str>,
    },
    /// A value of the wrong type, out of range, or in conflict with another.
    #[error("{place}: {key} = {found}: {}expected {expected}", because(.problem))]
    BadValue {
        /// Where.
        place: Place,
        /// Dotted path of the key, or column of a trace.
        key: Box<str>,
        /// The value found.
        found: Box<str>,
        /// What is wrong, where the value alone does not tell.
        problem: Option<Box<str>>,
        /// What it should have been.
        expected: Box<str>,
    },
    /// The zones form a cycle.
    #[error("{place}: {key} = {found}: cycle in the network: {cycle}; expected zones without a cycle")]
    Cycle {
        /// Where one of the cycle's connections is declared.
        place: Place,
        /// Dotted path of that connection.
        key: Box<str>,
        /// The zone it names.
        found: Box<str>,
        /// The cycle: `a -> b -> a`.
        cycle: Box<str>,
    },
    /// An arrival trace is not a table of `time_s,road,speed_mps`.
    #[error("{place}: {found}: expected {expected}")]
    Trace {
        /// Where.
        place: Place,
        /// What was found.
        found: Box<str>,
        /// What it should have been.
        expected: Box<str>,
    },
}

fn did_you_mean(suggestion: &Option<Box<str>>) -> String {
    suggestion.as_ref().map(|s| format!("; did you mean {s}?")).unwrap_or_default()
}

fn because(problem: &Option<Box<str>>) -> String {
    problem.as_ref().map(|p| format!("{p}; ")).unwrap_or_default()
}

/// The candidate most like `word`, if any is alike at all.
pub(super) fn nearest<'a>(word: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<Box<str>> {
    candidates
        .into_iter()
        .map(|c| (strsim::jaro_winkler(word, c), c))
        .filter(|(score, _)| *score > 0.8)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, c)| c.into())
}

/// The text in one line: characters that would end it, or move the cursor, are written as escapes.
pub fn printable(text: &str) -> String {
    let escaped = |c: char| -> Box<dyn Iterator<Item = char>> {
        if c.is_control() { Box::new(c.escape_default()) } else { Box::new(std::iter::once(c)) }
    };
    text.chars().flat_map(escaped).collect()
}
