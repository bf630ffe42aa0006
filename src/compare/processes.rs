//! Runs with controllers that are processes of their own: `cz run` has them, and its recording shows what came of it.

use super::sample::Sample;
use crate::reproduce::ReproduceError;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};

/// A recording that is gone when it is dropped.
struct Recording(PathBuf);

impl Recording {
    fn new() -> Recording {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        Recording(std::env::temp_dir().join(format!("cz-compare-{}-{count}.czlog", std::process::id())))
    }
}

impl Drop for Recording {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

/// What the run of a scenario, named as on the command line, with this seed and `--set`s shows.
pub(super) fn sample(
    argument: Option<&str>,
    seed: u64,
    sets: &[String],
    what: &str,
) -> Result<Sample, ReproduceError> {
    let failed =
        |error: String| ReproduceError::Run { command: format!("policy {what}, seed {seed}"), error };
    let recording = Recording::new();
    let program = std::env::current_exe().map_err(|error| failed(format!("cannot find cz: {error}")))?;
    let mut command = Command::new(program);
    command.arg("run").args(argument).args(["--seed", &seed.to_string()]);
    command.args(sets.iter().flat_map(|set| ["--set", set])).arg("--record").arg(&recording.0);
    let output = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).output();
    let output = output.map_err(|error| failed(format!("cannot start cz run: {error}")))?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        return Err(failed(format!("cz run: {}, {}", output.status, said.trim())));
    }
    Sample::recorded(&recording.0).map_err(failed)
}
