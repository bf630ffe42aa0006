//! The pictures of the documents, and some more to be looked at after a change:
//!
//! ```text
//! cargo test -p cz-view --test pictures -- --ignored
//! ```
//!
//! writes those of the documents to docs/figures, or all to `CZ_PICTURES` where that is set. Needs a Chromium, and for the
//! picture of a report `cz-report` beside `cz-view`.

#![allow(clippy::unwrap_used)]

mod common;

use common::browser::Browser;
use common::{Page, record, record_as};
use std::path::{Path, PathBuf};
use std::process::Command;

const SIZE: (u32, u32) = (1240, 780);
/// Those the documents use.
const IN_DOCUMENTS: [&str; 2] = ["view-merge.png", "view-vehicle.png"];
const READY: &str =
    "window.view && view.state.maps?.length && view.state.runs.every(r => r.status.is_complete)";

fn figures() -> PathBuf {
    let docs = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../docs/figures");
    std::env::var_os("CZ_PICTURES").map_or(docs, PathBuf::from)
}

/// What is to be seen.
struct Shot<'a> {
    name: &'a str,
    step: u64,
    /// Done before the picture is taken.
    script: &'a str,
    /// The vehicle chosen: `at` of those in the step that owe something, the ones with most duties first.
    chooses: Option<usize>,
}

fn take(browser: &Browser, page: &Page, shot: &Shot<'_>) {
    let Shot { name, step, script, chooses } = shot;
    if std::env::var_os("CZ_PICTURES").is_none() && !IN_DOCUMENTS.contains(name) {
        return;
    }
    browser.open(page.address());
    browser.until(READY);
    browser.evaluate("view.setTheme('light')");
    browser.evaluate(&format!("view.goto({step})"));
    let settled =
        format!("view.state.shownTime === {step} && view.state.maps.every(m => m.frame?.step === {step})");
    browser.until(&settled);
    if let Some(at) = chooses {
        browser.evaluate(&format!(
            "(async () => {{ const f = view.state.maps[0].frame, all = []; \
             for (let i = 0; i < f.count; i++) {{ const id = f.u32[f.at(i)]; \
             const d = await (await fetch(`api/vehicle?run=0&step={step}&vehicle=${{id}}`)).json(); all.push([d.duties?.length ?? 0, id]); }} \
             all.sort((a, b) => b[0] - a[0] || a[1] - b[1]); view.select({{ vehicle: all[{at}][1] }}); }})()"
        ));
        browser.until("view.state.detail?.vehicle === view.state.vehicle && view.state.course");
    } else {
        browser.until("view.state.detail?.zones");
    }
    browser.evaluate(&format!("(() => {{ {script}; view.state.dirty = true; }})()"));
    // Lines and traces are fetched when they are wanted first.
    std::thread::sleep(std::time::Duration::from_millis(2500));
    browser.evaluate("view.state.dirty = true");
    std::thread::sleep(std::time::Duration::from_millis(700));
    keep(browser, name);
}

fn keep(browser: &Browser, name: &str) {
    let path = figures().join(name);
    browser.picture(&path);
    println!("{} ({} kB)", path.display(), std::fs::metadata(&path).unwrap().len() / 1000);
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// What `cz report` makes of a recording, where its figures begin.
fn report(browser: &Browser, recording: &Path) {
    let program = Path::new(env!("CARGO_BIN_EXE_cz-view")).with_file_name("cz-report");
    if !program.is_file() {
        eprintln!("{} is not built: no picture of a report", program.display());
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    let page = directory.path().join("report.html");
    let made = Command::new(program).arg(recording).arg("--out").arg(&page).output().unwrap();
    assert!(made.status.success(), "{made:?}");
    browser.open(&format!("file://{}", page.display()));
    browser.evaluate("document.querySelector('#figures').scrollIntoView()");
    std::thread::sleep(std::time::Duration::from_millis(300));
    keep(browser, "report.png");
}

#[test]
#[ignore = "makes pictures"]
fn pictures() {
    let Some(browser) = Browser::start(SIZE) else { return };
    let shot = |name, step, script, chooses| Shot { name, step, script, chooses };
    let merge = record("two-merges", &[]);
    let page = Page::of(&[merge.path()]);
    take(&browser, &page, &shot("view-merge.png", 1500, "", None));
    take(
        &browser,
        &page,
        &shot("view-dark.png", 1500, "view.setTheme('dark'); view.setColour('verdict'); view.panel(1)", None),
    );
    report(&browser, merge.path());
    let intersection = record("intersection", &[]);
    let page = Page::of(&[intersection.path()]);
    take(&browser, &page, &shot("view-intersection.png", 600, "view.zoom(2)", None));
    take(&browser, &page, &shot("view-vehicle.png", 600, "view.zoom(4)", Some(0)));
    let roundabout = record("roundabout", &[]);
    let page = Page::of(&[roundabout.path()]);
    take(&browser, &page, &shot("view-roundabout.png", 1500, "view.setColour('mode')", None));
    let other = record_as("gain-1.5.czlog", "paper", &["--set", "zones.merge-1.flow.gain_mps=1.5"]);
    let paper = record("paper", &[]);
    let page = Page::of(&[paper.path(), other.path()]);
    take(
        &browser,
        &page,
        &shot("view-two-runs.png", 1500, "view.select({ vehicle: 40 }); view.panel(2)", None),
    );
}
