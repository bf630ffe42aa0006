//! The programs' command lines.

use crate::live::watch;
use crate::run::Run;
use crate::server::Server;
use clap::Parser;
use control_zones::process::Watched;
use control_zones::transport::iox::RunName;
use std::ffi::OsString;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode};
use std::sync::Arc;
use std::time::Duration;

/// Watch a scenario, a run, or one or two recordings in the browser.
///
/// Prints the address of a page that only this user on this machine can open, and serves it until it is ended
/// (Ctrl-C). A scenario is run in real time, and begins when the page is opened; the page can pause it, have it make
/// single steps, and set its pace.
#[derive(Debug, Parser)]
#[command(name = "cz view", version)]
struct View {
    /// One or two recordings (.czlog), two side by side at the same step; or a scenario to run: a TOML file, or the name
    /// of an embedded one [default: the default scenario].
    #[arg(value_name = "SCENARIO|FILE.czlog", num_args = 0..=2)]
    pub what: Vec<PathBuf>,
    /// Watch the run of this name, which goes on already.
    #[arg(long, value_name = "NAME", conflicts_with_all = ["what", "arguments"])]
    pub run: Option<RunName>,
    /// Port of the page, on 127.0.0.1 [default: one that is free].
    #[arg(long, value_name = "PORT", default_value_t = 0, hide_default_value = true)]
    pub port: u16,
    /// What `cz run` is started with.
    #[arg(last = true, value_name = "ARGUMENTS OF cz run")]
    pub arguments: Vec<OsString>,
}

/// How long a run may take to appear.
const COMING: Duration = Duration::from_secs(30);
/// Longest pause of a run that is steered, s: the others wait for the world as long.
const LONGEST_PAUSE_S: &str = "86400";
/// First bytes of a recording.
const RECORDING: &[u8] = b"CZLOG";

/// `cz-view`.
pub fn view() -> ExitCode {
    let args = View::parse();
    match look(&args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(problem) => {
            eprintln!("cz view: {problem}");
            ExitCode::from(2)
        }
    }
}

fn look(args: &View) -> Result<(), String> {
    if let Some(name) = &args.run {
        return serve(vec![watch(name, Duration::from_secs(2), false, || true)?], args.port);
    }
    let recordings = args.what.iter().filter(|path| is_recording(path)).count();
    if recordings > 0 || args.what.len() == 2 {
        let runs = args.what.iter().map(|file| Run::open(file)).collect::<Result<_, _>>()?;
        return serve(runs, args.port);
    }
    let mut arguments = args.arguments.clone();
    let mut own_pace = Vec::new();
    if arguments.is_empty() {
        own_pace = ["--pace", "realtime"].map(OsString::from).to_vec();
    }
    arguments.extend(args.what.first().map(|scenario| scenario.clone().into_os_string()));
    let name = name_in(&arguments)?;
    let mut child = start(&name, &own_pace, &arguments)?;
    let run = watch(&name, COMING, true, || child.try_wait().is_ok_and(|end| end.is_none()));
    let run = run.inspect_err(|_| {
        let _ = child.wait();
    })?;
    // Reaps it, and says so; the page stays.
    std::thread::spawn(move || {
        let end = child.wait();
        let how = end.map_or_else(
            |error| error.to_string(),
            |end| if end.success() { String::new() } else { format!(" ({end})") },
        );
        eprintln!("cz view: the run is over{how}; the page stays until Ctrl-C");
    });
    serve(vec![run], args.port)
}

fn is_recording(path: &Path) -> bool {
    let mut head = [0; RECORDING.len()];
    let begins = std::fs::File::open(path).and_then(|mut file| file.read_exact(&mut head));
    path.extension().is_some_and(|ending| ending == "czlog") || begins.is_ok() && head == RECORDING
}

/// The run's name: what the arguments say, or one of its own.
fn name_in(arguments: &[OsString]) -> Result<RunName, String> {
    let mut given = None;
    let mut all = arguments.iter().map(|argument| argument.to_string_lossy());
    while let Some(argument) = all.next() {
        if argument == "--run" {
            given = all.next().map(|name| name.into_owned());
        } else if let Some(name) = argument.strip_prefix("--run=") {
            given = Some(name.to_owned());
        }
    }
    let name = given.unwrap_or_else(|| format!("view-{}", std::process::id()));
    name.parse().map_err(|error| format!("--run {name}: {error}"))
}

/// Starts `cz run`, which is beside this program.
fn start(name: &RunName, own: &[OsString], arguments: &[OsString]) -> Result<Child, String> {
    let program = std::env::current_exe().map_err(|error| error.to_string())?.with_file_name("cz");
    let mut command = Command::new(&program);
    command.args(["run", "--steered", "--begin-paused"]).args(own);
    let says = |flag: &str| arguments.iter().any(|a| a.to_string_lossy().starts_with(flag));
    if !says("--run") {
        command.arg("--run").arg(name.to_string());
    }
    if !says("--peer-timeout") {
        command.args(["--peer-timeout", LONGEST_PAUSE_S]);
    }
    let child = command.args(arguments).spawn();
    child.map_err(|error| format!("cannot start {}: {error}", program.display()))
}

/// Serves runs until the process ends.
fn serve(runs: Vec<Arc<Run>>, port: u16) -> Result<(), String> {
    let failed = |error: std::io::Error| format!("--port {port}: cannot serve on it: {error}");
    let server = Server::new(runs, port).map_err(failed)?;
    println!("{}", server.address().map_err(failed)?);
    // Threads begun from here on let the processes of the run go first.
    let _ = rustix::process::nice(Watched::NICENESS);
    server.serve().map_err(failed)
}
