//! Recordings: what is written is read back, nothing wrong is ever read as right, and roles replay.

#![allow(clippy::unwrap_used)] // in helpers as in the tests themselves

mod common;

use common::Site;
use control_zones::lockstep::in_process::InProcess;
use control_zones::record::{
    CommandPart, Flaw, Metadata, Output, Processes, QueueLimits, Reader, Recorder, ReplayError, RunEnd,
    ScenarioSource, Section, Step, Stop, Writer, compare, replay, replay_world,
};
use control_zones::scenario::{Override, Scenario, load};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::sync::{Arc, Condvar, Mutex};

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

#[test]
fn every_role_of_a_run_replays() {
    for (name, sets, coordinators, controllers) in [
        ("two-merges", &["end.vehicles=30"][..], 1, 1),
        ("two-merges", &["end.vehicles=30", "shield=on", "control.fe_conditions=off"], 2, 2),
        ("tree", &["end.time_s=150"], 3, 2),
        ("corridor-8", &["end.time_s=60"], 8, 5),
    ] {
        let run = Run::new(&scenario(name, sets), coordinators, controllers);
        let result = replay(&run.reader(), |_| {});
        assert!(result.same(), "{name}: {result:?}");
        assert_eq!(result.stopped, None);
        assert_eq!(result.state_hash, run.state_hash, "{name}");
        assert_eq!(result.roles.len() as u32, 1 + coordinators + controllers);
        assert_eq!(result.roles[0].steps, run.steps.len() as u64);
        for role in &result.roles {
            // The last step is answered by nobody; coordinators act at events.
            let all = run.steps.len() as u64 - 1;
            let expected = if role.role.starts_with("controller") { all..=all } else { 1..=all + 1 };
            assert!(expected.contains(&role.steps), "{name}: {role:?}");
        }
    }
}

#[test]
fn a_replayed_world_goes_on_as_the_recorded_one_did() {
    let run = small();
    let reader = run.reader();
    let last = run.steps.len() as u64 - 1;
    for until in [0, 1, 57, last] {
        let mut world = replay_world(&reader, until).unwrap();
        assert_eq!(world.step(), until);
        let masks = world.coordinator_masks();
        let next = &run.steps[until as usize];
        assert!(world.records().eq(next.state.iter().copied()));
        assert_eq!(masks.acting, next.header.coordinators_acting);
        world.seal(&next.state);
        assert_eq!(world.state_hash(), next.state_hash);
    }
    let error = replay_world(&reader, last + 1).unwrap_err();
    assert!(matches!(error, ReplayError::TooFar { last: l, .. } if l == last), "{error}");
}

#[test]
fn verify_names_step_vehicle_and_field() {
    let run = small();
    let same = compare(&run.reader(), &run.reader());
    assert!(same.same() && same.steps == run.steps.len() as u64, "{same:?}");
    let at = run.steps.iter().position(|s| s.header.step > 100 && !s.coordination.is_empty()).unwrap();
    let step = run.steps[at].header.step;
    let part = run.steps[at].commands.iter().position(|c| !c.records.is_empty()).unwrap();

    type Change = fn(&mut Step, usize);
    let changes: [(Change, Section, &str); 6] = [
        (|s, _| s.state[0].v_mps += 0.5, Section::State, "v_mps"),
        (|s, _| s.state[0].flags ^= 4, Section::State, "flags"),
        (|s, _| s.coordination[0].partner ^= 1, Section::Coordination, "partner"),
        (|s, p| s.commands[p].records[0].verdict ^= 1, Section::Command, "verdict"),
        (|s, _| s.state_hash ^= 1, Section::Step, "state_hash"),
        (|s, _| s.misses = 2, Section::Step, "misses"),
    ];
    for (change, section, field) in changes {
        let other = run.with(|steps| change(&mut steps[at], part));
        let found = compare(&run.reader(), &other.reader());
        let difference = found.difference.clone().unwrap();
        assert!(!found.same());
        assert_eq!((difference.step, difference.section, difference.field), (step, section, Some(field)));
        let vehicle = match section {
            Section::State => Some(run.steps[at].state[0].vehicle),
            Section::Coordination => Some(run.steps[at].coordination[0].vehicle),
            Section::Command => Some(run.steps[at].commands[part].records[0].vehicle),
            _ => None,
        };
        assert_eq!(difference.vehicle, vehicle, "{difference}");
        assert_eq!(found.steps, step);
    }
    // A vehicle that only one side has.
    let gone = run.steps[at].state.last().unwrap().vehicle;
    let other = run.with(|steps| steps[at].state.truncate(run.steps[at].state.len() - 1));
    let found = compare(&run.reader(), &other.reader()).difference.unwrap();
    assert_eq!((found.step, found.vehicle, found.field), (step, Some(gone), None), "{found}");
    assert_eq!((&found.first[..], &found.second[..]), ("1 record", "no record"));
}

#[test]
fn runs_in_other_numbers_of_processes_are_the_same() {
    let scenario = scenario("tree", &["end.time_s=100"]);
    let (one, many) = (Run::new(&scenario, 1, 1), Run::new(&scenario, 5, 3));
    assert!(many.steps.iter().any(|s| !s.summaries.is_empty()));
    let found = compare(&one.reader(), &many.reader());
    assert!(found.same(), "{found:?}");
    assert_eq!(found.steps, one.steps.len() as u64);
}

#[test]
fn replay_names_the_role_that_did_otherwise() {
    let run = small();
    let busy = |s: &&Step| !s.coordination.is_empty() && s.commands.iter().all(|c| !c.records.is_empty());
    let at = run.steps.iter().filter(busy).nth(3).unwrap().header.step as usize;
    let differing = |run: &Run| {
        let result = replay(&run.reader(), |_| {});
        let names: Vec<_> =
            result.roles.iter().filter(|r| r.difference.is_some()).map(|r| r.role.clone()).collect();
        (names, result)
    };
    // The second controller says it would have braked: it did not, and the world comes out elsewhere.
    let (names, _) = differing(&run.with(|steps| steps[at].commands[1].records[0].u_mps2 -= 1.0));
    assert_eq!(names, ["world", "controller 1"]);
    // What nobody but the controller looks at.
    let (names, result) = differing(&run.with(|steps| steps[at].commands[0].records[0].plan_a += 1.0));
    assert_eq!(names, ["controller 0"]);
    assert!(result.roles[3].difference.as_ref().unwrap().contains("plan_a"), "{result:?}");
    // A terminal speed the coordinator did not set.
    let zone = run.steps[at].coordination[0].zone;
    let (names, _) = differing(&run.with(|steps| steps[at].coordination[0].flags ^= 1));
    assert_eq!(names[0], format!("coordinator {zone}"));
    // A command the world would have refused.
    let (names, result) = differing(&run.with(|steps| steps[at].commands[0].records[0].vehicle += 50));
    assert_eq!(names, ["world", "controller 0"]);
    assert!(result.roles[0].difference.as_ref().unwrap().contains("does not take"), "{result:?}");
    // A summary one coordinator did not send and the other did not get.
    let told = run.steps.iter().position(|s| !s.summaries.is_empty()).unwrap();
    let (names, _) = differing(&run.with(|steps| steps[told].summaries.clear()));
    assert!(names[0].starts_with("coordinator"), "{names:?}");
    // A controller that did not answer in time is not held to what the world put in its place.
    let late = run.with(|steps| {
        steps[at].misses = 1 << 1;
        steps[at].commands[1].records[0].binding_rows ^= 1;
        steps[at + 1].header.flags |= ipc_schemas::FLAG_MISSED;
    });
    let (names, result) = differing(&late);
    assert_eq!(names, Vec::<String>::new());
    assert_eq!(result.roles[4].inputs_only.map(|(steps, _)| steps), Some(1));
}

#[test]
fn states_no_world_sends_end_a_replay_and_nothing_worse() {
    let run = small();
    let changes: [fn(&mut Step); 6] = [
        |s| s.state[0].entry_speed_mps = 1e300,
        |s| s.state[0].x_m = f64::NAN,
        |s| s.state[0].path = 9,
        |s| s.state[0].zone = 77,
        |s| s.state.reverse(),
        |s| s.header.time_ns = u64::MAX,
    ];
    let busy = |s: &&Step| s.state.len() > 2 && s.state[0].zone != s.state.last().unwrap().zone;
    let at = run.steps.iter().find(busy).unwrap().header.step as usize;
    for (i, change) in changes.into_iter().enumerate() {
        let result = replay(&run.with(|steps| change(&mut steps[at])).reader(), |_| {});
        // No role goes on from there.
        assert!(result.roles.iter().all(|r| r.difference.is_some()), "change {i}: {result:?}");
        assert_eq!(result.roles[0].steps, at as u64, "change {i}");
    }
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
fn a_file_cut_off_anywhere_reads_to_its_last_whole_step() {
    let run = small();
    let count = run.steps.len();
    for cut in run.offsets[count - 2]..run.bytes.len() {
        let what = format!("cut at {cut}");
        let bytes = &run.bytes[..cut];
        let (steps, flaws) = honest(&run, bytes, &what).expect("the head is there");
        let whole = run.offsets[1..].iter().filter(|end| **end <= cut).count() as u64;
        assert_eq!(steps, whole, "{what}");
        let at_a_border = run.offsets.contains(&cut);
        match &flaws[..] {
            [] => assert!(at_a_border, "{what}"),
            // Behind the last step it is the index or the footer that is cut.
            [Flaw::CutOff] => assert!(!at_a_border, "{what}"),
            [Flaw::End] => assert!(cut > run.offsets[count], "{what}"),
            other => panic!("{what}: {other:?}"),
        }
        let reader = Reader::new(bytes).unwrap();
        assert!(reader.footer().is_none() || flaws == [Flaw::End], "{what}");
        for number in whole.saturating_sub(2)..whole {
            assert_eq!(reader.step(number).unwrap().as_ref(), run.steps.get(number as usize), "{what}");
        }
        assert_eq!(reader.step(whole), Ok(None), "{what}");
    }
    // And what is there still replays.
    let result = replay(&Reader::new(&run.bytes[..run.offsets[count - 1] + 9]).unwrap(), |_| {});
    assert!(result.same());
    assert!(matches!(result.stopped, Some(Stop::Damage(d)) if d.flaw == Flaw::CutOff));
    assert_eq!(result.steps, count as u64 - 1);
}

#[test]
fn a_wrong_byte_anywhere_is_noticed_and_spoils_one_step_at_most() {
    let run = small();
    let count = run.steps.len() as u64;
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut refused = 0;
    for _ in 0..10_000 {
        let at = random.random_range(0..run.bytes.len());
        let flip = random.random_range(1..=255_u8);
        let what = format!("byte {at} xor {flip}");
        let mut bytes = run.bytes.clone();
        bytes[at] ^= flip;
        let Some((steps, flaws)) = honest(&run, &bytes, &what) else {
            assert!(at < run.offsets[0], "{what}: refused to open");
            refused += 1;
            continue;
        };
        assert!(!flaws.is_empty(), "{what}: not noticed");
        let in_a_step = at < *run.offsets.last().unwrap();
        assert_eq!(steps, if in_a_step { count - 1 } else { count }, "{what}: {flaws:?}");
        // A step asked for by itself is there exactly if it is among all, also the next ones.
        let reader = Reader::new(&bytes[..]).unwrap();
        let hit = run.offsets.partition_point(|offset| *offset <= at).saturating_sub(1);
        let number = (hit + random.random_range(0..3)).min(count as usize - 1);
        let is_there = reader.steps().flatten().any(|step| step.header.step == number as u64);
        match reader.step(number as u64) {
            Ok(Some(step)) => assert!(is_there && run.steps[number] == step, "{what}: step {number}"),
            missing => assert!(!is_there, "{what}: step {number}: {missing:?}"),
        }
    }
    assert!(refused > 0, "the head was never hit");
}

#[test]
fn exchanged_and_forged_steps_are_noticed() {
    let run = small();
    let other = run.with(|steps| steps[50].state[0].x_m += 1.0);
    // A forged step, sealed as if it had been written there: everything after it tells.
    let range = run.offsets[50]..run.offsets[51];
    let mut bytes = run.bytes.clone();
    bytes[range.clone()].copy_from_slice(&other.bytes[range.clone()]);
    let reader = Reader::new(&bytes[..]).unwrap();
    assert!(matches!(reader.step(51), Err(d) if d.flaw == Flaw::Chain));
    let first = reader.steps().find_map(Result::err).unwrap();
    assert_eq!((first.flaw, first.after), (Flaw::Chain, Some(50)));
    assert!(matches!(replay(&reader, |_| {}).stopped, Some(Stop::Damage(_))));
    // The rest of the other recording as well: the links fit, the footer does not.
    bytes[run.offsets[50]..*run.offsets.last().unwrap()]
        .copy_from_slice(&other.bytes[run.offsets[50]..*run.offsets.last().unwrap()]);
    let reader = Reader::new(&bytes[..]).unwrap();
    let damage: Vec<_> = reader.steps().filter_map(Result::err).map(|d| d.flaw).collect();
    assert_eq!(damage, [Flaw::Footer]);
    // Two steps exchanged.
    let mut swapped = run.bytes[..run.offsets[0]].to_vec();
    for i in [0, 2, 1] {
        swapped.extend_from_slice(&run.bytes[run.offsets[i]..run.offsets[i + 1]]);
    }
    let reader = Reader::new(&swapped[..]).unwrap();
    assert_eq!(reader.steps().filter_map(Result::err).map(|d| d.flaw).next(), Some(Flaw::Chain));
}

#[test]
fn a_tail_that_points_beyond_the_file_is_damage() {
    let run = small();
    let mut bytes = run.bytes.clone();
    let tail = bytes.len() - 24;
    bytes[tail + 8..tail + 16].copy_from_slice(&(1_u64 << 40).to_le_bytes());
    let check = xxhash_rust::xxh3::xxh3_64(&bytes[tail..tail + 16]);
    bytes[tail + 16..].copy_from_slice(&check.to_le_bytes());
    let (steps, flaws) = honest(&run, &bytes, "tail beyond the end").unwrap();
    assert_eq!((steps, &flaws[..]), (run.steps.len() as u64, &[Flaw::End][..]));
}

/// An output that writes nothing until it is let.
#[derive(Clone, Default)]
struct Gated(Arc<Gate>);

#[derive(Default)]
struct Gate {
    /// Whether it is open, and what has passed.
    state: Mutex<(bool, Vec<u8>)>,
    opened: Condvar,
}

impl Gated {
    fn open(&self) {
        self.0.state.lock().unwrap().0 = true;
        self.0.opened.notify_all();
    }

    fn bytes(&self) -> Vec<u8> {
        self.0.state.lock().unwrap().1.clone()
    }
}

impl io::Write for Gated {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut inner = self.0.opened.wait_while(self.0.state.lock().unwrap(), |(open, _)| !*open).unwrap();
        inner.1.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Output for Gated {
    fn sync(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[test]
fn steps_that_come_too_fast_are_left_out_and_reported() {
    let run = small();
    let out = Gated::default();
    let limits = QueueLimits { steps: 4, bytes: 1 << 30 };
    let mut recorder = Recorder::over(out.clone(), run.metadata.clone(), limits);
    let mut refused = Vec::new();
    // Steps 90 to 94 are never even offered.
    for step in run.steps.iter().filter(|s| !(90..95).contains(&s.header.step)) {
        if step.header.step == 120 {
            out.open();
        }
        if step.header.step >= 120 {
            let commands: Vec<_> = step
                .commands
                .iter()
                .map(|c| CommandPart { generation: c.generation, records: &c.records })
                .collect();
            let frames = control_zones::record::StepFrames {
                header: step.header,
                state: &step.state,
                summaries: &[&step.summaries],
                coordination: &[&step.coordination],
                commands: &commands,
                misses: step.misses,
                policy: step.policy,
                state_hash: step.state_hash,
            };
            assert!(recorder.push_or_wait(&frames), "whoever waits is let in");
        } else if !recorder.push_block(step.header.step, &step.encode()) {
            refused.push(step.header.step);
        }
    }
    refused.extend(90..95);
    refused.sort_unstable();
    assert!(refused.len() > 20, "{refused:?}");
    let recorded = recorder.finish(RunEnd::Finished).unwrap();
    let missing: Vec<u64> = recorded.missing.iter().flat_map(|(first, last)| *first..=*last).collect();
    assert_eq!(missing, refused);
    assert_eq!(recorded.missing_steps(), refused.len() as u64);
    let bytes = out.bytes();
    assert_eq!(bytes.len() as u64, recorded.bytes);
    let reader = Reader::new(&bytes[..]).unwrap();
    assert_eq!(reader.footer().unwrap().missing, recorded.missing);
    assert_eq!(reader.gaps(), recorded.missing);
    let (steps, flaws) = honest(&run, &bytes, "with gaps").unwrap();
    assert_eq!((steps, flaws), (recorded.steps, vec![]));
    // Nothing is replayed behind the gap.
    let result = replay(&reader, |_| {});
    assert_eq!(result.stopped, Some(Stop::Gap(recorded.missing[0].0)));
    assert!(result.same());
    assert!(matches!(replay_world(&reader, 150), Err(ReplayError::Missing(step)) if step == refused[0]));
    // The whole recording has more.
    let found = compare(&reader, &run.reader());
    assert_eq!((found.only_first, found.only_second), (0, refused.len() as u64));
    assert!(!found.same() && found.difference.is_none());
}

#[test]
fn a_recorder_that_is_dropped_leaves_what_it_had() {
    let run = small();
    let out = Gated::default();
    out.open();
    let mut recorder = Recorder::over(out.clone(), run.metadata.clone(), QueueLimits::default());
    for step in &run.steps[..40] {
        assert!(recorder.push_block(step.header.step, &step.encode()));
    }
    drop(recorder);
    common::wait_until("the recorder's thread to end", || Arc::strong_count(&out.0) == 1);
    let bytes = out.bytes();
    let (steps, flaws) = honest(&run, &bytes, "dropped").unwrap();
    assert_eq!((steps, flaws), (40, vec![]));
    assert!(Reader::new(&bytes[..]).unwrap().footer().is_none());
}

/// An output that is full after so many bytes.
struct Full(usize);

impl io::Write for Full {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0 = self.0.checked_sub(bytes.len()).ok_or(io::ErrorKind::StorageFull)?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Output for Full {
    fn sync(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[test]
fn a_full_disk_is_an_error_at_the_end_and_stops_nobody() {
    let run = small();
    let mut recorder = Recorder::over(Full(1 << 19), run.metadata.clone(), QueueLimits::default());
    for round in 0..20 {
        for step in &run.steps {
            let number = round * run.steps.len() as u64 + step.header.step;
            let mut step = step.clone();
            step.header.step = number;
            recorder.push_block(number, &step.encode());
        }
    }
    let error = recorder.finish(RunEnd::Finished).unwrap_err().to_string();
    assert!(error.contains("cannot write the recording"), "{error}");
}

#[test]
fn a_recording_of_another_version_is_refused_by_all_who_read_it() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("old.czlog");
    let name = file.to_str().unwrap();
    for (found, version) in [(1_u32, "1"), (3, "3"), (u32::MAX, "4294967295")] {
        let mut bytes = small().bytes;
        bytes[8..12].copy_from_slice(&found.to_le_bytes());
        std::fs::write(&file, &bytes).unwrap();
        for arguments in [
            &["show", name][..],
            &["verify", name, name],
            &["replay", name],
            &["resume", name],
            &["branch", name, "--at", "5", "--set", "objective.beta=1.0"],
        ] {
            let output = Site::new("old").command("cz").args(arguments).output().unwrap();
            let said = String::from_utf8(output.stderr).unwrap();
            let expected = format!(
                "cz: {name}: the recording has format version {version}, this program reads version 2\n"
            );
            assert_eq!((output.status.code(), said), (Some(2), expected), "{arguments:?}");
        }
    }
}

#[test]
fn the_commands_tell_what_is_in_a_file() {
    let site = Site::new("rec");
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    let cz = |arguments: &[&str]| {
        let output = site.command("cz").args(arguments).output().unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
    };
    let (file, other) = (path("a.czlog"), path("b.czlog"));
    let record = |file: &str, arguments: &[&str]| {
        let all = ["run", "--in-process", "--set", "end.vehicles=12", "--json", "-", "--record", file];
        let (code, out, err) = cz(&[&all[..], arguments].concat());
        assert_eq!(code, 0, "{err}");
        assert!(err.contains("recorded") && err.contains(file), "{err}");
        common::hash(&serde_json::from_str(&out).unwrap())
    };
    let hash = record(&file, &[]);
    assert_eq!(record(&other, &["--coord-procs", "2", "--ctrl-procs", "2"]), hash);
    let mode = |path: &str| std::fs::metadata(path).unwrap().permissions().mode() & 0o777;
    assert_eq!(mode(&file), 0o600);

    let (code, out, _) = cz(&["show", &file]);
    assert_eq!(code, 0);
    for word in ["two-merges", "seed 1", "end.vehicles=12", "1 controller", &hash, "every step checked"] {
        assert!(out.contains(word), "no {word:?} in {out}");
    }
    let json = |arguments: &[&str]| -> serde_json::Value {
        let (code, out, err) = cz(arguments);
        assert_eq!(code, 0, "{err}");
        serde_json::from_str(&out).unwrap()
    };
    let shown = json(&["show", &other, "--json"]);
    assert_eq!(shown["state_hash"], hash);
    assert_eq!(shown["whole"], true);
    let step = json(&["show", &file, "--step", "200", "--json"]);
    let reader = Reader::open(file.as_ref()).unwrap();
    let recorded = reader.step(200).unwrap().unwrap();
    assert_eq!(step["state"].as_array().unwrap().len(), recorded.state.len());
    assert_eq!(step["state"][0]["x_m"].as_f64(), Some(recorded.state[0].x_m));
    let (_, out, _) = cz(&["show", &file, "--step", "200"]);
    assert!(out.contains("merge-1.main") && out.contains("verdict"), "{out}");
    let vehicle = recorded.commands[0].records[0].vehicle.to_string();
    let course = json(&["show", &file, "--vehicle", &vehicle, "--json"]);
    assert!(course["course"].as_array().unwrap().iter().any(|row| row["step"] == 200), "{course}");
    let (_, out, _) = cz(&["show", &file, "--vehicle", &vehicle]);
    assert!(out.contains("OCBF"), "{out}");
    let (_, out, _) = cz(&["show", &file, "--scenario"]);
    assert!(out.contains("--set end.vehicles=12") && out.contains("[[zones]]"), "{out}");

    assert_eq!(cz(&["verify", &file, &other]).0, 0);
    let (code, out, _) = cz(&["replay", &other]);
    assert_eq!(code, 0, "{out}");
    assert!(out.contains("coordinator 1") && out.contains(&hash), "{out}");
    assert_eq!(json(&["replay", &file, "--json"])["same"], true);

    // Another seed is another run.
    record(&other, &["--seed", "2"]);
    let (code, out, err) = cz(&["verify", &file, &other]);
    assert_eq!(code, 1, "{out}");
    assert!(out.contains("scenarios differ") && out.contains("first difference: step 1, vehicle 0"), "{out}");
    assert!(err.contains("differ"), "{err}");

    // Damage and a cut.
    let mut bytes = std::fs::read(&file).unwrap();
    bytes.truncate(bytes.len() * 2 / 3);
    std::fs::write(&other, &bytes).unwrap();
    let (code, out, _) = cz(&["show", &other]);
    assert!(code == 0 && out.contains("cut off") && out.contains("whole       no"), "{out}");
    assert_eq!(cz(&["replay", &other]).0, 0);
    assert_eq!(cz(&["verify", &file, &other]).0, 1);
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&other, &bytes).unwrap();
    for command in [&["show", &other][..], &["replay", &other], &["verify", &file, &other]] {
        let (code, _, err) = cz(command);
        assert!(code == 2 && err.contains("damaged at byte"), "{command:?}: {err}");
    }

    // What is no recording is neither read nor replaced.
    let text = path("notes.txt");
    std::fs::write(&text, "notes").unwrap();
    assert_eq!(cz(&["show", &text]).0, 2);
    let (code, _, err) = cz(&["run", "--in-process", "--record", &text]);
    assert!(code == 2 && err.contains("not a recording"), "{err}");
    assert_eq!(std::fs::read_to_string(&text).unwrap(), "notes");
    // One that others may read is replaced by one they may not.
    std::fs::set_permissions(&other, PermissionsExt::from_mode(0o644)).unwrap();
    record(&other, &[]);
    assert_eq!(mode(&other), 0o600);
    for arguments in [&["show", &file, "--step", "99999"][..], &["show", &file, "--vehicle", "99999"]] {
        let (code, _, err) = cz(arguments);
        assert!(code == 2 && err.contains("99999"), "{err}");
    }
}
