//! Recordings: what is written is read back, nothing wrong is ever read as right, and roles replay.

mod commands;
mod damage;
mod files;
mod recorder;
mod roles;

use control_zones::lockstep::in_process::InProcess;
use control_zones::record::{Flaw, Metadata, Processes, Reader, RunEnd, ScenarioSource, Step, Writer};
use control_zones::scenario::{Override, Scenario, load};
use std::sync::Arc;

fn scenario(name: &str, sets: &[&str]) -> Arc<Scenario> {
    let sets: Vec<Override> = sets.iter().map(|s| s.parse().unwrap()).collect();
    Arc::new(load(Some(name), &sets, None).unwrap())
}

fn metadata(scenario: &Scenario, coordinators: u32, controllers: u32) -> Metadata {
    let processes = Processes { coordinators, controllers };
    Metadata::new(scenario, ScenarioSource::default(), InProcess::RUN_ID, processes)
}

/// A recorded run, and what it was recorded from.
struct Run {
    metadata: Metadata,
    bytes: Vec<u8>,
    steps: Vec<Step>,
    /// Where each step's block begins, and where the last one ends.
    offsets: Vec<usize>,
    state_hash: u64,
}

impl Run {
    fn new(scenario: &Arc<Scenario>, coordinators: u32, controllers: u32) -> Run {
        let mut process = InProcess::observed(scenario, coordinators, controllers);
        let mut steps = Vec::new();
        loop {
            let goes_on = process.step().unwrap();
            process
                .frames(|frames| {
                    let mut block = Vec::new();
                    frames.encode_onto(&mut block);
                    assert_eq!(block.len(), frames.encoded_len());
                    steps.push(Step::decode(&block).unwrap());
                })
                .unwrap();
            if !goes_on {
                break;
            }
        }
        let state_hash = process.world().state_hash();
        Run::of(metadata(scenario, coordinators, controllers), steps, state_hash)
    }

    /// The recording of these steps.
    fn of(metadata: Metadata, steps: Vec<Step>, state_hash: u64) -> Run {
        let mut writer = Writer::new(Vec::new(), &metadata).unwrap();
        let mut offsets = vec![writer.bytes() as usize];
        for step in &steps {
            writer.append(&step.encode()).unwrap();
            offsets.push(writer.bytes() as usize);
        }
        let (bytes, _, length) = writer.finish(RunEnd::Finished, Vec::new()).unwrap();
        assert_eq!(bytes.len() as u64, length);
        Run { metadata, bytes, steps, offsets, state_hash }
    }

    /// The same with some steps changed.
    fn with(&self, change: impl FnOnce(&mut Vec<Step>)) -> Run {
        let mut steps = self.steps.clone();
        change(&mut steps);
        Run::of(self.metadata.clone(), steps, self.state_hash)
    }

    fn reader(&self) -> Reader<&[u8]> {
        Reader::new(&self.bytes[..]).unwrap()
    }
}

/// Some vehicles, some events, some hundred steps.
fn small() -> Run {
    Run::new(&scenario("two-merges", &["end.time_s=25"]), 2, 2)
}

/// Checks that a reader hands out nothing but what was written, and returns how many steps it did hand out
/// and what it found wrong.
fn honest(run: &Run, bytes: &[u8], what: &str) -> Option<(u64, Vec<Flaw>)> {
    // Without a head nothing is said at all.
    let reader = Reader::new(bytes).ok()?;
    let (mut steps, mut flaws) = (0, Vec::new());
    for step in reader.steps() {
        match step {
            Ok(step) => {
                let number = step.header.step as usize;
                assert!(
                    run.steps.get(number) == Some(&step),
                    "{what}: step {number} is not what was written"
                );
                steps += 1;
            }
            Err(damage) => flaws.push(damage.flaw),
        }
    }
    if let Some(footer) = reader.footer() {
        assert_eq!(footer.state_hash, run.state_hash, "{what}");
    }
    Some((steps, flaws))
}

#[test]
fn what_is_written_is_read_back() {
    let run = small();
    let reader = run.reader();
    assert_eq!(reader.metadata(), &run.metadata);
    assert_eq!(reader.steps().collect::<Result<Vec<_>, _>>().unwrap(), run.steps);
    assert!(reader.step_numbers().eq(0..run.steps.len() as u64));
    assert_eq!(reader.gaps(), []);
    let footer = reader.footer().unwrap();
    assert_eq!((footer.steps, footer.state_hash), (run.steps.len() as u64, run.state_hash));
    assert_eq!(footer.end, RunEnd::Finished);
    for step in run.steps.iter().rev() {
        assert_eq!(reader.step(step.header.step).unwrap().as_ref(), Some(step));
    }
    assert_eq!(reader.step(run.steps.len() as u64), Ok(None));
    // There was something to write in every section.
    assert!(run.steps.iter().any(|s| !s.summaries.is_empty()));
    assert!(run.steps.iter().any(|s| !s.coordination.is_empty()));
    assert!(run.steps.iter().all(|s| s.commands.len() == 2 || s.header.flags != 0));
}
