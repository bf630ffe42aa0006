//! `cz run --record`, `cz verify`, `cz replay`.

use super::args::{ReplayArgs, ScenarioArgs, ShareArgs, VerifyArgs};
use super::say::{number, say};
use super::{AppError, print};
use crate::process::RecordLag;
use crate::record::{
    Build, FileSource, Flaw, Metadata, Processes, Reader, RecordError, Recorder, Replay, RunEnd, RunEvent,
    ScenarioSource, StepFrames, Stop, compare, replay as replay_roles,
};
use crate::scenario::{Scenario, text_of};
use indicatif::{ProgressBar, ProgressDrawTarget};
use serde_json::json;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

impl From<RecordError> for AppError {
    fn from(error: RecordError) -> AppError {
        match error {
            RecordError::Occupied(_)
            | RecordError::Busy(_)
            | RecordError::TooLarge { .. }
            | RecordError::Create { .. } => AppError::Usage(format!("--record: {error}")),
            RecordError::Write { .. } => AppError::Failed(error.to_string()),
        }
    }
}

/// A run being recorded.
pub(super) struct Recording {
    recorder: Recorder,
    path: PathBuf,
    /// What becomes of steps that come faster than they can be written.
    lag: RecordLag,
    /// Why nothing is written any more.
    failure: Option<RecordError>,
}

impl Recording {
    /// Starts the recording of a run that is about to begin.
    pub fn start(
        path: &Path,
        arguments: &ScenarioArgs,
        scenario: &Scenario,
        share: ShareArgs,
        run_id: u64,
        played_by: Option<String>,
    ) -> Result<Recording, AppError> {
        // A generated network has no text.
        let text = match arguments.side_by_side {
            Some(_) => String::new(),
            None => text_of(arguments.scenario.as_deref())?,
        };
        let source = ScenarioSource { text, overrides: arguments.set.clone() };
        let controllers = scenario.controllers(share.ctrl_procs);
        let processes = Processes { coordinators: share.coord_procs, controllers };
        let metadata = Metadata { played_by, ..Metadata::new(scenario, source, run_id, processes) };
        Ok(Recording::of(Recorder::create(path, &metadata)?, path))
    }

    fn of(recorder: Recorder, path: &Path) -> Recording {
        Recording { recorder, path: path.to_owned(), lag: RecordLag::Wait, failure: None }
    }

    /// Has steps left out, or waited for, that come faster than they can be written.
    pub fn lagging(self, lag: RecordLag) -> Recording {
        Recording { lag, ..self }
    }

    /// Starts the recording of a run that goes on from another recording: its first `steps` steps are the past
    /// of this one, under the run's new id. The world compares them all before the run goes on.
    pub fn continuation(
        path: &Path,
        reader: &Reader<FileSource>,
        from: &Path,
        steps: u64,
        run_id: u64,
    ) -> Result<Recording, AppError> {
        if is_same_file(path, from) {
            let problem = "the run goes on from this recording; expected another file";
            return Err(AppError::Usage(format!("--record {}: {problem}", path.display())));
        }
        let metadata = Metadata { run_id, build: Build::own(), ..reader.metadata().clone() };
        let mut recorder = Recorder::create(path, &metadata)?;
        for step in reader.steps().take(steps as usize) {
            let mut step = step.map_err(|damage| AppError::Usage(format!("{}: {damage}", from.display())))?;
            step.header.run_id = run_id;
            if !recorder.push_step_or_wait(&step) {
                break; // it has failed, and says so at the end
            }
        }
        Ok(Recording::of(recorder, path))
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Records a step of a run in this process, which may wait for the disk.
    pub fn push(&mut self, frames: &StepFrames<'_>) {
        if self.failure.is_none() && !self.recorder.push_or_wait(frames) {
            self.note_failure();
        }
    }

    /// Records the block of a step of a run in other processes.
    pub fn push_block(&mut self, step: u64, block: &[u8]) {
        let pushed = match self.lag {
            _ if self.failure.is_some() => return,
            RecordLag::Drop => self.recorder.push_block(step, block),
            RecordLag::Wait => self.recorder.push_block_or_wait(step, block),
        };
        if !pushed {
            self.note_failure();
        }
    }

    /// Says at once that nothing is written any more; the run goes on all the same, and ends with it.
    fn note_failure(&mut self) {
        self.failure = self.recorder.failure();
        if let Some(error) = &self.failure {
            say(format_args!("cz: {error}; the run goes on without being recorded"));
        }
    }

    /// What happened to the run beside its steps.
    pub fn happened(&mut self, events: &[RunEvent]) {
        self.recorder.happened(events.to_vec());
    }

    /// Ends the recording and says on stderr what is in it.
    pub fn finish<T>(self, outcome: &Result<T, AppError>) -> Result<(), AppError> {
        let end = match outcome {
            Ok(_) => RunEnd::Finished,
            Err(AppError::Interrupted(_)) => RunEnd::Interrupted,
            Err(error) => RunEnd::Failed { reason: error.to_string() },
        };
        let recorded = self.recorder.finish(end);
        if let Some(error) = self.failure {
            return Err(error.into());
        }
        let recorded = recorded?;
        if recorded.steps == 0 {
            say(format_args!("recorded nothing: {} is as it was", self.path.display()));
            return Ok(());
        }
        let (path, size) = (self.path.display(), bytes(recorded.bytes));
        say(format_args!("recorded {} in {path} ({size})", number(recorded.steps, "step")));
        if !recorded.missing.is_empty() {
            say(format_args!(
                "not in it, because it came faster than it could be written: {}, {}",
                number(recorded.missing_steps(), "step"),
                ranges(&recorded.missing)
            ));
        }
        Ok(())
    }
}

/// Ends the recording of a run that was to be recorded into this file.
pub(super) fn finish<T>(
    recording: Option<Recording>,
    path: Option<&Path>,
    outcome: &Result<T, AppError>,
) -> Result<(), AppError> {
    match (recording, path) {
        (Some(recording), _) => recording.finish(outcome),
        (None, Some(path)) => {
            Err(AppError::Failed(format!("the run is not in {} to its end", path.display())))
        }
        (None, None) => Ok(()),
    }
}

/// Whether both paths lead to the same file.
fn is_same_file(a: &Path, b: &Path) -> bool {
    let identity = |path: &Path| std::fs::metadata(path).ok().map(|file| (file.dev(), file.ino()));
    identity(a).is_some_and(|a| Some(a) == identity(b))
}

/// A recording, or why it cannot be read. When another build has written it, that is said.
pub fn open(path: &Path) -> Result<Reader<FileSource>, AppError> {
    let reader =
        Reader::open(path).map_err(|error| AppError::Usage(format!("{}: {error}", path.display())))?;
    let (writer, own) = (&reader.metadata().build, Build::own());
    if !writer.is_as(&own) {
        eprintln!("cz: {}: written by {writer}, this is {own}", path.display());
    }
    Ok(reader)
}

/// The numbers of processes of a recorded run.
pub(super) fn share_of(reader: &Reader<FileSource>) -> ShareArgs {
    let metadata = reader.metadata();
    let plugins = reader.scenario().plugins.len() as u32;
    ShareArgs {
        ctrl_procs: metadata.controllers.saturating_sub(plugins).max(1),
        coord_procs: metadata.coordinators,
    }
}

/// Ranges in words, the first few of many.
pub(super) fn ranges(ranges: &[(u64, u64)]) -> String {
    const SHOWN: usize = 20;
    let range = |(first, last): &(u64, u64)| match first == last {
        true => first.to_string(),
        false => format!("{first}-{last}"),
    };
    let mut text = ranges.iter().take(SHOWN).map(range).collect::<Vec<_>>().join(", ");
    if ranges.len() > SHOWN {
        text.push_str(&format!(" and {} ranges more", ranges.len() - SHOWN));
    }
    text
}

/// A number of bytes in words.
pub(super) fn bytes(bytes: u64) -> String {
    match bytes {
        0..10_000 => format!("{bytes} bytes"),
        10_000..1_000_000 => format!("{:.1} kB", bytes as f64 * 1e-3),
        _ => format!("{:.1} MB", bytes as f64 * 1e-6),
    }
}

pub(super) fn verify(args: &VerifyArgs) -> Result<(), AppError> {
    let (first, second) = (open(&args.first)?, open(&args.second)?);
    let result = compare(&first, &second);
    let paths = [args.first.display(), args.second.display()];
    if args.json {
        let damage = result.damage.as_ref().map(
            |(which, damage)| json!({ "file": paths[*which].to_string(), "damage": damage.to_string() }),
        );
        let value = json!({
            "same": result.same(),
            "same_scenario": result.same_scenario,
            "steps_compared": result.steps,
            "difference": result.difference,
            "steps_only_in_first": result.only_first,
            "steps_only_in_second": result.only_second,
            "damage": damage,
        });
        print(&(serde_json::to_string_pretty(&value).expect("the value has string keys only") + "\n"))?;
    } else {
        let mut text = String::new();
        if !result.same_scenario {
            let name = |m: &Metadata| {
                format!("{}, seed {} (hash {:016x})", m.scenario_name, m.seed, m.scenario_hash)
            };
            let (a, b) = (name(first.metadata()), name(second.metadata()));
            text.push_str(&format!("the scenarios differ: {a} / {b}\n"));
        }
        text.push_str(&format!("the same in {}\n", number(result.steps, "step")));
        if let Some(difference) = &result.difference {
            text.push_str(&format!("first difference: {difference}\n"));
        }
        for (path, only) in paths.iter().zip([result.only_first, result.only_second]) {
            if only > 0 {
                text.push_str(&format!("only in {path}: {}\n", number(only, "step")));
            }
        }
        for (path, reader) in paths.iter().zip([&first, &second]) {
            if reader.footer().is_none() {
                text.push_str(&format!("{path} has no end: it was cut off, or its recorder was killed\n"));
            }
        }
        print(&text)?;
    }
    match (result.same(), result.damage) {
        (true, _) => Ok(()),
        (false, Some((which, damage))) if result.difference.is_none() => {
            Err(AppError::Usage(format!("{}: damaged at {damage}", paths[which])))
        }
        _ => Err(AppError::Failed("the recordings differ".to_owned())),
    }
}

pub(super) fn replay(args: &ReplayArgs) -> Result<(), AppError> {
    let reader = open(&args.file)?;
    let steps = reader.step_numbers().len() as u64;
    let bar = ProgressBar::with_draw_target(Some(steps), ProgressDrawTarget::stderr());
    let result = replay_roles(&reader, |step| bar.set_position(step));
    bar.finish_and_clear();
    let stopped = result.stopped.as_ref().map(|stop| match stop {
        Stop::Gap(step) => format!("nothing from step {step} on: it is not in the recording"),
        Stop::Damage(damage) => format!("nothing from {damage}"),
    });
    if args.json {
        let role = |role: &crate::record::RoleReport| {
            json!({
                "role": role.role,
                "steps_compared": role.steps,
                "steps_inputs_only": role.inputs_only.map_or(0, |(steps, _)| steps),
                "difference": role.difference,
            })
        };
        let value = json!({
            "same": result.same(),
            "steps": result.steps,
            "state_hash": format!("{:016x}", result.state_hash),
            "roles": result.roles.iter().map(role).collect::<Vec<_>>(),
            "not_replayed": stopped,
        });
        print(&(serde_json::to_string_pretty(&value).expect("the value has string keys only") + "\n"))?;
    } else {
        print(&replay_text(&reader, &result, stopped.as_deref()))?;
    }
    let path = args.file.display();
    match &result.stopped {
        _ if !result.same() => Err(AppError::Failed("the replay differs from the recording".to_owned())),
        // A file that is cut off has been replayed to its end.
        Some(Stop::Damage(damage)) if damage.flaw != Flaw::CutOff => {
            Err(AppError::Usage(format!("{path}: damaged at {damage}")))
        }
        Some(Stop::Gap(step)) => Err(AppError::Usage(format!("{path}: step {step} is missing"))),
        _ => Ok(()),
    }
}

fn replay_text(reader: &Reader<FileSource>, result: &Replay, stopped: Option<&str>) -> String {
    let mut text = String::new();
    for role in &result.roles {
        let verdict = match &role.difference {
            None => "the same".to_owned(),
            Some(difference) => format!("then it differs: {difference}"),
        };
        text.push_str(&format!("{:<16}{:>8} steps compared, {verdict}\n", role.role, role.steps));
        if let Some((steps, why)) = role.inputs_only {
            text.push_str(&format!("{:<16}{steps:>8} steps not compared: {why}\n", ""));
        }
    }
    for plugin in &reader.scenario().plugins {
        let role = format!("controller {}", plugin.name);
        text.push_str(&format!("{role:<16} a process of its own, not replayed\n"));
    }
    if let Some(stopped) = stopped {
        text.push_str(&format!("{stopped}\n"));
    } else if reader.footer().is_none() {
        text.push_str("the recording has no end: it was cut off, or its recorder was killed\n");
    }
    text.push_str(&format!("state hash {:016x} after {} steps\n", result.state_hash, result.steps));
    text
}
