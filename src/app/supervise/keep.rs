//! `cz keep`: the keeper of a plug-in. It starts the plug-in's command, and ends it and whatever that has started
//! when it is asked to, when its supervisor dies, and when the command fails. It ends as the command ended.

use super::child;
use super::life::GRACE;
use crate::app::AppError;
use crate::app::args::KeepArgs;
use crate::app::lines::PartLine;
use crate::app::parts::follow_supervisor;
use crate::app::say::say;
use crate::process::children_of;
use crate::transport::iox::RunSpace;
use rustix::io::Errno;
use rustix::process::{
    Pid, Resource, Rlimit, Signal, WaitOptions, WaitStatus, getpid, kill_process_group, set_child_subreaper,
    setrlimit, wait,
};
use rustix::termios::tcsetpgrp;
use signal_hook::consts::{SIGCHLD, SIGHUP, SIGINT, SIGKILL, SIGTERM};
use signal_hook::iterator::Signals;
use std::io::Write;
use std::os::fd::AsFd;
use std::os::unix::process::CommandExt;
use std::process::{Command, Stdio};
use std::thread;
use std::time::Duration;

/// What a command that has failed has left running may take this long to end.
const GRACE_AFTER_FAILURE: Duration = Duration::from_millis(300);
/// Time between two rounds of killing: whose parent dies becomes our child.
const ROUND: Duration = Duration::from_millis(10);

/// What the shell does before the command: who keeps it says so in a line of stderr, which they share, and the command
/// may say things without end of line.
const WAITS_TO_BE_KNOWN: &str = r#"read -r _ || exit 1; exec sh -c "$0" </dev/null"#;

/// Does not return once the command has been started.
pub(in crate::app) fn keep(args: &KeepArgs) -> Result<(), AppError> {
    let failed = |what: &str, why: &dyn std::fmt::Display| AppError::Failed(format!("{what}: {why}"));
    let mut signals =
        Signals::new([SIGTERM, SIGINT, SIGHUP, SIGCHLD]).map_err(|e| failed("cannot handle signals", &e))?;
    // Whoever loses its parent comes to us, so that nobody gets away by leaving its group.
    set_child_subreaper(Some(getpid())).map_err(|e| failed("cannot keep what the command starts", &e))?;
    follow_supervisor(Some(args.supervised))?;
    let mut command = Command::new("sh");
    command.process_group(0);
    if args.terminal {
        command.args(["-c", &args.command]);
        // What it says does not go through the supervisor, which would keep a prompt until the line ends.
        let terminal = std::io::stdout().as_fd().try_clone_to_owned();
        command.stderr(terminal.map_err(|e| failed("cannot leave it the terminal", &e))?);
    } else {
        command.args(["-c", WAITS_TO_BE_KNOWN, &args.command]).stdin(Stdio::piped());
    }
    let mut child = command.spawn().map_err(|e| failed("cannot start sh", &e))?;
    let group = Pid::from_raw(child.id() as i32).expect("a process has an id");
    if args.terminal {
        // It may read there now, and is interrupted from there alone. Without a terminal there is nothing to be given.
        let _ = tcsetpgrp(std::io::stdin(), group);
    }
    say(PartLine::Keeps(child.id()).to_line());
    // Who has died in the meantime is reaped below.
    let _ = child.stdin.take().map(|mut go| go.write_all(b"\n"));
    let mut status = None;
    let mut is_ending = false;
    loop {
        if !reap_all(group, &mut status) {
            if is_ending && let Some(run) = std::env::var("CZ_RUN").ok().and_then(|run| run.parse().ok()) {
                // Who was killed has removed nothing, and its supervisor may be dead.
                let _ = RunSpace::sweep(&run);
            }
            end_like(status);
        }
        let has_failed = status.is_some_and(|status| status.exit_status() != Some(0));
        if has_failed && !is_ending {
            is_ending = true;
            end_all(group, GRACE_AFTER_FAILURE);
        }
        if signals.wait().any(|signal| signal != SIGCHLD) && !is_ending {
            is_ending = true;
            end_all(group, GRACE);
        }
    }
}

/// Reaps whoever has ended; returns whether there are any left.
fn reap_all(command: Pid, status: &mut Option<WaitStatus>) -> bool {
    loop {
        match wait(WaitOptions::NOHANG) {
            Ok(Some((pid, how))) if pid == command => *status = Some(how),
            Ok(Some(_)) | Err(Errno::INTR) => {}
            Ok(None) => return true,
            Err(_) => return false,
        }
    }
}

/// Asks everybody to end, and insists after a while. A command that has left helpers behind and ended well still
/// counts as running, as one that puts itself into the background must.
fn end_all(group: Pid, grace: Duration) {
    let own = std::process::id();
    let _ = kill_process_group(group, Signal::TERM);
    children_of(own).into_iter().for_each(|process| child::signal(process, Signal::TERM));
    // Whoever is stopped is to hear it.
    let _ = kill_process_group(group, Signal::CONT);
    let insist = move || {
        thread::sleep(grace);
        loop {
            let _ = kill_process_group(group, Signal::KILL);
            children_of(own).into_iter().for_each(|process| child::signal(process, Signal::KILL));
            thread::sleep(ROUND);
        }
    };
    if thread::Builder::new().spawn(insist).is_err() {
        let _ = kill_process_group(group, Signal::KILL);
    }
}

/// Ends as the command has.
fn end_like(status: Option<WaitStatus>) -> ! {
    let Some(status) = status else { std::process::exit(1) };
    if let Some(signal) = status.terminating_signal() {
        // Not again a core that the command has left already.
        let _ = setrlimit(Resource::Core, Rlimit { current: Some(0), maximum: Some(0) });
        if signal == SIGKILL {
            child::signal(std::process::id(), Signal::KILL);
        }
        let _ = signal_hook::low_level::emulate_default_handler(signal);
        std::process::exit(128 + signal);
    }
    std::process::exit(status.exit_status().unwrap_or(1))
}
