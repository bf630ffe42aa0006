//! `cz clean` removes what killed runs have left, and nothing else; and what runs create is private.

#![allow(clippy::unwrap_used)] // in helpers as in the tests themselves

mod common;

use common::{Process, Site, children, files, is_alive, send, wait_until};
use rustix::process::Signal;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// Measurements have no place of their own, so one test would clean up what another has laid out.
static ALONE: Mutex<()> = Mutex::new(());

/// Starts a run that ends by itself only after a long time, and waits until it steps.
fn start_long(site: &Site, run: &str, more: &[&str]) -> (Process, Vec<(String, u32)>) {
    let supervisor = site.start_in("cz", run, &[&["corridor-8", "--peer-timeout", "60"], more].concat());
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

/// Kills all processes of a run, none of which can notice the death of another.
fn massacre(supervisor: Process, parts: &[(String, u32)]) {
    stop(&supervisor, parts);
    parts.iter().for_each(|(_, id)| send(*id, Signal::KILL));
    supervisor.signal(Signal::KILL);
    wait_until("everybody to be dead", || parts.iter().all(|(_, id)| !is_alive(*id)));
    supervisor.ended();
}

/// Runs `cz clean` and returns what it says.
fn clean(site: &Site, temporary: &Path, arguments: &[&str]) -> String {
    let mut command = site.command("cz");
    let output = command.env("TMPDIR", temporary).arg("clean").args(arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn a_killed_run_is_removed_and_a_live_one_goes_on() {
    let _alone = ALONE.lock();
    let site = Site::new("clean");
    let alive = common::unique_name("alive");
    let in_process = site.summary(&["corridor-8", "--in-process"]);
    let (supervisor, parts) = start_long(&site, site.run(), &[]);
    wait_until("the run to have files", || site.files().len() > 10);
    massacre(supervisor, &parts);
    let left = site.files();
    assert!(left.len() > 10, "killed processes leave files: {left:?}");

    let (survivor, parts) = start_long(&site, &alive, &["--json", "-"]);
    // It stands still while others are cleared away, so that it is certainly there.
    let has_services = || files(Some(site.runs().parent().unwrap()), &alive).len() > 10;
    wait_until("the other run to have services", has_services);
    send(world(&parts), Signal::STOP);

    // What only looks like ours: another runtime directory, another user, no run at all, alive.
    let shm = Path::new("/dev/shm");
    let user = rustix::process::getuid().as_raw();
    let mut others: Vec<PathBuf> = [
        format!("cz_{user}_{}_00000000_x.data", site.run()),
        format!("cz_{}_{}_00000000_x.data", user + 1, site.run()),
        format!("cz_bench_{}", std::process::id()),
        format!("cz_bench_x{}", site.run()),
    ]
    .iter()
    .map(|name| shm.join(name))
    .collect();
    others.push(site.runs().join("not a run"));
    others.iter().for_each(|path| std::fs::write(path, "").unwrap());
    // A process that was, and is no more.
    let mut ended = std::process::Command::new("true").spawn().unwrap();
    ended.wait().unwrap();
    let temporary = tempfile::tempdir().unwrap();
    let measurement = [
        shm.join(format!("cz_bench_{}", ended.id())),
        temporary.path().join(format!("cz-bench-{}.sock", ended.id())),
    ];
    measurement.iter().for_each(|path| std::fs::write(path, "").unwrap());

    // A run that died a moment ago could also be one that is about to begin.
    let mut said = String::new();
    wait_until("the dead run to be old enough", || {
        said = clean(&site, temporary.path(), &["--dry-run"]);
        said.contains(&format!("would remove {}", left[0].display()))
    });
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
    assert_eq!(site.files().len(), left.len() + 1, "--dry-run removes nothing");

    let said = clean(&site, temporary.path(), &[]);
    assert_eq!(lines(&said, "removed "), expected);
    assert!(said.contains(&format!("left {alive}: it is active")), "{said}");
    for path in &expected {
        assert!(!path.exists(), "{path:?} is still there");
    }
    for path in &others {
        assert!(path.exists(), "{path:?} has been removed");
        std::fs::remove_file(path).unwrap();
    }

    send(world(&parts), Signal::CONT);
    assert_eq!(survivor.ended().hash(), common::hash(&in_process));
    assert!(clean(&site, temporary.path(), &[]).ends_with("nothing to remove\n"));
    site.assert_clean();
}

#[test]
fn shared_memory_without_its_directory_is_removed() {
    let _alone = ALONE.lock();
    let site = Site::new("nodir");
    let (supervisor, parts) = start_long(&site, site.run(), &[]);
    wait_until("the run to have files", || site.files().len() > 10);
    massacre(supervisor, &parts);
    std::fs::remove_dir_all(site.runs()).unwrap();
    assert_ne!(site.files(), Vec::<PathBuf>::new());
    let temporary = tempfile::tempdir().unwrap();
    wait_until("clean to remove it", || {
        clean(&site, temporary.path(), &[]);
        site.files().is_empty()
    });
    site.assert_clean();
}

#[test]
fn what_a_run_creates_is_private() {
    let _alone = ALONE.lock();
    let site = Site::new("modes");
    let (supervisor, parts) = start_long(&site, site.run(), &["--wait", "block"]);
    wait_until("the run to have files", || site.files().len() > 30);
    stop(&supervisor, &parts);
    let found = [site.files(), vec![site.runs()]].concat();
    assert!(
        found.iter().any(|p| p.starts_with("/dev/shm")) && found.iter().any(|p| p.starts_with(site.runs()))
    );
    let open: Vec<_> = found
        .iter()
        // iceoryx2 makes its directories 0750, within the run's own, which nobody else can enter.
        .filter(|path| !path.is_dir() || path.ends_with(site.run()) || path.ends_with("cz"))
        .map(|path| (path.symlink_metadata().unwrap().permissions().mode(), path))
        .filter(|(mode, _)| mode & 0o077 != 0)
        .collect();
    assert!(open.is_empty(), "{open:?}");
    massacre(supervisor, &parts);
    let temporary = tempfile::tempdir().unwrap();
    wait_until("clean to remove it", || {
        clean(&site, temporary.path(), &[]);
        site.files().is_empty()
    });
}
