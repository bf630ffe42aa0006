//! The pictures of the documents:
//!
//! ```text
//! cargo test --release --workspace --test pictures -- --ignored
//! ```
//!
//! writes them to docs/figures, or to `CZ_PICTURES` where that is set. Needs a Chromium, and for the picture of a report
//! `cz-report` beside `cz-view`.

#![allow(clippy::unwrap_used)]

mod common;

use common::browser::Browser;
use common::{Page, record, record_as};
use png::{BitDepth, BlendOp, ColorType, Compression, Decoder, DisposeOp, Encoder};
use std::collections::HashMap;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::process::Command;

const SIZE: (u32, u32) = (1240, 780);
/// Of networks that are long and flat.
const FLAT: (u32, u32) = (1240, 620);
const READY: &str =
    "window.view && view.state.maps?.length && view.state.runs.every(r => r.status.is_complete)";

fn figures() -> PathBuf {
    let docs = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../docs/figures");
    std::env::var_os("CZ_PICTURES").map_or(docs, PathBuf::from)
}

/// Pixels: red, green, blue.
struct Pixels {
    width: u32,
    height: u32,
    rgb: Vec<[u8; 3]>,
}

impl Pixels {
    /// What a browser shows, or the part of it between two corners.
    fn of(browser: &Browser, part: Option<[u32; 4]>) -> Pixels {
        let bytes = browser.picture();
        let mut reader = Decoder::new(&bytes[..]).read_info().unwrap();
        let mut buffer = vec![0; reader.output_buffer_size()];
        let info = reader.next_frame(&mut buffer).unwrap();
        let [left, top, right, bottom] = part.unwrap_or([0, 0, info.width, info.height]);
        let samples = info.color_type.samples();
        let rows = buffer.chunks_exact(info.width as usize * samples);
        let rgb = rows.skip(top as usize).take((bottom - top) as usize).flat_map(|row| {
            let pixels = row.chunks_exact(samples).skip(left as usize).take((right - left) as usize);
            pixels.map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect::<Vec<_>>()
        });
        Pixels { width: right - left, height: bottom - top, rgb: rgb.collect() }
    }
}

/// At most 256 colours that stand for all that are seen: the most frequent ones, and for every other the nearest of them.
/// A page has few, and the edges of letters.
struct Palette {
    colours: Vec<[u8; 3]>,
    index: HashMap<[u8; 3], u8>,
}

/// Of a moving picture: where nothing has changed.
const UNCHANGED: u8 = 255;

impl Palette {
    fn of(all: &[Pixels]) -> Palette {
        let mut count: HashMap<[u8; 3], u64> = HashMap::new();
        all.iter().flat_map(|pixels| &pixels.rgb).for_each(|pixel| *count.entry(*pixel).or_default() += 1);
        let mut seen: Vec<([u8; 3], u64)> = count.into_iter().collect();
        seen.sort_unstable_by_key(|(colour, count)| (std::cmp::Reverse(*count), *colour));
        let colours: Vec<[u8; 3]> = seen.iter().take(255).map(|(colour, _)| *colour).collect();
        let apart = |a: [u8; 3], b: [u8; 3]| {
            a.iter().zip(b).map(|(x, y)| i32::from(x.abs_diff(y)).pow(2)).sum::<i32>()
        };
        let nearest =
            |colour: [u8; 3]| (0..colours.len()).min_by_key(|at| apart(colours[*at], colour)).unwrap() as u8;
        let index = seen.iter().map(|(colour, _)| (*colour, nearest(*colour))).collect();
        Palette { colours, index }
    }

    fn encoder(&self, name: &str, of: &Pixels) -> Encoder<'static, File> {
        let file = BufWriter::new(std::fs::File::create(figures().join(name)).unwrap());
        let mut encoder = Encoder::new(file, of.width, of.height);
        encoder.set_color(ColorType::Indexed);
        encoder.set_depth(BitDepth::Eight);
        encoder.set_compression(Compression::Best);
        let mut all = self.colours.clone();
        all.resize(256, [0; 3]);
        encoder.set_palette(all.into_flattened());
        let mut alpha = vec![255; 256];
        alpha[usize::from(UNCHANGED)] = 0;
        encoder.set_trns(alpha);
        encoder
    }
}

type File = BufWriter<std::fs::File>;

/// Writes pictures that follow each other, with `each_ms` between them; or one that does not move.
fn write(name: &str, all: &[Pixels], each_ms: u16) {
    let palette = Palette::of(all);
    let mut encoder = palette.encoder(name, &all[0]);
    if all.len() > 1 {
        encoder.set_animated(all.len() as u32, 0).unwrap();
        encoder.set_frame_delay(each_ms, 1000).unwrap();
        encoder.set_dispose_op(DisposeOp::None).unwrap();
        encoder.set_blend_op(BlendOp::Over).unwrap();
    }
    let indices = |pixels: &Pixels| pixels.rgb.iter().map(|pixel| palette.index[pixel]).collect::<Vec<u8>>();
    let mut writer = encoder.write_header().unwrap();
    let mut before = indices(&all[0]);
    writer.write_image_data(&before).unwrap();
    for pixels in &all[1..] {
        let now = indices(pixels);
        let changed =
            before.iter().zip(&now).map(|(before, now)| if before == now { UNCHANGED } else { *now });
        writer.write_image_data(&changed.collect::<Vec<u8>>()).unwrap();
        before = now;
    }
    writer.finish().unwrap();
    let path = figures().join(name);
    println!("{} ({} kB)", path.display(), std::fs::metadata(&path).unwrap().len() / 1000);
}

/// What is to be seen.
struct Shot<'a> {
    name: &'a str,
    size: (u32, u32),
    step: u64,
    /// Done before the picture is taken.
    script: &'a str,
    /// The vehicle chosen: `at` of those in the step that owe something, the ones with most duties first.
    chooses: Option<usize>,
}

/// Shows a step of whatever is open.
fn go_to(browser: &Browser, step: u64) {
    browser.evaluate(&format!("view.goto({step})"));
    browser.until(&format!(
        "view.state.shownTime === {step} && view.state.maps.every(m => m.frame?.step === {step})"
    ));
}

fn prepare(browser: &Browser, page: &Page, shot: &Shot<'_>) {
    let Shot { size, step, script, chooses, .. } = shot;
    browser.resize(*size);
    browser.open(page.address());
    browser.until(READY);
    browser.evaluate("view.setTheme('light')");
    go_to(browser, *step);
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
}

fn take(browser: &Browser, page: &Page, shot: &Shot<'_>) {
    prepare(browser, page, shot);
    write(shot.name, &[Pixels::of(browser, None)], 0);
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// The map alone, step after step as fast as they were.
fn take_moving(browser: &Browser, page: &Page, shot: &Shot<'_>, steps: u64) {
    prepare(browser, page, shot);
    let corners = browser.evaluate(
        "(() => { const b = view.state.maps[0].canvas.getBoundingClientRect(); return [b.left, b.top, b.right, b.bottom].map(Math.round); })()",
    );
    let corners: [u32; 4] = serde_json::from_value(corners).unwrap();
    let all: Vec<Pixels> = (shot.step..shot.step + steps)
        .map(|step| {
            go_to(browser, step);
            browser.until(&format!("view.state.detail?.step === {step}"));
            browser.evaluate(
                "(async () => { view.state.dirty = true; for (let i = 0; i < 2; i++) await new Promise(requestAnimationFrame); })()",
            );
            Pixels::of(browser, Some(corners))
        })
        .collect();
    write(shot.name, &all, 100);
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// What `cz report` makes of a recording: results, map, the first time-space diagram.
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
    browser.resize((1180, 1080));
    browser.open(&format!("file://{}", page.display()));
    std::thread::sleep(std::time::Duration::from_millis(300));
    browser.evaluate("document.querySelector('#results').scrollIntoView()");
    write("report.png", &[Pixels::of(browser, None)], 0);
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

#[test]
#[ignore = "makes pictures"]
fn pictures() {
    let Some(browser) = Browser::start(SIZE) else { return };
    let shot = |name, size, step, script, chooses| Shot { name, size, step, script, chooses };
    let merge = record("two-merges", &[]);
    let page = Page::of(&[merge.path()]);
    take(&browser, &page, &shot("view-merge.png", FLAT, 1500, "", None));
    let dark = "view.setTheme('dark'); view.setColour('verdict'); view.panel(1)";
    take(&browser, &page, &shot("view-dark.png", FLAT, 1500, dark, None));
    report(&browser, merge.path());
    let intersection = record("intersection", &[]);
    let page = Page::of(&[intersection.path()]);
    take(&browser, &page, &shot("view-vehicle.png", SIZE, 600, "view.zoom(4)", Some(0)));
    take(&browser, &page, &shot("view-intersection.png", SIZE, 620, "view.zoom(5)", None));
    take_moving(&browser, &page, &shot("view-moving.png", SIZE, 575, "view.zoom(5)", Some(0)), 70);
    let roundabout = record("roundabout", &[]);
    let page = Page::of(&[roundabout.path()]);
    take(&browser, &page, &shot("view-roundabout.png", SIZE, 1500, "view.setColour('mode')", None));
    let other = record_as("gain-1.5.czlog", "paper", &["--set", "zones.merge-1.flow.gain_mps=1.5"]);
    let paper = record("paper", &[]);
    let page = Page::of(&[paper.path(), other.path()]);
    let chosen = "view.select({ vehicle: 40 }); view.panel(2)";
    take(&browser, &page, &shot("view-two-runs.png", SIZE, 1500, chosen, None));
}
