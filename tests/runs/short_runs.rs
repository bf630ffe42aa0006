//! Runs so short that their last frame is sent before everybody has looked for the first.

use crate::common::TestRun;
use control_zones::record::{Reader, Writer};
use std::path::Path;

/// Scenarios with their numbers of processes.
const SHORT: [&[&str]; 4] = [
    &["corridor-8", "--coord-procs", "2", "--set", "end.time_s=0.5"],
    &["tree", "--coord-procs", "3", "--set", "end.time_s=2"],
    &["corridor-8", "--coord-procs", "4", "--ctrl-procs", "4", "--set", "end.time_s=5"],
    &["corridor-8", "--coord-procs", "4", "--wait", "block", "--set", "end.time_s=0.1"],
];

fn short_runs(times: usize) {
    for arguments in SHORT {
        let expected = crate::common::hash(&TestRun::new("u").summary(&in_process(arguments)));
        for _ in 0..times {
            let test_run = TestRun::new("short");
            assert_eq!(crate::common::hash(&test_run.summary(arguments)), expected, "{arguments:?}");
            test_run.assert_clean();
        }
        println!("{times} of {times}: {arguments:?}");
    }
}

/// The same run in one process.
fn in_process<'a>(arguments: &[&'a str]) -> Vec<&'a str> {
    let mut own = arguments.to_vec();
    if let Some(at) = own.iter().position(|a| *a == "--wait") {
        own.drain(at..at + 2);
    }
    own.push("--in-process");
    own
}

/// Copies the first steps of a recording.
fn cut(file: &Path, steps: usize, to: &Path) {
    let reader = Reader::open(file).unwrap();
    let mut writer = Writer::new(std::fs::File::create(to).unwrap(), reader.metadata()).unwrap();
    for step in reader.steps().take(steps) {
        let step = step.unwrap();
        writer.append(&step.encode()).unwrap();
    }
    writer.flush().unwrap();
}

fn late_resumes(times: usize) {
    let test_run = TestRun::new("late");
    let directory = tempfile::tempdir().unwrap();
    let (whole, part) = (directory.path().join("whole.czlog"), directory.path().join("part.czlog"));
    let arguments =
        ["tree", "--coord-procs", "3", "--ctrl-procs", "2", "--set", "end.time_s=30", "--in-process"];
    let expected = crate::common::hash(
        &test_run.summary(&[&arguments[..], &["--record", whole.to_str().unwrap()]].concat()),
    );
    let steps = Reader::open(&whole).unwrap().steps().count();
    for i in 0..times {
        // Five steps or fewer are left, the last one among them, which nobody answers.
        cut(&whole, steps - 1 - i % 5, &part);
        let output =
            test_run.command("cz").args(["resume", part.to_str().unwrap(), "--json", "-"]).output().unwrap();
        assert!(output.status.success(), "{} steps left: {output:?}", 1 + i % 5);
        let summary = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(crate::common::hash(&summary), expected, "{} steps left", 1 + i % 5);
    }
    println!("{times} of {times}: resumed with one to five steps left");
}

#[test]
fn short_runs_of_several_processes_end_well() {
    short_runs(4);
}

#[test]
fn runs_resumed_just_before_their_end_end_well() {
    late_resumes(5);
}

#[test]
#[ignore = "takes minutes: 200 short runs of each kind and 200 late resumptions"]
fn two_hundred_short_runs_and_late_resumptions() {
    short_runs(200);
    late_resumes(200);
}
