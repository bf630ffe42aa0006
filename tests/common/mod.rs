//! What the tests of whole processes share: programs in a runtime directory of their own, bounded waits
//! that say what was waited for, and the search for what a run has left behind.

#![allow(dead_code)] // every test file uses its part of this
#![allow(clippy::unwrap_used)] // as in the tests themselves

use control_zones::transport::iox::{AttachLine, RunSpace};
use rustix::process::{Pid, Signal, kill_process};
use std::fs::File;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// Longer than anything here takes on a loaded machine; shorter than anybody's patience.
pub const LONG: Duration = Duration::from_secs(60);

/// Steady traffic through two zones for 100 000 steps: a run long enough to be disturbed in the middle of.
pub const LONG_RUN: [&str; 9] = [
    "varying-demand",
    "--set",
    "end.time_s=10000",
    "--set",
    "roads.main1.demand.rates=[{until_s=10000.0,vehicles_per_hour=300.0}]",
    "--set",
    "roads.merge1.demand.rates=[{until_s=10000.0,vehicles_per_hour=300.0}]",
    "--set",
    "roads.merge2.demand.rates=[{until_s=10000.0,vehicles_per_hour=300.0}]",
];

/// The two zones under steady demand for a thousand hours: no machine gets to the end of it.
pub const ENDLESS: [&str; 13] = [
    "varying-demand",
    "--set",
    "end.time_s=3600000",
    "--set",
    "roads.main1.demand.rates=[{until_s=3600000.0,vehicles_per_hour=300.0}]",
    "--set",
    "roads.merge1.demand.rates=[{until_s=3600000.0,vehicles_per_hour=300.0}]",
    "--set",
    "roads.merge2.demand.rates=[{until_s=3600000.0,vehicles_per_hour=300.0}]",
    "--peer-timeout",
    "60",
    // Whom others replace: tests/runs/replacement.rs.
    "--restart",
    "never",
];

static NEXT: AtomicU32 = AtomicU32::new(0);

/// A run name nobody else uses: /dev/shm is shared with all other tests.
pub fn unique_name(tag: &str) -> String {
    format!("{tag}-{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed))
}

/// A runtime directory of its own, and the name of a run in it.
#[derive(Debug)]
pub struct TestRun {
    runtime: TempDir,
    logs: TempDir,
    run: String,
}

impl TestRun {
    pub fn new(tag: &str) -> TestRun {
        // Short, because paths of sockets must be.
        let directory = || tempfile::Builder::new().prefix("cz").tempdir().unwrap();
        TestRun { runtime: directory(), logs: directory(), run: unique_name(tag) }
    }

    /// The run's name.
    pub fn name(&self) -> &str {
        &self.run
    }

    /// One of the four programs, in this run's directories.
    pub fn command(&self, program: &str) -> Command {
        let path = match program {
            "cz" => env!("CARGO_BIN_EXE_cz"),
            "cz-world" => env!("CARGO_BIN_EXE_cz-world"),
            "cz-coord" => env!("CARGO_BIN_EXE_cz-coord"),
            "cz-ctrl" => env!("CARGO_BIN_EXE_cz-ctrl"),
            "sh" => "sh",
            other => panic!("there is no program {other}"),
        };
        let mut command = Command::new(path);
        command.env("XDG_RUNTIME_DIR", self.runtime.path()).stdin(Stdio::null());
        command
    }

    /// Starts a program that takes part in the run.
    pub fn start(&self, program: &str, arguments: &[&str]) -> Process {
        self.start_in(program, &self.run, arguments)
    }

    /// Starts a program that takes part in another run of the same runtime directory.
    pub fn start_in(&self, program: &str, run: &str, arguments: &[&str]) -> Process {
        let mut command = self.command(program);
        if program == "cz" {
            command.arg("run");
        }
        command.args(["--run", run]).args(arguments);
        Process::start(format!("{program} --run {run} {}", arguments.join(" ")), command, self.logs.path())
    }

    /// Starts `cz run`, waits for its end, and returns its JSON summary.
    pub fn summary(&self, arguments: &[&str]) -> serde_json::Value {
        let mut all = vec!["--json", "-"];
        all.extend(arguments);
        self.start("cz", &all).ended().json()
    }

    /// The directory of all runs beside it.
    pub fn runs(&self) -> PathBuf {
        self.runtime.path().join("cz")
    }

    /// Files of the run, in the runtime directory and in shared memory.
    pub fn files(&self) -> Vec<PathBuf> {
        files(Some(self.runtime.path()), &self.run)
    }

    /// Waits until nothing is set up any more: a world that waits for participants has then created all
    /// its services.
    pub fn wait_until_settled(&self) {
        let mut before = (Vec::new(), Instant::now());
        wait_until("the world to have set up its services", || {
            let files = self.files();
            if files != before.0 {
                before = (files, Instant::now());
            }
            !before.0.is_empty() && before.1.elapsed() > Duration::from_millis(300)
        });
    }

    /// Nothing of the run is left anywhere.
    pub fn assert_clean(&self) {
        assert_eq!(self.files(), Vec::<PathBuf>::new(), "left behind by run {}", self.run);
        // With the last run the directory of all runs goes too.
        let left: Vec<_> = std::fs::read_dir(self.runtime.path()).unwrap().flatten().collect();
        assert!(left.is_empty(), "left in the runtime directory: {left:?}");
    }
}

/// The files of a run: in shared memory, and below the given runtime directory.
pub fn files(runtime: Option<&Path>, run: &str) -> Vec<PathBuf> {
    let prefix = format!("cz_{}_{run}_", rustix::process::getuid().as_raw());
    let entries = |d: &Path| std::fs::read_dir(d).into_iter().flatten().flatten().map(|e| e.path());
    let named = |p: &PathBuf| p.file_name().is_some_and(|n| n.to_string_lossy().starts_with(&prefix));
    let mut found: Vec<_> = entries(Path::new("/dev/shm")).filter(named).collect();
    let mut directories: Vec<_> = runtime.map(|r| r.join("cz").join(run)).into_iter().collect();
    while let Some(directory) = directories.pop().filter(|d| d.exists()) {
        directories.extend(entries(&directory).filter(|p| p.is_dir()));
        found.extend(entries(&directory));
        found.push(directory);
    }
    found.sort();
    found
}

/// A program under test; killed when the test drops it, whatever happens.
#[derive(Debug)]
pub struct Process {
    what: String,
    child: Child,
    out: PathBuf,
    err: PathBuf,
}

impl Process {
    fn start(what: String, mut command: Command, logs: &Path) -> Process {
        // Into files, so that nobody ever waits for a reader.
        let log = logs.join(NEXT.fetch_add(1, Ordering::Relaxed).to_string());
        let (out, err) = (log.with_extension("out"), log.with_extension("err"));
        let child = command
            .stdout(File::create(&out).unwrap())
            .stderr(File::create(&err).unwrap())
            .spawn()
            .unwrap_or_else(|e| panic!("cannot start {what}: {e}"));
        Process { what, child, out, err }
    }

    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// What it has said on stdout and stderr until now.
    pub fn said_so_far(&self) -> (String, String) {
        let read = |path| String::from_utf8_lossy(&std::fs::read(path).unwrap()).into_owned();
        (read(&self.out), read(&self.err))
    }

    pub fn signal(&self, signal: Signal) {
        send(self.id(), signal);
    }

    /// Waits for the end.
    pub fn ended(self) -> Ended {
        self.ended_within(LONG)
    }

    /// Waits for the end, no longer than that.
    pub fn ended_within(mut self, limit: Duration) -> Ended {
        let what = format!("`{}` to end", self.what);
        let mut status = None;
        wait_within(limit, &what, || {
            status = self.child.try_wait().unwrap();
            status.is_some()
        });
        let read = |path| std::fs::read_to_string(path).unwrap();
        Ended {
            what: self.what.clone(),
            status: status.expect("the wait ended with a status"),
            out: read(&self.out),
            err: read(&self.err),
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// How a program ended, and what it said.
#[derive(Debug)]
pub struct Ended {
    pub what: String,
    pub status: ExitStatus,
    pub out: String,
    pub err: String,
}

impl Ended {
    /// Checks the exit code and that stderr has all the given words, on one line after the program's name.
    pub fn expect(&self, code: i32, words: &[&str]) {
        assert_eq!(self.status.code(), Some(code), "{self:?}");
        for word in words {
            assert!(self.err.contains(word), "no {word:?} in {self:?}");
        }
        assert!(!self.err.contains("panicked"), "{self:?}");
    }

    pub fn was_killed_by(&self, signal: Signal) -> bool {
        self.status.signal() == Some(signal.as_raw())
    }

    /// The JSON summary, which must be all there is on stdout.
    pub fn json(&self) -> serde_json::Value {
        self.expect(0, &[]);
        serde_json::from_str(&self.out).unwrap_or_else(|e| panic!("stdout is not JSON: {e}: {self:?}"))
    }

    /// The state hash in the JSON summary.
    pub fn hash(&self) -> String {
        hash(&self.json())
    }
}

/// The state hash of a summary.
pub fn hash(summary: &serde_json::Value) -> String {
    summary["state_hash"].as_str().expect("state_hash is a string").to_owned()
}

/// The path of an example controller of the Rust SDK, which is built first.
pub fn example(name: &str) -> String {
    let cz = Path::new(env!("CARGO_BIN_EXE_cz"));
    let mut build = Command::new(env!("CARGO"));
    build.current_dir(env!("CARGO_MANIFEST_DIR"));
    build.args(["build", "-q", "-p", "control-zones-plugin", "--example", name]);
    if cz.parent().is_some_and(|directory| directory.ends_with("release")) {
        build.arg("--release");
    }
    assert!(build.status().unwrap().success());
    cz.parent().unwrap().join("examples").join(name).display().to_string()
}

/// Waits for something that must happen soon.
pub fn wait_until(what: &str, happened: impl FnMut() -> bool) {
    wait_within(LONG, what, happened);
}

/// The attach service's line, once the run's world has opened it.
pub fn attach_line(space: &RunSpace) -> AttachLine {
    let mut line = None;
    wait_until("the attach service", || {
        line = space.open_attach_line().ok();
        line.is_some()
    });
    line.unwrap()
}

/// Waits for something that must happen within that time.
pub fn wait_within(limit: Duration, what: &str, mut happened: impl FnMut() -> bool) {
    let start = Instant::now();
    while !happened() {
        assert!(start.elapsed() < limit, "waited {limit:?} for {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

pub fn send(process_id: u32, signal: Signal) {
    let pid = Pid::from_raw(process_id as i32).expect("a process id is not 0");
    kill_process(pid, signal).unwrap_or_else(|e| panic!("cannot send {signal:?} to {process_id}: {e}"));
}

/// Stops a process where it is, but not while it comes or goes: it has the directory of all runs locked then, and
/// would hold up everybody, whoever is to let it go on among them.
pub fn hold(process_id: u32) {
    loop {
        send(process_id, Signal::STOP);
        wait_until("the process to stop", || stat(process_id).is_none_or(|fields| fields[0] == "T"));
        if !comes_or_goes(process_id) {
            return;
        }
        send(process_id, Signal::CONT);
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Whether a process has the directory of all runs open, as it has while it locks it.
fn comes_or_goes(process_id: u32) -> bool {
    let files = std::fs::read_dir(format!("/proc/{process_id}/fd")).into_iter().flatten().flatten();
    files.filter_map(|file| std::fs::read_link(file.path()).ok()).any(|path| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        path.is_dir() && (name == "cz" || name.starts_with("cz-"))
    })
}

/// The fields of /proc/PID/stat from the state on; `None` when there is no such process or it is a zombie.
fn stat(process_id: u32) -> Option<Vec<String>> {
    let stat = std::fs::read_to_string(format!("/proc/{process_id}/stat")).ok()?;
    // The name before them is in parentheses and may hold any character.
    let fields: Vec<_> = stat.rsplit(')').next()?.split_whitespace().map(str::to_owned).collect();
    (fields[0] != "Z" && fields[0] != "X").then_some(fields)
}

/// Whether a process is there, with all it has open: the first of its threads may be a zombie before the others are.
pub fn is_alive(process_id: u32) -> bool {
    let threads = || std::fs::read_dir(format!("/proc/{process_id}/task")).map_or(0, Iterator::count);
    stat(process_id).is_some() || threads() > 1
}

/// Processor time a process has used, in ticks of 10 ms.
pub fn ticks(process_id: u32) -> u64 {
    stat(process_id).map_or(0, |f| f[11].parse::<u64>().unwrap() + f[12].parse::<u64>().unwrap())
}

/// The children of a process: their ids and command lines.
pub fn children(process_id: u32) -> Vec<(u32, Vec<String>)> {
    let parent = process_id.to_string();
    let ids = std::fs::read_dir("/proc").unwrap().flatten();
    ids.filter_map(|e| e.file_name().to_str()?.parse::<u32>().ok())
        .filter(|&id| stat(id).is_some_and(|f| f[1] == parent))
        .map(|id| {
            let line = std::fs::read_to_string(format!("/proc/{id}/cmdline")).unwrap_or_default();
            (id, line.split('\0').map(str::to_owned).collect())
        })
        .collect()
}

/// Starts `cz run` and waits until it has started that many parts; returns their names and process ids.
pub fn begin(test_run: &TestRun, arguments: &[&str], processes: usize) -> (Process, Vec<(String, u32)>) {
    let supervisor = test_run.start("cz", arguments);
    let mut parts = Vec::new();
    wait_until("the supervisor to have started the parts", || {
        // Between fork and exec a child has the command line of its parent.
        parts = children(supervisor.id())
            .into_iter()
            .filter_map(|(id, line)| line.get(1).filter(|part| *part != "run").map(|p| (p.clone(), id)))
            .collect();
        parts.len() == processes
    });
    (supervisor, parts)
}

/// Waits until a run is under way: its world has opened it and uses processor time since, of which it takes next to none
/// while it waits for others.
pub fn wait_until_stepping(world: u32) {
    let id = world.to_string();
    let is_own = |path: &PathBuf| {
        path.to_string_lossy().ends_with("_world")
            && std::fs::read_to_string(path).is_ok_and(|text| text == id)
    };
    wait_until("the world to have opened its run", || {
        std::fs::read_dir("/dev/shm").unwrap().flatten().any(|file| is_own(&file.path()))
    });
    let before = ticks(world);
    wait_until("the world to be stepping", || ticks(world) >= before + 5);
}

/// The process id of the first part of that name.
pub fn part(parts: &[(String, u32)], name: &str) -> u32 {
    parts.iter().find(|(part, _)| part == name).unwrap_or_else(|| panic!("no {name} in {parts:?}")).1
}
