//! The page in a browser: what it says of a vehicle is what `cz show` says.
//!
//! Runs where a Chromium is installed; elsewhere it says so and tests nothing.

#![allow(clippy::unwrap_used)]

mod common;

use common::browser::Browser;
use common::{Page, Recording, record, record_steps};
use control_zones::bench::{Family, side_by_side};
use control_zones::record::{InForce, Reader, words};
use control_zones::scenario::{Override, load_embedded};
use serde_json::{Value, json};

const READY: &str =
    "window.view && view.state.maps?.[0]?.frame && view.state.runs.every(r => r.status.is_complete)";

/// A browser in which a recording is open, its page, and the recording; nothing where no browser is installed.
fn open(file: impl FnOnce() -> Recording) -> Option<(Browser, Page, Recording)> {
    let browser = Browser::start((1440, 900))?;
    let file = file();
    let page = Page::of(&[file.path()]);
    browser.open(page.address());
    browser.until(READY);
    Some((browser, page, file))
}

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
    let Some((browser, _page, file)) = open(|| record("two-merges", &["--set", "end.vehicles=50"])) else {
        return;
    };
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
    // From which step on they differ, and a way there.
    let readers = [first.path(), second.path()].map(|file| Reader::open(file).unwrap());
    let hash = |run: usize, step: u64| readers[run].step(step).unwrap().unwrap().state_hash;
    let differs = (0..).find(|&step| hash(0, step) != hash(1, step)).unwrap();
    assert!(differs > 0);
    browser.until("document.querySelector('[data-field=differs] button')");
    browser.evaluate("document.querySelector('[data-field=differs] button').click()");
    browser.until(&format!("view.state.maps.every(m => m.frame.step === {differs})"));
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// The pixel of a place on the first map.
fn pixel(browser: &Browser, place: &str) -> (f64, f64) {
    let at = browser.evaluate(&format!(
        "(() => {{ const m = view.state.maps[0], p = m.px(...{place}), b = m.canvas.getBoundingClientRect(); return [p[0] + b.x, p[1] + b.y]; }})()"
    ));
    (at[0].as_f64().unwrap(), at[1].as_f64().unwrap())
}

#[test]
fn a_zone_that_is_clicked_tells_its_order_and_v_m() {
    let Some((browser, _page, file)) = open(|| record("paper", &["--set", "end.vehicles=50"])) else {
        return;
    };
    let reader = Reader::open(file.path()).unwrap();
    let mut in_force = InForce::default();
    let mut orders = 0;
    for step in reader.steps().map(Result::unwrap) {
        in_force.take(&step);
        let number = step.header.step;
        if ![600, 1000, 1400].contains(&number) {
            continue;
        }
        go_to(&browser, number);
        browser.evaluate("view.select({})");
        // Where the lane that comes in begins, and nobody has entered yet.
        let (x, y) = pixel(&browser, "view.state.runs[0].network.zones[1].segments[1].shape[0]");
        browser.click(x - 3.0, y);
        browser.until("view.state.zone === 1 && view.state.detail?.name");
        let inside: Vec<u32> =
            step.state.iter().filter(|s| s.zone == 1 && !s.has_left()).map(|s| s.vehicle).collect();
        assert_eq!(shown(&browser, "n"), inside.len().to_string());
        let mut order: Vec<(u32, u32)> = in_force
            .of(1)
            .iter()
            .filter(|a| inside.contains(&a.vehicle))
            .map(|a| (a.rank, a.vehicle))
            .collect();
        order.sort_unstable();
        order.dedup();
        let told = browser.evaluate(
            "[...document.querySelectorAll('#side tr[data-vehicle]')].map(row => +row.dataset.vehicle)",
        );
        assert_eq!(
            told,
            json!(order.iter().map(|(_, vehicle)| vehicle).collect::<Vec<_>>()),
            "step {number}"
        );
        let v_m = in_force.of(1).iter().find(|a| inside.contains(&a.vehicle)).map(|a| a.terminal_speed_mps);
        if let Some(v_m) = v_m {
            assert_eq!(shown(&browser, "v_m"), format!("{v_m:.2} m/s"));
        }
        orders += order.len();
    }
    assert!(orders > 5, "{orders} places in orders compared");
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

#[test]
fn keys_zoom_theme_and_screens_of_many_pixels() {
    let Some((browser, _page, _file)) = open(|| record("two-merges", &["--set", "end.vehicles=20"])) else {
        return;
    };
    go_to(&browser, 300);
    let is = |expression: &str| assert_eq!(browser.evaluate(expression), Value::Bool(true), "{expression}");
    let press = |key: &str, until: &str| {
        browser.key(key);
        browser.until(until);
    };
    let fitted = browser.evaluate("view.state.view.scale");
    press("+", &format!("view.state.view.scale > {fitted}"));
    press("0", &format!("view.state.view.scale === {fitted}"));
    press("c", "view.state.colour === 'mode'");
    press("c", "view.state.colour === 'verdict'");
    press("n", "view.state.detail?.vehicle !== undefined && view.state.vehicle !== null");
    press("f", "view.state.keeps");
    press("Escape", "view.state.vehicle === null");
    press("End", "view.state.time === view.state.runs[0].status.last");
    press("Home", "view.state.time === 0");
    press("3", "document.querySelector('#tabs .is-on').textContent === 'Traffic'");
    press("?", "document.getElementById('help').open");
    browser.evaluate("document.getElementById('help').close()");
    let theme = browser.evaluate("document.documentElement.dataset.theme");
    press("d", &format!("document.documentElement.dataset.theme !== {theme}"));
    // As many pixels as the screen has.
    browser.call(
        "Emulation.setDeviceMetricsOverride",
        json!({ "width": 1200, "height": 800, "deviceScaleFactor": 2, "mobile": false }),
    );
    browser
        .until("Math.abs(view.state.maps[0].canvas.width - view.state.maps[0].canvas.clientWidth * 2) <= 2");
    is("devicePixelRatio === 2");
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// How a colour looks to whoever lacks one kind of cone (0 to 2) or none (3), in Oklab.
fn as_seen([r, g, b]: [f64; 3], lacking: usize) -> [f64; 3] {
    let linear = |c: f64| if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) };
    let [r, g, b] = [r, g, b].map(|c| linear(c / 255.0));
    // Vienot, Brettel and Mollon 1999; for the third the plane that keeps white and red (Brettel et al. 1997).
    let lms = [
        0.31399 * r + 0.63951 * g + 0.04650 * b,
        0.15537 * r + 0.75789 * g + 0.08670 * b,
        0.01775 * r + 0.10945 * g + 0.87257 * b,
    ];
    let [l, m, s] = match lacking {
        0 => [1.05118 * lms[1] - 0.05116 * lms[2], lms[1], lms[2]],
        1 => [lms[0], 0.95131 * lms[0] + 0.04867 * lms[2], lms[2]],
        2 => [lms[0], lms[1], -0.86745 * lms[0] + 1.86727 * lms[1]],
        _ => lms,
    };
    let rgb = [
        5.47221 * l - 4.64196 * m + 0.16963 * s,
        -1.12524 * l + 2.29317 * m - 0.16789 * s,
        0.02980 * l - 0.19318 * m + 1.16365 * s,
    ]
    .map(|c| c.clamp(0.0, 1.0));
    let root = |weights: [f64; 3]| weights.iter().zip(rgb).map(|(w, c)| w * c).sum::<f64>().cbrt();
    let (l, m, s) = (
        root([0.4122214708, 0.5363325363, 0.0514459929]),
        root([0.2119034982, 0.6806995451, 0.1073969566]),
        root([0.0883024619, 0.2817188376, 0.6299787005]),
    );
    [
        0.2104542553 * l + 0.7936177850 * m - 0.0040720468 * s,
        1.9779984951 * l - 2.4285922050 * m + 0.4505937099 * s,
        0.0259040371 * l + 0.7827717662 * m - 0.8086757660 * s,
    ]
}

#[test]
fn colours_can_be_told_apart_with_any_kind_of_colour_vision() {
    let Some((browser, _page, _file)) = open(|| record("two-merges", &["--set", "end.vehicles=5"])) else {
        return;
    };
    for theme in ["light", "dark"] {
        browser.evaluate(&format!("view.setTheme('{theme}')"));
        // As the canvas takes them: rgb.
        let palette = |name: &str| -> Vec<[f64; 3]> {
            let colours = browser.evaluate(&format!(
                "view.state.palettes.{name}.map(c => {{ const x = document.createElement('canvas').getContext('2d'); x.fillStyle = c; x.fillRect(0, 0, 1, 1); return [...x.getImageData(0, 0, 1, 1).data].slice(0, 3); }})"
            ));
            serde_json::from_value(colours).unwrap()
        };
        let [lane, pane]: [[f64; 3]; 2] = {
            let of = |name: &str| {
                let colour = browser.evaluate(&format!(
                    "(() => {{ const x = document.createElement('canvas').getContext('2d'); x.fillStyle = view.state.theme['{name}']; x.fillRect(0, 0, 1, 1); return [...x.getImageData(0, 0, 1, 1).data].slice(0, 3); }})()"
                ));
                serde_json::from_value(colour).unwrap()
            };
            [of("lane"), of("pane")]
        };
        let speed = palette("speed");
        // Slow, half way and fast; and each mode, verdict.
        let sets = [
            vec![speed[0], speed[speed.len() / 2], speed[speed.len() - 1]],
            palette("mode"),
            palette("verdict"),
        ];
        for (set, lacking) in sets.iter().flat_map(|set| (0..4).map(move |lacking| (set, lacking))) {
            for (at, a) in set.iter().enumerate() {
                let others = set[at + 1..].iter().chain([&lane, &pane]);
                for b in others {
                    let (seen_a, seen_b) = (as_seen(*a, lacking), as_seen(*b, lacking));
                    let apart: f64 =
                        seen_a.iter().zip(seen_b).map(|(x, y)| (x - y) * (x - y)).sum::<f64>().sqrt();
                    assert!(
                        apart > 0.05,
                        "{theme}: {a:?} and {b:?} are {apart:.3} apart without cone {lacking}"
                    );
                }
            }
        }
    }
}

#[test]
fn what_is_missing_of_a_run_is_said() {
    let overrides: Vec<Override> = vec!["end.vehicles=20".parse().unwrap()];
    let scenario = load_embedded("two-merges", &overrides, None).unwrap();
    // As of a run that goes as fast as it can.
    let Some((browser, page, file)) =
        open(|| record_steps("some.czlog", scenario, |step| step.is_multiple_of(7)))
    else {
        return;
    };
    let steps: Vec<u64> = Reader::open(file.path()).unwrap().step_numbers().collect();
    let missing = steps[steps.len() - 1] + 1 - steps.len() as u64;
    browser.evaluate("view.goto(703)");
    // The step before is drawn, and a click in between finds everybody on the way to the next.
    browser.until("view.state.maps[0].frame?.step === 700 && view.state.maps[0].next?.step === 707");
    browser.evaluate("view.goto(700)");
    browser.until("document.querySelector('[data-field=skipped]')");
    assert_eq!(shown(&browser, "skipped"), format!("{missing} steps"));
    let events = page.get("events");
    let texts: Vec<&str> =
        events["events"].as_array().unwrap().iter().map(|event| event["text"].as_str().unwrap()).collect();
    assert_eq!(texts, [format!("{missing} of the steps 1 to {} are missing", steps[steps.len() - 1] - 1)]);
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// ```text
/// cargo test --release -p cz-view --test browser -- --ignored --nocapture
/// ```
#[test]
#[ignore = "a measurement: frames per second with ten thousand vehicles"]
fn ten_thousand_vehicles() {
    let scenario = side_by_side(Family::Corridors, 10_000, 90.0).unwrap();
    let Some((browser, _page, _file)) = open(|| record_steps("many.czlog", scenario, |step| step >= 700))
    else {
        return;
    };
    browser.evaluate("view.goto(705)");
    browser.until("view.state.maps[0].frame?.step === 705");
    let vehicles = browser.evaluate("view.state.maps[0].frame.count");
    for (what, script) in [
        ("all shown", "0"),
        ("all shown, without diagrams", "document.getElementById('panels').classList.add('is-off')"),
        ("about a hundred shown", "view.zoom(8)"),
    ] {
        browser.evaluate(&format!("(() => {{ {script}; view.goto(710); view.play(); }})()"));
        std::thread::sleep(std::time::Duration::from_secs(2));
        let per_second = browser.evaluate(
            "new Promise(done => { const from = view.state.drawn, at = performance.now(); \
             setTimeout(() => done((view.state.drawn - from) * 1000 / (performance.now() - at)), 8000); })",
        );
        println!("{vehicles} vehicles, {what}: {:.1} frames per second", per_second.as_f64().unwrap());
        browser.evaluate("view.goto(705)");
    }
    assert_eq!(browser.complaints(), Vec::<String>::new());
}
