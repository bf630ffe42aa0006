//! The ways of waiting: nobody drives differently, nothing is left, and whoever writes to the bells stops nobody.

use crate::common::{LONG_RUN, TestRun, hash, wait_until};
use std::io::{Seek, Write};

const MODES: [&str; 3] = ["adaptive", "hybrid", "block"];

#[test]
fn states_are_the_same_however_processes_wait() {
    let test_run = TestRun::new("wait");
    for (scenario, shares) in
        [("two-merges", &[][..]), ("corridor-8", &["--coord-procs", "3", "--ctrl-procs", "4"])]
    {
        let alone = test_run.summary(&[&[scenario, "--in-process"][..], shares].concat());
        let default = test_run.summary(&[&[scenario][..], shares].concat());
        assert_eq!(hash(&default), hash(&alone), "{scenario}");
        for mode in MODES {
            let summary = test_run.summary(&[&[scenario, "--wait", mode][..], shares].concat());
            assert_eq!(hash(&summary), hash(&alone), "{scenario}, {mode}");
        }
    }
    test_run.assert_clean();
}

#[test]
fn a_paced_run_in_which_everybody_sleeps_has_all_its_steps() {
    let test_run = TestRun::new("paced");
    for mode in MODES {
        let arguments = ["two-merges", "--wait", mode, "--pace", "realtime", "--set", "dt_s=0.01"];
        let end = ["--set", "end.time_s=1", "--set", "end.vehicles=600"];
        let summary = test_run.summary(&[&arguments[..], &end].concat());
        assert_eq!(summary["steps"], 100, "{mode}: {summary}");
    }
    test_run.assert_clean();
}

#[test]
fn what_a_stranger_writes_to_the_bells_changes_nothing() {
    let test_run = TestRun::new("bells");
    for mode in ["adaptive", "block"] {
        let expected =
            test_run.summary(&[&LONG_RUN[..], &["--set", "end.time_s=2000", "--in-process"]].concat());
        let arguments =
            [&["--json", "-", "--wait", mode][..], &LONG_RUN, &["--set", "end.time_s=2000"]].concat();
        let run = test_run.start("cz", &arguments);
        let bells = || test_run.files().into_iter().find(|path| path.to_string_lossy().ends_with("_bells"));
        wait_until("the run to have bells", || bells().is_some());
        let mut file = std::fs::OpenOptions::new().write(true).open(bells().unwrap()).unwrap();
        let length = file.metadata().unwrap().len() as usize;
        for word in [0u32, 1, 2, u32::MAX, 1, 0].into_iter().cycle().take(600) {
            file.rewind().unwrap();
            file.write_all(&word.to_ne_bytes().repeat(length / 4)).unwrap();
        }
        let summary = run.ended().json();
        assert_eq!(hash(&summary), hash(&expected), "{mode}");
    }
    test_run.assert_clean();
}
