//! The page in a browser: what it says of a vehicle is what `cz show` says.
//!
//! Runs where a Chromium is installed; elsewhere it says so and tests nothing.

#![allow(clippy::unwrap_used)]

mod common;

use common::browser::Browser;
use common::{Page, record};
use control_zones::record::{Reader, words};
use serde_json::Value;

const READY: &str =
    "window.view && view.state.maps?.[0]?.frame && view.state.runs.every(r => r.status.is_complete)";

fn shown(browser: &Browser, field: &str) -> String {
    let text =
        browser.evaluate(&format!("document.querySelector('#side [data-field={field}]')?.textContent ?? ''"));
    text.as_str().unwrap().to_owned()
}

/// Goes to a step and waits until map and details are of it.
fn go_to(browser: &Browser, step: u64) {
    browser.evaluate(&format!("view.goto({step})"));
    browser.until(&format!(
        "view.state.maps[0].frame.step === {step} && view.state.detail?.step === {step} && view.state.shownTime === {step}"
    ));
}

#[test]
fn clicking_and_scrubbing_tell_of_a_vehicle_what_the_recording_holds() {
    let Some(browser) = Browser::start((1440, 900)) else { return };
    let file = record("two-merges", &["--set", "end.vehicles=50"]);
    let page = Page::of(&[file.path()]);
    browser.open(page.address());
    browser.until(READY);
    let reader = Reader::open(file.path()).unwrap();
    let scenario = reader.scenario();
    let mut compared = 0;
    for number in [700_u64, 1000, 1480] {
        go_to(&browser, number);
        let step = reader.step(number).unwrap().unwrap();
        for state in step.state.iter().filter(|s| !s.has_left()) {
            // By hand: the pixel at which the vehicle is drawn, and nothing else there.
            let place = browser.evaluate(&format!(
                "(() => {{ const p = view.placeOf({}), b = view.state.maps[0].canvas.getBoundingClientRect(); return p && [p[0] + b.x, p[1] + b.y]; }})()",
                state.vehicle
            ));
            let at = |i: usize| place[i].as_f64().expect("a vehicle in the network is drawn");
            browser.click(at(0), at(1));
            browser.until(&format!(
                "view.state.vehicle === {0} && view.state.detail?.vehicle === {0}",
                state.vehicle
            ));
            let command =
                step.commands.iter().flat_map(|part| &part.records).find(|c| c.vehicle == state.vehicle);
            assert_eq!(shown(&browser, "place"), words::place(scenario, state));
            assert_eq!(shown(&browser, "x_m"), format!("{:.3} m", state.x_m));
            assert_eq!(shown(&browser, "v_mps"), format!("{:.3} m/s", state.v_mps));
            if let Some(command) = command {
                assert_eq!(shown(&browser, "u_mps2"), format!("{:.4} m/s²", command.u_mps2));
                assert_eq!(shown(&browser, "mode"), words::mode(command));
                assert_eq!(shown(&browser, "verdict"), words::verdict(command));
            }
            compared += 1;
        }
    }
    assert!(compared > 20, "{compared} vehicles compared");

    // The scrubber leads to the same step as its number says, and the clock says so.
    browser.evaluate("(() => { const s = document.getElementById('scrub'); s.value = 1200; s.dispatchEvent(new Event('input')); })()");
    browser.until("view.state.maps[0].frame.step === 1200 && view.state.shownTime === 1200");
    let clock = browser.evaluate("document.getElementById('clock').textContent");
    assert_eq!(clock, Value::from("120.0 s step 1200"));
    browser.key("ArrowRight");
    browser.until("view.state.maps[0].frame.step === 1201");
    let hash = browser.evaluate("view.state.maps[0].frame.hash");
    assert_eq!(hash, Value::from(format!("{:016x}", reader.step(1201).unwrap().unwrap().state_hash)));
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

#[test]
fn two_recordings_are_shown_at_the_same_step() {
    let Some(browser) = Browser::start((1440, 900)) else { return };
    let first = record("paper", &["--set", "end.vehicles=20"]);
    let second = record("paper", &["--set", "end.vehicles=20", "--set", "zones.merge-1.flow.gain_mps=0.05"]);
    let page = Page::of(&[first.path(), second.path()]);
    browser.open(page.address());
    browser.until("window.view && view.state.maps?.length === 2 && view.state.maps.every(m => m.frame)");
    browser.evaluate("view.goto(250)");
    browser.until("view.state.maps.every(m => m.frame.step === 250)");
    for (at, file) in [first.path(), second.path()].iter().enumerate() {
        let step = Reader::open(file).unwrap().step(250).unwrap().unwrap();
        let hash = browser.evaluate(&format!("view.state.maps[{at}].frame.hash"));
        assert_eq!(hash, Value::from(format!("{:016x}", step.state_hash)));
    }
    assert_eq!(browser.complaints(), Vec::<String>::new());
}
