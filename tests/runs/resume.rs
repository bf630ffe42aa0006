//! Runs that were cut short go on from their recordings; runs with late controllers replay as they were.

use crate::common::{LONG_RUN, Process, TestRun, children, is_alive, part, send, wait_until};
use control_zones::record::{Reader, Writer};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rustix::process::Signal;
use std::path::{Path, PathBuf};
use std::process::{Output, Stdio};
use std::time::Duration;

fn in_process(test_run: &TestRun, arguments: &[&str]) -> String {
    crate::common::hash(&test_run.summary(&[arguments, &["--in-process"]].concat()))
}

fn begin(
    test_run: &TestRun,
    arguments: &[&str],
    file: &Path,
    processes: usize,
) -> (Process, Vec<(String, u32)>) {
    crate::common::begin(test_run, &[arguments, &["--record", file.to_str().unwrap()]].concat(), processes)
}

fn cz(test_run: &TestRun, arguments: &[&str]) -> Output {
    test_run.command("cz").args(arguments).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Resumes a recording and returns the hash the run ends with.
fn resumed(test_run: &TestRun, file: &Path) -> String {
    let output = cz(test_run, &["resume", file.to_str().unwrap(), "--json", "-"]);
    assert!(output.status.success(), "{output:?}");
    crate::common::hash(&serde_json::from_slice(&output.stdout).unwrap())
}

/// A file in a directory of its own.
fn file(directory: &tempfile::TempDir) -> PathBuf {
    directory.path().join("run.czlog")
}

/// Kills the world, or the supervisor, that many times at random instants of a run each, and resumes.
fn cut_short(times: usize, victim: &str, shares: &[&str], processes: usize) {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let reference = TestRun::new("u");
    let expected = in_process(&reference, &LONG_RUN);
    let mut steps = Vec::new();
    while steps.len() < times {
        let directory = tempfile::tempdir().unwrap();
        let (test_run, file) = (TestRun::new("cut"), file(&directory));
        let (supervisor, parts) = begin(&test_run, &[&LONG_RUN[..], shares].concat(), &file, processes);
        let world = part(&parts, "world");
        // Before its first step there is nothing to go on from.
        wait_until("the world to be stepping", || file.exists() || !is_alive(world));
        std::thread::sleep(Duration::from_millis(rng.random_range(0..150)));
        let id = if victim == "supervisor" { supervisor.id() } else { world };
        if is_alive(id) {
            send(id, Signal::KILL);
        }
        let ended = supervisor.ended();
        if ended.status.success() {
            continue; // it was over before
        }
        wait_until("the others to end", || parts.iter().all(|(_, id)| !is_alive(*id)));
        let shown = cz(&test_run, &["show", file.to_str().unwrap()]);
        assert!(shown.status.success(), "{shown:?}");
        assert_eq!(resumed(&test_run, &file), expected, "{ended:?}");
        let said = text(&cz(&test_run, &["show", file.to_str().unwrap(), "--json"]).stdout);
        steps.push(serde_json::from_str::<serde_json::Value>(&said).unwrap()["steps"].as_u64().unwrap());
        assert!(cz(&test_run, &["clean"]).status.success());
        test_run.assert_clean();
    }
    println!("{victim} {shares:?}: killed after {steps:?} steps; resumed to the same hash each time");
}

#[test]
fn a_run_whose_world_is_killed_is_resumed_to_the_same_hash() {
    cut_short(2, "world", &[], 3);
    cut_short(1, "world", &["--ctrl-procs", "2", "--coord-procs", "2"], 5);
}

#[test]
fn a_run_whose_supervisor_is_killed_is_resumed_to_the_same_hash() {
    cut_short(2, "supervisor", &[], 3);
    cut_short(1, "supervisor", &["--ctrl-procs", "2", "--coord-procs", "2"], 5);
}

#[test]
#[ignore = "takes minutes: world and supervisor killed at 20 random steps each"]
fn cut_short_twenty_times_each() {
    cut_short(20, "world", &[], 3);
    cut_short(20, "supervisor", &[], 3);
}

/// Starts `cz resume FILE --record OUT` and kills its world in the middle.
fn resume_cut_short(test_run: &TestRun, file: &Path, out: &Path) {
    let arguments = ["resume", file.to_str().unwrap(), "--record", out.to_str().unwrap()];
    let mut supervisor =
        test_run.command("cz").args(arguments).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let past = steps_in(file);
    wait_until("the resumed run to be ahead of its past", || {
        assert!(supervisor.try_wait().unwrap().is_none(), "the resumed run was over before it was killed");
        out.exists() && steps_in(out) > past + 1000
    });
    let parts = children(supervisor.id());
    let world = parts.iter().find(|(_, line)| line.get(1).is_some_and(|part| part == "world")).unwrap().0;
    send(world, Signal::KILL);
    assert!(!supervisor.wait().unwrap().success());
    wait_until("the others to end", || parts.iter().all(|(id, _)| !is_alive(*id)));
}

/// Steps of a recording that may still be written; none while its head is not there.
fn steps_in(file: &Path) -> u64 {
    Reader::open(file).map_or(0, |reader| reader.steps().map_while(Result::ok).count() as u64)
}

/// Those of them in which somebody missed the deadline.
fn missed_in(file: &Path) -> usize {
    let missed = |reader: Reader<_>| reader.steps().map_while(Result::ok).filter(|s| s.misses != 0).count();
    Reader::open(file).map_or(0, missed)
}

#[test]
fn a_resumed_run_is_recorded_with_its_past_and_can_be_resumed_again() {
    let (test_run, directory) = (TestRun::new("rr"), tempfile::tempdir().unwrap());
    let path = |name: &str| directory.path().join(name);
    let (undisturbed, first, second, last) = (path("u"), path("1"), path("2"), path("3"));
    let of = |path: &Path| path.to_str().unwrap().to_owned();
    let expected =
        crate::common::hash(&test_run.summary(&[&LONG_RUN[..], &["--record", &of(&undisturbed)]].concat()));
    let (supervisor, parts) = begin(&test_run, &LONG_RUN, &first, 3);
    wait_until("the run to be under way", || steps_in(&first) > 1000);
    send(part(&parts, "world"), Signal::KILL);
    assert!(!supervisor.ended().status.success());
    wait_until("the others to end", || parts.iter().all(|(_, id)| !is_alive(*id)));
    resume_cut_short(&test_run, &first, &second);
    let output = cz(&test_run, &["resume", &of(&second), "--record", &of(&last), "--json", "-"]);
    assert!(output.status.success(), "{output:?}");
    assert_eq!(crate::common::hash(&serde_json::from_slice(&output.stdout).unwrap()), expected);
    // The last recording is one of the whole run, and nothing in it tells that it was interrupted twice.
    let output = cz(&test_run, &["verify", &of(&undisturbed), &of(&last)]);
    assert!(output.status.success(), "{output:?}");
    let output = cz(&test_run, &["replay", &of(&last)]);
    assert!(output.status.success() && text(&output.stdout).contains(&expected), "{output:?}");
    let output = cz(&test_run, &["show", &of(&last)]);
    assert!(output.status.success(), "{output:?}");
    let reader = Reader::open(&last).unwrap();
    let run_id = reader.metadata().run_id;
    assert!(reader.steps().all(|step| step.unwrap().header.run_id == run_id));
    assert_ne!(run_id, Reader::open(&first).unwrap().metadata().run_id);
    assert!(cz(&test_run, &["clean"]).status.success());
    test_run.assert_clean();
}

#[test]
fn a_resumed_run_is_not_recorded_over_its_own_past() {
    let (test_run, directory) = (TestRun::new("own"), tempfile::tempdir().unwrap());
    let file = file(&directory);
    test_run.summary(&["--in-process", "--record", file.to_str().unwrap()]);
    let whole = std::fs::read(&file).unwrap();
    let cut = &whole[..whole.len() / 2];
    std::fs::write(&file, cut).unwrap();
    let alias = directory.path().join("alias.czlog");
    std::os::unix::fs::symlink(&file, &alias).unwrap();
    for out in [&file, &alias] {
        let output = cz(&test_run, &["resume", file.to_str().unwrap(), "--record", out.to_str().unwrap()]);
        assert_eq!(output.status.code(), Some(2), "{output:?}");
        let said = text(&output.stderr);
        assert!(said.contains("--record") && said.contains("another file"), "{said}");
        assert_eq!(std::fs::read(&file).unwrap(), cut);
    }
}

#[test]
fn a_run_cut_off_behind_a_missed_step_goes_on_as_if_it_had_not_been() {
    let (test_run, directory) = (TestRun::new("mc"), tempfile::tempdir().unwrap());
    let (file, cut, out) =
        (file(&directory), directory.path().join("cut.czlog"), directory.path().join("out.czlog"));
    // Nobody waits for its end.
    let arguments = [&paced("end.time_s=300")[..], &["--on-miss", "hold", "--record-lag", "wait"]].concat();
    let (supervisor, parts) = begin(&test_run, &arguments, &file, 3);
    wait_until("vehicles to be on the road", || steps_in(&file) > 250);
    send(part(&parts, "ctrl"), Signal::STOP);
    wait_until("a missed step to be recorded", || missed_in(&file) > 0);
    send(part(&parts, "ctrl"), Signal::CONT);
    supervisor.signal(Signal::INT);
    supervisor.ended().expect(130, &["cz resume"]);
    let reader = Reader::open(&file).unwrap();
    let mut writer = Writer::new(std::fs::File::create(&cut).unwrap(), reader.metadata()).unwrap();
    let mut steps = reader.steps().map(Result::unwrap);
    let missed = loop {
        let step = steps.next().unwrap();
        writer.append(&step.encode()).unwrap();
        if step.misses != 0 {
            break step.header.step;
        }
    };
    drop(writer);
    let output = cz(&test_run, &["resume", cut.to_str().unwrap(), "--record", out.to_str().unwrap()]);
    assert!(output.status.success(), "{output:?}");
    let output = cz(&test_run, &["replay", out.to_str().unwrap()]);
    assert!(output.status.success(), "missed step {missed}: {output:?}");
    test_run.assert_clean();
}

#[test]
fn a_run_that_is_complete_cannot_be_resumed() {
    let (test_run, directory) = (TestRun::new("c"), tempfile::tempdir().unwrap());
    let file = file(&directory);
    let summary = test_run.summary(&["--record", file.to_str().unwrap()]);
    let output = cz(&test_run, &["resume", file.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    assert!(text(&output.stderr).contains("the run is complete"), "{output:?}");
    // It replays to the hash it ended with.
    let output = cz(&test_run, &["replay", file.to_str().unwrap()]);
    assert!(output.status.success(), "{output:?}");
    assert!(text(&output.stdout).contains(&crate::common::hash(&summary)), "{output:?}");
}

#[test]
fn processes_and_one_process_record_the_same() {
    let (test_run, directory) = (TestRun::new("s"), tempfile::tempdir().unwrap());
    let one = directory.path().join("one.czlog");
    test_run.summary(&["tree", "--in-process", "--record", one.to_str().unwrap()]);
    for (i, shares) in [&[][..], &["--ctrl-procs", "2", "--coord-procs", "2"]].into_iter().enumerate() {
        let many = directory.path().join(format!("{i}.czlog"));
        test_run.summary(&[&["tree", "--record", many.to_str().unwrap()], shares].concat());
        let output = cz(&test_run, &["verify", one.to_str().unwrap(), many.to_str().unwrap()]);
        assert!(output.status.success(), "{output:?}");
        let output = cz(&test_run, &["replay", many.to_str().unwrap()]);
        assert!(output.status.success(), "{output:?}");
    }
}

#[test]
fn a_branch_shares_the_past_and_not_the_future() {
    let (test_run, directory) = (TestRun::new("b"), tempfile::tempdir().unwrap());
    let file = file(&directory);
    let whole = crate::common::hash(&test_run.summary(&["--record", file.to_str().unwrap()]));
    let branch = |at: &str, set: &str| {
        let path = file.to_str().unwrap();
        cz(&test_run, &["branch", path, "--at", at, "--set", set, "--json"])
    };
    let output = branch("1500", "coordination.price_of_time=0");
    assert!(output.status.success(), "{output:?}");
    let both: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let hash = |name: &str| format!("{:016x}", both[name]["state_hash"].as_u64().unwrap());
    assert_eq!(hash("as_recorded"), whole);
    assert_ne!(hash("branched"), whole);
    // Nothing changed, nothing different; changed at the very end, too late to matter.
    let same = branch("700", "control.k_merge_per_s=1.0");
    let both: serde_json::Value = serde_json::from_slice(&same.stdout).unwrap();
    assert_eq!(both["as_recorded"], both["branched"]);
    // What cannot be changed is said.
    for (set, word) in [("dt_s=0.2", "dt_s"), ("seed=3", "seed")] {
        let output = branch("700", set);
        assert_eq!(output.status.code(), Some(2), "{output:?}");
        assert!(text(&output.stderr).contains(word), "{output:?}");
    }
    assert_eq!(branch("700000", "beta=1.0").status.code(), Some(2));
}

/// A paced run with traffic from the start.
fn paced(end: &str) -> [&str; 11] {
    let demand = "roads.main1.demand.rates=[{until_s=300.0,vehicles_per_hour=1700.0}]";
    let set = ["--set", end, "--set", "dt_s=0.01", "--set", demand];
    let [a, b, c, d, e, f] = set;
    ["varying-demand", a, b, c, d, e, f, "--pace", "realtime", "--json", "-"]
}

#[test]
fn a_stopped_controller_is_dealt_with_as_the_policy_says_and_replayed_alike() {
    for policy in ["wait", "hold", "shield-fallback", "abort"] {
        let (test_run, directory) = (TestRun::new("miss"), tempfile::tempdir().unwrap());
        let file = file(&directory);
        // A machine with much else to do must not end the run before anybody is stopped.
        let deadline = if policy == "abort" { "2" } else { "0.01" };
        let conduct = ["--on-miss", policy, "--deadline", deadline, "--record-lag", "wait"];
        let arguments = [&paced("end.time_s=8")[..], &conduct].concat();
        let (supervisor, parts) = begin(&test_run, &arguments, &file, 3);
        let controller = part(&parts, "ctrl");
        wait_until("vehicles to be on the road", || steps_in(&file) > 250);
        send(controller, Signal::STOP);
        match policy {
            // Its step is late once a deadline has passed, and is waited for all the same.
            "wait" => std::thread::sleep(Duration::from_millis(500)),
            // It is ended, stopped as it is.
            "abort" => {}
            _ => wait_until("ten missed steps to be recorded", || missed_in(&file) >= 10),
        }
        if policy != "abort" {
            send(controller, Signal::CONT);
        }
        let ended = supervisor.ended();
        if policy == "abort" {
            ended.expect(1, &["the deadline of step", "controller 0"]);
        } else {
            let summary = ended.json();
            let by = &summary["punctuality"]["missed_by"];
            assert_eq!(by[0]["participant"], "controller 0", "{summary}");
            assert!(by[0]["steps"].as_u64().unwrap() >= 1, "{summary}");
            if policy != "wait" {
                assert!(by[0]["steps"].as_u64().unwrap() >= 10, "{summary}");
            }
            let replay = cz(&test_run, &["replay", file.to_str().unwrap()]);
            assert!(replay.status.success(), "{policy}: {replay:?}");
            assert!(text(&replay.stdout).contains(&crate::common::hash(&summary)), "{policy}: {replay:?}");
            assert_eq!(text(&replay.stdout).contains("did not answer in time"), policy != "wait");
        }
        test_run.assert_clean();
    }
}

#[test]
fn a_paced_run_has_the_hash_of_a_free_one() {
    let test_run = TestRun::new("pace");
    let free: Vec<&str> =
        paced("end.time_s=4").into_iter().filter(|a| !["--pace", "realtime"].contains(a)).collect();
    let expected = crate::common::hash(&test_run.start("cz", &free).ended().json());
    let summary =
        test_run.start("cz", &[&paced("end.time_s=4")[..], &["--deadline", "10"]].concat()).ended().json();
    assert_eq!(crate::common::hash(&summary), expected);
    assert_eq!(summary["punctuality"]["lateness_ns"]["count"], 401);
    assert!(summary["wall_s"].as_f64().unwrap() >= 4.0, "{summary}");
}

#[test]
fn a_policy_without_a_deadline_is_refused() {
    let test_run = TestRun::new("pol");
    let output = cz(&test_run, &["run", "--on-miss", "hold"]);
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    assert!(text(&output.stderr).contains("--deadline"), "{output:?}");
}
