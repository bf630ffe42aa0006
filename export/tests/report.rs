//! A page says what the run's summary says, needs nothing from elsewhere, and opens in a browser without a complaint.

#![allow(clippy::unwrap_used)]

mod common;

use common::Recording;
use std::path::Path;
use std::process::{Command, Output, Stdio};

fn report(arguments: &[&str], directory: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cz-report"));
    command.args(arguments).current_dir(directory).stdin(Stdio::null());
    command.output().unwrap()
}

fn said(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// The page of some recordings.
fn page_of(recordings: &[&Recording], more: &[&str]) -> String {
    let out = recordings[0].directory().join("report.html");
    let paths: Vec<&str> = recordings.iter().map(|r| r.path.to_str().unwrap()).collect();
    let arguments = [&paths[..], &["--out", out.to_str().unwrap()], more].concat();
    let output = report(&arguments, recordings[0].directory());
    assert!(output.status.success(), "{}", said(&output.stderr));
    std::fs::read_to_string(out).unwrap()
}

#[test]
fn the_page_of_a_run_is_small_whole_and_true() {
    let recording = Recording::of("paper", &[]);
    let directory = recording.directory().join("figures");
    let page =
        page_of(&[&recording], &["--png", directory.to_str().unwrap(), "--svg", directory.to_str().unwrap()]);
    assert!(page.len() < 5_000_000, "{} bytes", page.len());
    // Nothing from elsewhere: the only addresses are names of namespaces.
    for (at, _) in page.match_indices("http") {
        assert!(page[at..].starts_with("http://www.w3.org/"), "{}", &page[at..at + 60]);
    }
    assert!(!page.contains("<script"));
    for zone in &recording.summary.zones {
        for value in [zone.mean_time_s, zone.mean_energy, zone.mean_objective] {
            assert!(page.contains(&format!("<td class=\"n\">{value:.3}</td>")), "{}: {value:.3}", zone.zone);
        }
        assert!(page.contains(&format!("<td class=\"n\">{}</td>", zone.fe_vehicles)));
    }
    assert!(page.contains(&format!("{:016x}", recording.summary.state_hash)));
    for what in
        ["map", "time-space-merge-1-", "speed-merge-2", "acceleration-merge-1", "margins-merge-2", "inside"]
    {
        let name = format!("id=\"{what}");
        assert!(page.contains(&name), "no {name}");
        let file = |ending: &str| {
            std::fs::read_dir(&directory).unwrap().any(|entry| {
                let name = entry.unwrap().file_name().into_string().unwrap();
                name.starts_with(what) && name.ends_with(ending)
            })
        };
        assert!(file(".png") && file(".svg"), "no picture of {what}");
    }
    // Why a vehicle braked, in words, and every link within the page leads somewhere.
    assert!(page.contains("too close to vehicle") || page.contains("would have to brake at"));
    for (at, _) in page.match_indices("href=\"#") {
        let anchor = page[at + 7..].split('"').next().unwrap();
        assert!(page.contains(&format!("id=\"{anchor}\"")), "nothing is called {anchor}");
    }
    in_a_browser(&recording, "report.html");
}

/// Opens a page with the network off: no message on its console, and what is on it is on it.
fn in_a_browser(recording: &Recording, name: &str) {
    let browsers = ["chromium", "chromium-browser", "google-chrome"];
    let named = std::env::var("CZ_CHROMIUM").ok();
    let all = named.iter().map(String::as_str).chain(browsers);
    let is_there = |browser: &&str| {
        Command::new(browser)
            .arg("--version")
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .status()
            .is_ok_and(|s| s.success())
    };
    let Some(browser) = all.into_iter().find(is_there) else {
        eprintln!("not opened in a browser: none of {} is installed", browsers.join(", "));
        return;
    };
    let profile = recording.directory().join("profile");
    let output = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"])
        .args(["--disable-background-networking", "--disable-component-update", "--disable-sync"])
        .args(["--host-resolver-rules=MAP * ~NOTFOUND", "--proxy-server=127.0.0.1:9"])
        .args(["--enable-logging=stderr", "--timeout=60000", "--dump-dom"])
        .arg(format!("--user-data-dir={}", profile.display()))
        .arg(format!("file://{}", recording.directory().join(name).display()))
        .stdin(Stdio::null())
        .output()
        .unwrap();
    let (dom, log) = (said(&output.stdout), said(&output.stderr));
    assert!(output.status.success(), "{log}");
    let console: Vec<&str> = log.lines().filter(|line| line.contains("CONSOLE")).collect();
    assert!(console.is_empty(), "{console:?}");
    assert!(dom.matches("<figure").count() >= 10 && dom.contains("</svg>"), "{} bytes of page", dom.len());
}

#[test]
fn seeds_are_a_group_with_intervals_and_settings_are_compared() {
    let run = |sets: &[&str], seed: u64| Recording::seeded("paper", sets, Some(seed));
    let short = "end.vehicles=30";
    let fixed = "zones.merge-1.flow={policy=\"fixed\",terminal_mps=12}";
    let recordings = [run(&[short], 1), run(&[short], 2), run(&[short, fixed], 1), run(&[short, fixed], 2)];
    let page = page_of(&recordings.each_ref(), &[]);
    assert!(page.contains("seeds 1, 2"), "one group of two seeds");
    assert!(page.contains(" ± "), "intervals");
    assert!(page.contains("id=\"differences\"") && page.contains("first difference: step"));
    // The difference of the means is the mean of the differences.
    let total = |at: usize| {
        let Recording { summary, beta, .. } = &recordings[at];
        summary.zones.iter().map(|zone| zone.mean_objective + beta * zone.mean_wait_s).sum::<f64>()
    };
    let difference = 0.5 * (total(2) - total(0) + total(3) - total(1));
    assert!(page.contains(&format!("{difference:+.3} ± ")), "{difference:+.3}");
    let alone = page_of(&[&recordings[0]], &[]);
    assert!(!alone.contains("id=\"differences\"") && !alone.contains("seeds"));
}

#[test]
fn a_recording_that_was_cut_off_is_reported_as_far_as_it_goes() {
    let recording = Recording::of("paper", &["end.vehicles=20"]);
    let bytes = std::fs::read(&recording.path).unwrap();
    std::fs::write(&recording.path, &bytes[..bytes.len() / 2]).unwrap();
    let page = page_of(&[&recording], &[]);
    assert!(page.contains("the recording has no end: it was cut off"));
    // A wrong byte is another matter: the page is made, and the exit code says so.
    let mut wrong = bytes.clone();
    wrong[bytes.len() / 3] ^= 1;
    std::fs::write(&recording.path, wrong).unwrap();
    let output = report(&[recording.path.to_str().unwrap()], recording.directory());
    assert_eq!(output.status.code(), Some(2));
    assert!(said(&output.stderr).contains("damaged at"), "{}", said(&output.stderr));
    let page = std::fs::read_to_string(recording.directory().join("report.html")).unwrap();
    assert!(page.contains("results are known up to step"), "what the page lacks is on it");
}

#[test]
fn what_is_no_recording_or_no_summary_is_refused_in_a_line() {
    let recording = Recording::of("paper", &["end.time_s=10"]);
    let directory = recording.directory();
    std::fs::write(directory.join("other.json"), "{\"processes\":1}").unwrap();
    let file = recording.path.to_str().unwrap();
    for (arguments, words) in [
        (&["missing.czlog"][..], "missing.czlog: cannot read it"),
        (&["other.json"], "other.json: not a recording"),
        (&[file, "--summary", "other.json"], "expected what `cz run --json` writes"),
    ] {
        let output = report(arguments, directory);
        let error = said(&output.stderr);
        assert_eq!((output.status.code(), error.lines().count()), (Some(2), 1), "{error}");
        assert!(error.starts_with("cz: ") && error.contains(words), "{error}");
    }
}
