//! The pictures of docs/view.md and of the README:
//!
//! ```text
//! cargo test -p cz-view --test pictures -- --ignored
//! ```
//!
//! writes them to docs/figures, or to `CZ_PICTURES` where that is set. Needs a Chromium.

#![allow(clippy::unwrap_used)]

mod common;

use common::browser::Browser;
use common::{Page, record, record_as};
use std::path::PathBuf;

const SIZE: (u32, u32) = (1440, 900);
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
    let path = figures().join(name);
    browser.picture(&path);
    println!("{} ({} kB)", path.display(), std::fs::metadata(&path).unwrap().len() / 1000);
    assert_eq!(browser.complaints(), Vec::<String>::new());
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
