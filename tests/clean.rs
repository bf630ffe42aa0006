//! `cz clean` removes what killed runs have left, and nothing else; and what runs create is private.

#![allow(clippy::unwrap_used)] // in helpers as in the tests themselves

mod common;

use common::{Process, TestRun, children, files, is_alive, send, wait_until};
use rustix::process::Signal;
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// Measurements have no place of their own, so one test would clean up what another has laid out.
static ALONE: Mutex<()> = Mutex::new(());

/// At the pace of its clock a run is certainly under way when it is killed.
const PACED: &[&str] = &["--pace", "realtime"];

/// Starts a run that ends by itself only after a while, and waits until all its parts are there.
fn start_long(test_run: &TestRun, run: &str, more: &[&str]) -> (Process, Vec<(String, u32)>) {
    let supervisor = test_run.start_in("cz", run, &[&["corridor-8", "--peer-timeout", "60"], more].concat());
    let mut parts = Vec::new();
    wait_until("all parts to be there", || {
        // Between fork and exec a child has the command line of its parent.
        parts = children(supervisor.id())
            .into_iter()
            .filter_map(|(id, line)| line.get(1).filter(|part| *part != "run").map(|p| (p.clone(), id)))
            .collect();
        parts.len() == 3
    });
    (supervisor, parts)
}

fn world(parts: &[(String, u32)]) -> u32 {
    parts.iter().find(|(part, _)| part == "world").unwrap().1
}

/// Stops all processes of a run where they are.
fn stop(supervisor: &Process, parts: &[(String, u32)]) {
    supervisor.signal(Signal::STOP);
    parts.iter().for_each(|(_, id)| send(*id, Signal::STOP));
}

/// Stops a process while it surely does not hold the lock of the directory of all runs, which `cz clean` takes.
fn stop_without_lock(test_run: &TestRun, id: u32) {
    let directory = std::fs::File::open(test_run.runs()).unwrap();
    directory.lock().unwrap();
    send(id, Signal::STOP);
}

/// Kills all processes of a run, none of which can notice the death of another.
fn massacre(supervisor: Process, parts: &[(String, u32)]) {
    stop(&supervisor, parts);
    parts.iter().for_each(|(_, id)| send(*id, Signal::KILL));
    supervisor.signal(Signal::KILL);
    wait_until("everybody to be dead", || parts.iter().all(|(_, id)| !is_alive(*id)));
    supervisor.ended();
}

/// Runs `cz clean` and returns what it says.
fn clean(test_run: &TestRun, temporary: &Path, arguments: &[&str]) -> String {
    let mut command = test_run.command("cz");
    let output = command.env("TMPDIR", temporary).arg("clean").args(arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Files that nobody but this test may remove.
struct Planted(Vec<PathBuf>);

impl Planted {
    fn new(paths: Vec<PathBuf>) -> Planted {
        paths.iter().for_each(|path| std::fs::write(path, "").unwrap());
        Planted(paths)
    }
}

impl Drop for Planted {
    fn drop(&mut self) {
        for path in &self.0 {
            let _ = std::fs::remove_file(path);
        }
    }
}

#[test]
fn a_killed_run_is_removed_and_a_live_one_goes_on() {
    let _alone = ALONE.lock();
    let test_run = TestRun::new("clean");
    // What tests before this one left when they failed is not judged here.
    clean(&test_run, &std::env::temp_dir(), &[]);
    let alive = common::unique_name("alive");
    let in_process = test_run.summary(&["corridor-8", "--in-process"]);
    // The other run is there first: whoever begins one removes what dead runs have left.
    let (survivor, parts) = start_long(&test_run, &alive, &["--json", "-"]);
    // It stands still while others are cleared away, so that it is certainly there.
    let has_services = || files(Some(test_run.runs().parent().unwrap()), &alive).len() > 10;
    wait_until("the other run to have services", has_services);
    stop_without_lock(&test_run, world(&parts));
    let (supervisor, dying) = start_long(&test_run, test_run.name(), PACED);
    wait_until("the run to have files", || test_run.files().len() > 10);
    massacre(supervisor, &dying);
    let left = test_run.files();
    assert!(left.len() > 10, "killed processes leave files: {left:?}");

    // What only looks like ours: another runtime directory, another user, no run at all, alive.
    let shm = Path::new("/dev/shm");
    let user = rustix::process::getuid().as_raw();
    let mut others: Vec<PathBuf> = [
        format!("cz_{user}_{}_00000000_x.data", test_run.name()),
        format!("cz_{}_{}_00000000_x.data", user + 1, test_run.name()),
        format!("cz_bench_{}", std::process::id()),
        format!("cz_bench_x{}", test_run.name()),
    ]
    .iter()
    .map(|name| shm.join(name))
    .collect();
    others.push(test_run.runs().join("not a run"));
    // Taken away again however this test ends: nobody else may.
    let others = Planted::new(others);
    // A process that was, and is no more.
    let mut ended = std::process::Command::new("true").spawn().unwrap();
    ended.wait().unwrap();
    let temporary = tempfile::tempdir().unwrap();
    let measurement = [
        shm.join(format!("cz_bench_{}", ended.id())),
        temporary.path().join(format!("cz-bench-{}.sock", ended.id())),
    ];
    measurement.iter().for_each(|path| std::fs::write(path, "").unwrap());

    let said = clean(&test_run, temporary.path(), &["--dry-run"]);
    let lines = |said: &str, what: &str| -> Vec<PathBuf> {
        let mut paths: Vec<_> =
            said.lines().filter_map(|l| l.strip_prefix(what)).map(PathBuf::from).collect();
        paths.sort();
        paths
    };
    let mut expected = [&left[..], &measurement].concat();
    expected.sort();
    expected.dedup();
    assert_eq!(lines(&said, "would remove "), expected);
    assert_eq!(test_run.files().len(), left.len() + 1, "--dry-run removes nothing");

    let said = clean(&test_run, temporary.path(), &[]);
    assert_eq!(lines(&said, "removed "), expected);
    assert!(said.contains(&format!("left {alive}: it is active")), "{said}");
    for path in &expected {
        assert!(!path.exists(), "{path:?} is still there");
    }
    for path in &others.0 {
        assert!(path.exists(), "{path:?} has been removed");
    }
    drop(others);

    send(world(&parts), Signal::CONT);
    assert_eq!(survivor.ended().hash(), common::hash(&in_process));
    assert!(clean(&test_run, temporary.path(), &[]).ends_with("nothing to remove\n"));
    test_run.assert_clean();
}

#[test]
fn shared_memory_without_its_directory_is_removed() {
    let _alone = ALONE.lock();
    let test_run = TestRun::new("nodir");
    let (supervisor, parts) = start_long(&test_run, test_run.name(), PACED);
    wait_until("the run to have files", || test_run.files().len() > 10);
    massacre(supervisor, &parts);
    std::fs::remove_dir_all(test_run.runs()).unwrap();
    assert_ne!(test_run.files(), Vec::<PathBuf>::new());
    let temporary = tempfile::tempdir().unwrap();
    wait_until("clean to remove it", || {
        clean(&test_run, temporary.path(), &[]);
        test_run.files().is_empty()
    });
    test_run.assert_clean();
}

#[test]
fn what_a_run_creates_is_private() {
    let _alone = ALONE.lock();
    let test_run = TestRun::new("modes");
    let (supervisor, parts) = start_long(&test_run, test_run.name(), &[PACED, &["--wait", "block"]].concat());
    wait_until("the run to have files", || test_run.files().len() > 30);
    stop(&supervisor, &parts);
    let found = [test_run.files(), vec![test_run.runs()]].concat();
    assert!(
        found.iter().any(|p| p.starts_with("/dev/shm"))
            && found.iter().any(|p| p.starts_with(test_run.runs()))
    );
    let open: Vec<_> = found
        .iter()
        // iceoryx2 makes its directories 0750, within the run's own, which nobody else can enter.
        .filter(|path| !path.is_dir() || path.ends_with(test_run.name()) || path.ends_with("cz"))
        .map(|path| (path.symlink_metadata().unwrap().permissions().mode(), path))
        .filter(|(mode, _)| mode & 0o077 != 0)
        .collect();
    assert!(open.is_empty(), "{open:?}");
    massacre(supervisor, &parts);
    let temporary = tempfile::tempdir().unwrap();
    wait_until("clean to remove it", || {
        clean(&test_run, temporary.path(), &[]);
        test_run.files().is_empty()
    });
}

/// `cz` where there is no runtime directory but this temporary one.
fn cz_in(test_run: &TestRun, temporary: &Path, arguments: &[&str]) -> std::process::Output {
    let mut command = test_run.command("cz");
    command.env_remove("XDG_RUNTIME_DIR").env("TMPDIR", temporary).args(arguments).output().unwrap()
}

#[test]
fn what_is_not_a_run_is_neither_removed_nor_used() {
    let _alone = ALONE.lock();
    let test_run = TestRun::new("photos");
    let photos = test_run.runs().join("photos");
    std::fs::create_dir_all(&photos).unwrap();
    let kept = [photos.join("summer.jpg"), test_run.runs().join("empty")];
    std::fs::write(&kept[0], "picture").unwrap();
    std::fs::create_dir(&kept[1]).unwrap();
    let elsewhere = tempfile::tempdir().unwrap();
    std::os::unix::fs::symlink(elsewhere.path(), test_run.runs().join("link")).unwrap();
    let said = clean(&test_run, elsewhere.path(), &[]);
    for name in ["photos", "empty"] {
        assert!(said.contains(&format!("left {}", test_run.runs().join(name).display())), "{said}");
        let output = test_run.command("cz").args(["run", "--run", name]).output().unwrap();
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{error}");
        assert!(error.contains(".cz-run") && error.contains("--run"), "{error}");
    }
    let output = test_run.command("cz").args(["run", "--run", "link"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    assert!(
        test_run.command("cz").args(["run", "--run", test_run.name()]).output().unwrap().status.success()
    );
    assert!(kept.iter().all(|path| path.exists()), "something of somebody's has been removed");
    assert!(test_run.files().is_empty());
}

#[test]
fn a_planted_name_in_the_temporary_directory_is_passed_over() {
    let _alone = ALONE.lock();
    let test_run = TestRun::new("planted");
    let (temporary, target) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let photo = target.path().join("demo").join("summer.jpg");
    std::fs::create_dir(photo.parent().unwrap()).unwrap();
    std::fs::write(&photo, "picture").unwrap();
    let base = temporary.path().join(format!("cz-{}", rustix::process::getuid().as_raw()));
    std::os::unix::fs::symlink(target.path(), &base).unwrap();
    let next = base.with_file_name(format!("{}-1", base.file_name().unwrap().to_str().unwrap()));
    std::fs::create_dir(&next).unwrap();
    // As good as another user's: others may write to it.
    std::fs::set_permissions(&next, PermissionsExt::from_mode(0o777)).unwrap();
    for arguments in [&["clean"][..], &["run", "--run", "demo"], &["clean"]] {
        let output = cz_in(&test_run, temporary.path(), arguments);
        assert!(output.status.success(), "{arguments:?}: {output:?}");
        assert!(photo.exists(), "{arguments:?} has removed what a link led to");
    }
    let left: Vec<_> = std::fs::read_dir(temporary.path()).unwrap().flatten().map(|e| e.path()).collect();
    assert_eq!(left.len(), 2, "{left:?}");
}

#[test]
fn runs_of_one_name_that_share_nothing_but_shared_memory_do_not_meet() {
    let _alone = ALONE.lock();
    let test_run = TestRun::new("container");
    let expected = common::hash(&test_run.summary(&["corridor-8", "--in-process"]));
    let (first, parts) = start_long(&test_run, test_run.name(), &["--json", "-"]);
    wait_until("the run to have files", || test_run.files().len() > 30);
    stop(&first, &parts);
    // The same path, and another directory: what a container has that shares /dev/shm alone.
    let aside = test_run.runs().with_file_name("aside");
    std::fs::rename(test_run.runs(), &aside).unwrap();
    assert_eq!(common::hash(&test_run.summary(&["corridor-8"])), expected);
    assert_eq!(clean(&test_run, aside.parent().unwrap(), &[]), "nothing to remove\n");
    std::fs::rename(&aside, test_run.runs()).unwrap();
    parts.iter().for_each(|(_, id)| send(*id, Signal::CONT));
    first.signal(Signal::CONT);
    assert_eq!(first.ended().hash(), expected);
    test_run.assert_clean();
}

#[test]
fn files_cut_short_or_written_over_are_cleaned_away_all_the_same() {
    let _alone = ALONE.lock();
    for (how, bytes) in [("empty", 0), ("short", 5), ("random", 70_000)] {
        let test_run = TestRun::new(how);
        let (supervisor, parts) = start_long(&test_run, test_run.name(), PACED);
        wait_until("the run to have files", || test_run.files().len() > 30);
        massacre(supervisor, &parts);
        let noise: Vec<u8> =
            (0..bytes as u64).map(|i| (i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 56) as u8).collect();
        let marker = test_run.runs().join(test_run.name()).join(".cz-run");
        for path in test_run.files().iter().filter(|path| !path.is_dir() && **path != marker) {
            std::fs::write(path, &noise).unwrap();
        }
        let temporary = tempfile::tempdir().unwrap();
        let mut command = test_run.command("cz");
        let mut process = command.env("TMPDIR", temporary.path()).arg("clean").spawn().unwrap();
        let mut status = None;
        common::wait_within(std::time::Duration::from_secs(20), "cz clean to end", || {
            status = process.try_wait().unwrap();
            status.is_some()
        });
        assert!(status.unwrap().success(), "{how}: {status:?}");
        test_run.assert_clean();
    }
}

#[test]
fn what_a_killed_run_left_is_swept_when_the_next_one_begins() {
    let _alone = ALONE.lock();
    let test_run = TestRun::new("sweep");
    let (supervisor, parts) = start_long(&test_run, test_run.name(), PACED);
    wait_until("the run to have files", || test_run.files().len() > 10);
    massacre(supervisor, &parts);
    assert_ne!(test_run.files(), Vec::<PathBuf>::new());
    let other = common::unique_name("other");
    let ended = test_run.start_in("cz", &other, &["--set", "end.time_s=5"]).ended();
    ended.expect(0, &[]);
    test_run.assert_clean();
}

#[test]
fn a_run_waits_for_others_that_come_or_go() {
    let test_run = TestRun::new("queue");
    // As on a machine on which that takes them long.
    std::fs::DirBuilder::new().mode(0o700).create(test_run.runs()).unwrap();
    let mut held = std::process::Command::new("flock");
    let mut held = held.arg(test_run.runs()).args(["sleep", "7"]).spawn().unwrap();
    let runs = test_run.runs();
    wait_until("the lock to be taken", || {
        !std::process::Command::new("flock").arg("-n").arg(&runs).arg("true").status().unwrap().success()
    });
    let run = test_run.start("cz", &["--set", "end.time_s=10", "--json", "-"]);
    held.wait().unwrap();
    run.ended().json();
    test_run.assert_clean();
}
