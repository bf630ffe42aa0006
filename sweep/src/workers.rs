//! Runs done by processes, so that one that dies takes nothing with it but the run it was at, which is done again.
//!
//! A worker reads requests from standard input and answers on standard output, a line of JSON each.

use crate::outcome::Outcome;
use crate::plan::{Done, Wanted};
use control_zones::compare::cache::{self, Cache};
use control_zones::compare::sample::Sample;
use control_zones::reproduce::parallel;
use control_zones::scenario::{decode, encode};
use crossbeam::channel::{Receiver, RecvTimeoutError, unbounded};
use serde::{Deserialize, Serialize};
use std::convert::Infallible;
use std::io::{self, BufRead, BufReader, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// A run to be done.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Request {
    /// Which run, for messages.
    pub run: String,
    /// The file that keeps its outcome.
    pub file: String,
    /// The program's hash: another one's outcomes are not its.
    pub build: String,
    /// The scenario's bytes in hexadecimal digits.
    pub scenario: String,
}

/// What became of it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Answer {
    /// The outcome's bytes in hexadecimal digits: what the file is to have.
    Outcome(String),
    /// Why there is none.
    Failure(String),
}

/// Bytes as hexadecimal digits.
fn digits(bytes: &[u8]) -> String {
    use std::fmt::Write;
    bytes.iter().fold(String::with_capacity(2 * bytes.len()), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// The bytes of such digits.
fn bytes(digits: &str) -> Option<Vec<u8>> {
    let pair = |pair: &[u8]| u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok();
    digits.len().is_multiple_of(2).then(|| digits.as_bytes().chunks(2).map(pair).collect())?
}

impl Request {
    /// To do this run.
    pub fn new(wanted: &Wanted, cache: &Cache) -> Request {
        Request {
            run: wanted.name(),
            file: wanted.file(cache),
            build: cache.build(),
            scenario: digits(&encode(&wanted.what)),
        }
    }

    /// Does it.
    fn answer(&self, build: &str) -> Answer {
        if self.build != build {
            let Request { build: asked, .. } = self;
            return Answer::Failure(format!(
                "this worker is another build of cz ({build}, expected {asked})"
            ));
        }
        let Some(scenario) = bytes(&self.scenario).and_then(|bytes| decode(&bytes).ok()) else {
            return Answer::Failure("the request's scenario is not one".to_owned());
        };
        let run = || Sample::of(&Arc::new(scenario), &self.run);
        match catch_unwind(AssertUnwindSafe(run)) {
            Ok(Ok(sample)) => Answer::Outcome(digits(&cache::bytes(&Outcome::of(&sample)))),
            Ok(Err(error)) => Answer::Failure(error.to_string()),
            // The panic hook has said what.
            Err(_) => Answer::Failure("internal error, see what the worker said".to_owned()),
        }
    }
}

/// Answers requests until there are no more.
///
/// # Errors
/// When standard input or output fails.
pub fn work(build: &str) -> io::Result<()> {
    let mut out = io::stdout().lock();
    for line in io::stdin().lock().lines() {
        let answer = match serde_json::from_str::<Request>(&line?) {
            Ok(request) => request.answer(build),
            Err(error) => Answer::Failure(format!("the request is none: {error}")),
        };
        serde_json::to_writer(&mut out, &answer)?;
        out.write_all(b"\n")?;
        out.flush()?;
    }
    Ok(())
}

/// Workers of this machine.
#[derive(Clone, Debug)]
pub struct Workers {
    /// The program, which with `--worker` is one.
    pub program: PathBuf,
    /// How many at a time.
    pub jobs: usize,
    /// How often a run is tried again.
    pub retries: u32,
    /// How long a run may take.
    pub patience: Duration,
}

impl Workers {
    /// Does runs and keeps their outcomes as they come. `progress` is told after each how many there are.
    pub fn perform(&self, runs: &[&Wanted], cache: &Cache, done: &mut Done, mut progress: impl FnMut(usize)) {
        let idle = Mutex::new(Vec::new());
        let work =
            |wanted: &&Wanted| Ok::<_, Infallible>(self.insist(&Request::new(wanted, cache), cache, &idle));
        let mut count = 0;
        let finished = |wanted: &&Wanted, result: Result<Outcome, String>| {
            match result {
                Ok(outcome) => _ = done.outcomes.insert(wanted.hash, outcome),
                Err(why) => _ = done.failures.insert(wanted.hash, why),
            }
            count += 1;
            progress(count);
        };
        match parallel::each(self.jobs, runs, work, finished) {
            Ok(()) => {}
            Err(never) => match never {},
        }
    }

    /// Does a run, again if need be.
    fn insist(&self, request: &Request, cache: &Cache, idle: &Mutex<Vec<Worker>>) -> Result<Outcome, String> {
        let mut why = String::new();
        for _ in 0..=self.retries {
            let taken = idle.lock().expect("nobody panics with it").pop();
            let attempt = taken.map_or_else(|| Worker::start(&self.program), Ok).and_then(|mut worker| {
                let answer = worker.ask(request, self.patience)?;
                // One that did not answer is dropped, and with that ended.
                idle.lock().expect("nobody panics with it").push(worker);
                match answer {
                    Answer::Failure(why) => Err(why),
                    Answer::Outcome(digits) => {
                        let bytes = bytes(&digits).ok_or("the worker's answer is none")?;
                        cache.put(&request.file, &bytes).map_err(|error| error.to_string())?;
                        cache.find(&request.file).ok_or_else(|| "its outcome cannot be read back".to_owned())
                    }
                }
            });
            match attempt {
                Ok(outcome) => return Ok(outcome),
                Err(last) => why = last,
            }
        }
        Err(why)
    }
}

/// A process that does runs.
#[derive(Debug)]
struct Worker {
    child: Child,
    requests: ChildStdin,
    answers: Receiver<String>,
}

impl Worker {
    fn start(program: &Path) -> Result<Worker, String> {
        let mut command = Command::new(program);
        command.arg("--worker").stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn().map_err(|error| format!("cannot start a worker: {error}"))?;
        let (requests, out) = (child.stdin.take(), child.stdout.take());
        let (requests, out) = requests.zip(out).expect("both are piped");
        let (tell, answers) = unbounded();
        // It ends with the worker.
        std::thread::spawn(move || {
            let lines = BufReader::new(out).lines().map_while(Result::ok);
            lines.map_while(|line| tell.send(line).ok()).for_each(drop);
        });
        Ok(Worker { child, requests, answers })
    }

    fn ask(&mut self, request: &Request, patience: Duration) -> Result<Answer, String> {
        let mut line = serde_json::to_vec(request).expect("it is made of texts");
        line.push(b'\n');
        // If it is gone, that is what is seen next.
        let _ = self.requests.write_all(&line);
        match self.answers.recv_timeout(patience) {
            Ok(line) => {
                serde_json::from_str(&line).map_err(|error| format!("the worker's answer is none: {error}"))
            }
            Err(RecvTimeoutError::Timeout) => Err(format!("no outcome within {} s", patience.as_secs())),
            Err(RecvTimeoutError::Disconnected) => Err(match self.child.wait() {
                Ok(status) => format!("the worker died: {status}"),
                Err(error) => format!("the worker died: {error}"),
            }),
        }
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_come_back_from_their_digits_and_other_texts_are_none() {
        let all: Vec<u8> = (0..=255).collect();
        assert_eq!(bytes(&digits(&all)), Some(all));
        for text in ["0", "0g", "é0"] {
            assert_eq!(bytes(text), None, "{text}");
        }
    }

    #[test]
    fn a_request_of_another_build_or_without_a_scenario_is_refused() {
        let request = |build: &str| Request {
            run: "a run".into(),
            file: "outcome".into(),
            build: build.into(),
            scenario: "00".into(),
        };
        let failure = |answer| match answer {
            Answer::Failure(why) => why,
            Answer::Outcome(_) => "an outcome".into(),
        };
        assert_eq!(failure(request("1").answer("2")), "this worker is another build of cz (2, expected 1)");
        assert_eq!(failure(request("1").answer("1")), "the request's scenario is not one");
    }
}
