//! A recording, and the page that shows it.

#![allow(dead_code, clippy::unwrap_used)]

pub mod browser;

use control_zones::process::{StopFlag, run_in_process_observed};
use control_zones::record::{Metadata, Processes, Recorder, RunEnd, ScenarioSource};
use control_zones::scenario::{Override, Scenario, load_embedded};
use serde_json::Value;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::Duration;

/// A recording that goes with the test.
pub struct Recording {
    _directory: tempfile::TempDir,
    path: PathBuf,
}

impl Recording {
    pub fn path(&self) -> &Path {
        &self.path
    }
}

/// Runs an embedded scenario in this process and records it.
pub fn record(name: &str, set: &[&str]) -> Recording {
    record_as(&format!("{name}.czlog"), name, set)
}

/// The same, in a file of that name.
pub fn record_as(file: &str, name: &str, set: &[&str]) -> Recording {
    let overrides: Vec<Override> =
        set.iter().filter(|set| **set != "--set").map(|set| set.parse().unwrap()).collect();
    record_steps(file, load_embedded(name, &overrides, None).unwrap(), |_| true)
}

/// Runs a scenario in this process and records some of its steps.
pub fn record_steps(file: &str, scenario: Scenario, keeps: impl Fn(u64) -> bool) -> Recording {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join(file);
    let scenario = Arc::new(scenario);
    let processes = Processes { coordinators: 1, controllers: 1 };
    let metadata = Metadata::new(&scenario, ScenarioSource::default(), 1, processes);
    let mut recorder = Recorder::create(&path, &metadata).unwrap();
    let stop = StopFlag::default();
    run_in_process_observed(
        &scenario,
        1,
        1,
        &stop,
        |_| {},
        |frames| {
            assert!(!keeps(frames.header.step) || recorder.push_or_wait(frames));
        },
    )
    .unwrap();
    recorder.finish(RunEnd::Finished).unwrap();
    Recording { _directory: directory, path }
}

/// A page that is served.
pub struct Page {
    child: Child,
    address: String,
}

impl Page {
    /// The page of some recordings.
    pub fn of(files: &[&Path]) -> Page {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cz-view"));
        command.args(files);
        Page::begin(command)
    }

    /// The page of a program that prints its address first.
    pub fn begin(mut command: Command) -> Page {
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
        let mut address = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut address).unwrap();
        let address = address.trim().to_owned();
        assert!(address.starts_with("http://127.0.0.1:"), "no address but {address:?}");
        Page { child, address }
    }

    pub fn address(&self) -> &str {
        &self.address
    }

    pub fn port(&self) -> u16 {
        self.address.split(['/', ':']).nth(4).unwrap().parse().unwrap()
    }

    pub fn token(&self) -> &str {
        self.address.split('/').nth(3).unwrap()
    }

    /// Asks as it is said, and returns status, head and body.
    pub fn ask(&self, method: &str, path: &str, headers: &[(&str, &str)]) -> (u16, String, String) {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port())).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        let headers: String = headers.iter().map(|(name, value)| format!("{name}: {value}\r\n")).collect();
        write!(stream, "{method} {path} HTTP/1.1\r\n{headers}Content-Length: 0\r\nConnection: close\r\n\r\n")
            .unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let answer = String::from_utf8_lossy(&answer).into_owned();
        let (head, body) = answer.split_once("\r\n\r\n").unwrap();
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        (status, head.to_lowercase(), body.to_owned())
    }

    /// Asks for something to be done, as the page would.
    pub fn post(&self, what: &str, body: &Value) -> (u16, String) {
        let (host, body) = (format!("127.0.0.1:{}", self.port()), body.to_string());
        let mut stream = TcpStream::connect(&host).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        let path = format!("/{}/api/{what}", self.token());
        let length = body.len();
        write!(
            stream,
            "POST {path} HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nContent-Type: application/json\r\n\
             Content-Length: {length}\r\nConnection: close\r\n\r\n{body}"
        )
        .unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        let (head, body) = answer.split_once("\r\n\r\n").unwrap();
        (head.split(' ').nth(1).unwrap().parse().unwrap(), body.to_owned())
    }

    /// What the page would be told.
    pub fn get(&self, what: &str) -> Value {
        let host = format!("127.0.0.1:{}", self.port());
        let (status, _, body) = self.ask("GET", &format!("/{}/api/{what}", self.token()), &[("Host", &host)]);
        assert_eq!(status, 200, "{what}: {body}");
        serde_json::from_str(&body).unwrap()
    }

    /// The same once it says so.
    pub fn get_until(&self, what: &str, is_so: impl Fn(&Value) -> bool) -> Value {
        for _ in 0..1200 {
            let value = self.get(what);
            if is_so(&value) {
                return value;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        panic!("{what} never said what was awaited: {}", self.get(what));
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
