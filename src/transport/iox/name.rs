//! Names of runs.

use std::str::FromStr;

/// A valid run name: 1 to 32 characters of `[A-Za-z0-9_-]`, the first no dash, by which options begin.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunName(String);

/// Not a run name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{name:?} is not a run name; expected 1 to 32 letters, digits, '-' or '_', not beginning with '-'")]
pub struct RunNameError {
    /// What was given.
    pub name: String,
}

impl FromStr for RunName {
    type Err = RunNameError;

    fn from_str(name: &str) -> Result<RunName, RunNameError> {
        let valid = (1..=32).contains(&name.len())
            && !name.starts_with('-')
            && name.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_');
        if valid { Ok(RunName(name.to_owned())) } else { Err(RunNameError { name: name.to_owned() }) }
    }
}

impl std::fmt::Display for RunName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}
