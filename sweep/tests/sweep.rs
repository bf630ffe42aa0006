//! Sweeps by the program: the table is the same whoever did the runs, and nothing is lost.

#![allow(clippy::unwrap_used)]

use arrow_array::cast::AsArray;
use arrow_array::types::{Float64Type, UInt64Type};
use arrow_array::{Array, RecordBatch};
use control_zones::compare::sample::Sample;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

const POLICIES: [&str; 3] = ["paper-none", "paper-fixed-17", "viable"];

fn cz_sweep() -> Command {
    Command::new(env!("CARGO_BIN_EXE_cz-sweep"))
}

/// The sweep that is tested: 3 policies by 4 seeds on a small part of the paper's road.
fn sweep(directory: &Path, more: &[&str]) -> Output {
    let mut command = cz_sweep();
    command.args(POLICIES).args(["--scenario", "paper", "--seeds", "1-4", "--set", "end.vehicles=12"]);
    command.arg("--out").arg(directory).args(more).output().unwrap()
}

fn bytes(directory: &Path) -> Vec<u8> {
    std::fs::read(directory.join("sweep.parquet")).unwrap()
}

fn table(directory: &Path) -> RecordBatch {
    let file = std::fs::File::open(directory.join("sweep.parquet")).unwrap();
    ParquetRecordBatchReaderBuilder::try_new(file).unwrap().build().unwrap().next().unwrap().unwrap()
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

#[test]
fn the_table_has_a_row_per_run_with_what_the_run_showed() {
    let place = tempfile::tempdir().unwrap();
    let output = sweep(place.path(), &["--jobs", "2"]);
    assert!(output.status.success() && said(&output).contains("12 runs, 0 failed"), "{}", said(&output));
    let table = table(place.path());
    assert_eq!(table.num_rows(), 12);
    let text =
        |row: usize, name: &str| table.column_by_name(name).unwrap().as_string::<i32>().value(row).to_owned();
    let seeds = table.column_by_name("seed").unwrap().as_primitive::<UInt64Type>().values().to_vec();
    assert_eq!(seeds, [1, 2, 3, 4, 1, 2, 3, 4, 1, 2, 3, 4]);
    for (row, &seed) in seeds.iter().enumerate() {
        assert_eq!(text(row, "policy"), POLICIES[row / 4]);
        let sets: Vec<String> = text(row, "sets").lines().map(str::to_owned).collect();
        let scenario = control_zones::compare::load(Some("paper"), seed, &sets).unwrap();
        let sample = Sample::of(&scenario, "the same").unwrap();
        assert_eq!(text(row, "state_hash"), format!("{:016x}", sample.state_hash), "row {row}: {sets:?}");
        let total = table.column_by_name("total").unwrap().as_primitive::<Float64Type>().value(row);
        assert_eq!(total.to_bits(), sample.total().to_bits());
        assert!(table.column_by_name("failure").unwrap().is_null(row));
    }
}

#[test]
fn it_goes_on_where_it_was_and_the_table_is_the_same_to_the_byte() {
    let (once, again) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    assert!(sweep(once.path(), &["--jobs", "2"]).status.success());
    // Interrupted as hard as can be, after the first outcomes.
    let runs = again.path().join("runs");
    let mut command = cz_sweep();
    command.args(POLICIES).args(["--scenario", "paper", "--seeds", "1-4", "--set", "end.vehicles=12"]);
    let mut first = command.arg("--out").arg(again.path()).args(["--jobs", "1"]).spawn().unwrap();
    let kept = || std::fs::read_dir(&runs).map_or(0, |files| files.count());
    while kept() < 2 && first.try_wait().unwrap().is_none() {
        std::thread::sleep(Duration::from_millis(1));
    }
    first.kill().unwrap();
    first.wait().unwrap();
    assert!(sweep(again.path(), &["--jobs", "3"]).status.success());
    assert!(bytes(once.path()) == bytes(again.path()));
    // Nothing is done that is there; what is broken is done again.
    assert_eq!(said(&sweep(again.path(), &["--missing"])), "");
    let file = std::fs::read_dir(&runs).unwrap().next().unwrap().unwrap().path();
    std::fs::write(&file, "broken").unwrap();
    let missing = said(&sweep(again.path(), &["--missing"]));
    assert!(missing.lines().count() <= 4 && missing.contains("\"run\":\"policy "), "{missing}");
    std::fs::remove_file(again.path().join("sweep.parquet")).unwrap();
    assert!(sweep(again.path(), &[]).status.success());
    assert!(bytes(once.path()) == bytes(again.path()));
}

#[test]
fn the_run_of_a_worker_that_is_killed_is_done_by_another() {
    let (once, again) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    assert!(sweep(once.path(), &[]).status.success());
    let mut command = cz_sweep();
    command.args(POLICIES).args(["--scenario", "paper", "--seeds", "1-4", "--set", "end.vehicles=12"]);
    let mut parent = command.arg("--out").arg(again.path()).args(["--jobs", "2"]).spawn().unwrap();
    let mut killed = 0;
    while parent.try_wait().unwrap().is_none() {
        for child in children(parent.id()) {
            // It may be gone already, or killed a moment ago.
            if killed < 2 && is_worker(child) && kill(child) {
                killed += 1;
                std::thread::sleep(Duration::from_millis(20));
            }
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    assert!(parent.wait().unwrap().success() && killed > 0, "{killed} killed");
    assert!(bytes(once.path()) == bytes(again.path()));
}

/// Processes whose parent this is.
fn children(parent: u32) -> Vec<u32> {
    let tasks = std::fs::read_dir(format!("/proc/{parent}/task"));
    let lists = tasks
        .into_iter()
        .flatten()
        .filter_map(|task| std::fs::read_to_string(task.ok()?.path().join("children")).ok());
    lists
        .flat_map(|list| list.split_whitespace().filter_map(|id| id.parse().ok()).collect::<Vec<_>>())
        .collect()
}

/// Whether it has become a worker: between fork and exec it is still its parent's copy.
fn is_worker(process: u32) -> bool {
    std::fs::read(format!("/proc/{process}/cmdline"))
        .is_ok_and(|line| line.windows(8).any(|w| w == b"--worker"))
}

fn kill(process: u32) -> bool {
    Command::new("kill").args(["-9", &process.to_string()]).status().unwrap().success()
}

#[test]
fn runs_that_fail_for_good_are_named_and_the_others_are_in_the_table() {
    let place = tempfile::tempdir().unwrap();
    // No run is done within no time.
    let output = sweep(place.path(), &["--run-timeout", "0", "--retries", "1"]);
    let words = said(&output);
    assert!(output.status.code() == Some(1) && words.contains("no outcome within 0 s"), "{words}");
    assert!(sweep(place.path(), &["--jobs", "1"]).status.success());
    let mut more = cz_sweep();
    more.args(["viable", "--scenario", "paper", "--seeds", "1-5", "--set", "end.vehicles=12"]);
    let output =
        more.arg("--out").arg(place.path()).args(["--run-timeout", "0", "--retries", "0"]).output().unwrap();
    assert!(said(&output).contains("1 runs failed") && said(&output).contains("seed 5"), "{}", said(&output));
    let table = table(place.path());
    let failure = table.column_by_name("failure").unwrap().as_string::<i32>();
    assert_eq!((table.num_rows(), failure.null_count()), (5, 4));
    assert_eq!(failure.value(4), "no outcome within 0 s");
}

#[test]
fn a_worker_answers_every_line_and_mistakes_are_named() {
    let mut worker = cz_sweep().arg("--worker").stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let other = r#"{"run":"a","file":"b","build":"0","scenario":"00"}"#;
    worker.stdin.take().unwrap().write_all(format!("nonsense\n{other}\n").as_bytes()).unwrap();
    let output = worker.wait_with_output().unwrap();
    let answers = said(&output);
    assert!(output.status.success() && answers.lines().count() == 2, "{answers}");
    assert!(answers.lines().all(|line| line.starts_with("{\"failure\":")), "{answers}");
    let place = tempfile::tempdir().unwrap();
    for (more, words) in [
        (&["--scenario", "none-such"][..], "none-such"),
        (
            &["--seeds", "0-0", "--set", "controllers=[{name=\"a\", zones=[\"merge-1\"], command=\"true\"}]"],
            "no part of a sweep",
        ),
        (&["--seeds", "x"], "expected a number"),
    ] {
        let output = cz_sweep().arg("viable").args(more).arg("--out").arg(place.path()).output().unwrap();
        assert!(output.status.code() == Some(2) && said(&output).contains(words), "{}", said(&output));
    }
}
