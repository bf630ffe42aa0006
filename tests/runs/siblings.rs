//! Commands that are programs of their own: `cz NAME` runs `cz-NAME` beside it.

use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::Mutex;

/// A program that is still open for writing cannot be started, and a process being started by one thread still
/// has open what another is writing; so the tests write and start one at a time.
static ALONE: Mutex<()> = Mutex::new(());

/// A `cz` in a directory of its own, with nothing beside it.
fn alone(directory: &Path) -> PathBuf {
    let program = directory.join("cz");
    std::fs::copy(env!("CARGO_BIN_EXE_cz"), &program).unwrap();
    program
}

/// Puts a program of this name beside it, which says what it was given and ends with this code.
fn put_beside(directory: &Path, name: &str, code: u8) {
    let sibling = directory.join(name);
    std::fs::write(&sibling, format!("#!/bin/sh\nprintf '%s|' \"$@\"\nexit {code}\n")).unwrap();
    std::fs::set_permissions(&sibling, PermissionsExt::from_mode(0o755)).unwrap();
}

/// Runs it as somebody would who has no cargo.
fn run(program: &Path, arguments: &[&str]) -> Output {
    Command::new(program)
        .args(arguments)
        .env_remove("CARGO")
        .env_remove("CARGO_MANIFEST_DIR")
        .output()
        .unwrap()
}

#[test]
fn a_program_that_is_not_there_is_named_with_what_makes_it() {
    let _alone = ALONE.lock();
    let directory = tempfile::tempdir().unwrap();
    let output = run(&alone(directory.path()), &["report", "a.czlog"]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), said.lines().count()), (Some(2), 1), "{said}");
    assert!(said.contains("cz-report is not there") && said.contains("--package cz-export"), "{said}");
}

#[test]
fn arguments_and_exit_code_go_through_as_they_are() {
    let _alone = ALONE.lock();
    let directory = tempfile::tempdir().unwrap();
    let program = alone(directory.path());
    put_beside(directory.path(), "cz-export", 7);
    let output = run(&program, &["export", "a b.czlog", "--to", "fcd", "--help", "-V", "--", "--out"]);
    let said = String::from_utf8(output.stdout).unwrap();
    assert_eq!((output.status.code(), said.as_str()), (Some(7), "a b.czlog|--to|fcd|--help|-V|--|--out|"));
}

#[test]
fn a_run_with_a_view_is_started_by_the_view() {
    let _alone = ALONE.lock();
    let directory = tempfile::tempdir().unwrap();
    let program = alone(directory.path());
    put_beside(directory.path(), "cz-view", 0);
    let output = run(&program, &["run", "--pace", "realtime", "--view", "intersection", "--seed", "2"]);
    let said = String::from_utf8(output.stdout).unwrap();
    assert_eq!(said, "--|--pace|realtime|intersection|--seed|2|");
}
