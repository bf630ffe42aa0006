//! A page in one file: no script, no font, no picture from elsewhere.

use super::compare::{Group, METRICS, groups};
use super::data::{Run, Worst};
use super::figures::Figure;
use super::latency::Latency;
use crate::events::{Event, EventKind, partner};
use control_zones::conflict::Conflicts;
use control_zones::record::words::{mode, place, verdict};
use control_zones::record::{compare, steps_in};
use ipc_schemas::NO_ZONE;
use quick_xml::escape::escape;
use std::fmt::Write;

/// Events of a kind that are listed at most.
const LISTED: usize = 100;

const STYLE: &str = "
:root{color-scheme:light dark;--ink:#222;--dim:#5c5c5c;--line:#d4d4d4;--page:#fff;--band:#f4f4f2;--link:#0b5cad}
@media(prefers-color-scheme:dark){:root{--ink:#e6e6e6;--dim:#a8a8a8;--line:#444;--page:#181818;--band:#222;--link:#7fb8f0}}
*{box-sizing:border-box}
body{margin:0 auto;max-width:1180px;padding:24px 20px 60px;font:15px/1.5 system-ui,sans-serif;color:var(--ink);background:var(--page)}
h1{font-size:26px;margin:0 0 4px}h2{font-size:20px;margin:38px 0 8px;border-bottom:1px solid var(--line);padding-bottom:4px}
h3{font-size:16px;margin:22px 0 4px}p{margin:6px 0;max-width:80ch}a{color:var(--link)}
nav{margin:10px 0;font-size:14px}nav a{margin-right:14px}
table{border-collapse:collapse;font-variant-numeric:tabular-nums;margin:8px 0;font-size:14px}
th,td{padding:3px 10px;text-align:left;border-bottom:1px solid var(--line);vertical-align:top}
th{color:var(--dim);font-weight:600}td.n,th.n{text-align:right}td.n,td:first-child{white-space:nowrap}
.wide{overflow-x:auto}figure{margin:12px 0}figcaption{color:var(--dim);font-size:14px;max-width:90ch}
figure .wide{background:#fff;border:1px solid var(--line);border-radius:4px}figure svg{display:block}
figure .fits svg{max-width:100%;height:auto}
.warn{border-left:4px solid #d55e00;padding:4px 12px;background:var(--band)}
details{margin:6px 0}summary{cursor:pointer}code{font-size:13px;background:var(--band);padding:1px 4px}
tr:target,details:target{background:var(--band)}
";

/// Width of the page's text, pixels.
const TEXT_PX: u32 = 1140;

/// Puts a page together.
pub fn page(runs: &[Run], figures: &[(Figure<'_>, String)], latency: &[Latency]) -> String {
    let groups = groups(runs);
    let title = groups.iter().map(|group| group.label.as_str()).collect::<Vec<_>>().join(" / ");
    let mut page = format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\n<meta name=\"viewport\" \
         content=\"width=device-width, initial-scale=1\">\n<link rel=\"icon\" href=\"data:,\">\n<title>{}</title>\n\
         <style>{STYLE}</style></head><body>\n<h1>{}</h1>\n",
        escape(&title),
        escape(&title)
    );
    page.push_str("<nav>");
    let mut sections = vec![("run", "What was run"), ("results", "Results")];
    if groups.len() > 1 {
        sections.push(("differences", "Differences"));
    }
    sections.extend([
        ("figures", "Figures"),
        ("moments", "Worst moments"),
        ("events", "Events"),
        ("timing", "Timing"),
    ]);
    for (id, name) in &sections {
        let _ = write!(page, "<a href=\"#{id}\">{name}</a>");
    }
    page.push_str("</nav>\n");
    what_was_run(&mut page, runs);
    results(&mut page, &groups);
    if groups.len() > 1 {
        differences(&mut page, &groups);
    }
    heading(&mut page, "figures", "Figures");
    if runs.len() > 1 {
        let first = escape(runs[0].name()).into_owned();
        let _ = writeln!(page, "<p>Of <code>{first}</code>, but for those of all runs.</p>");
    }
    for (figure, svg) in figures {
        let _ = writeln!(
            page,
            "<figure id=\"{}\"><h3>{}</h3><div class=\"{}\">{svg}</div><figcaption>{}</figcaption></figure>",
            figure.name,
            escape(&figure.title),
            // One that is wider, as of a long run, is scrolled and not made small.
            if figure.size.0 <= TEXT_PX { "wide fits" } else { "wide" },
            escape(&figure.caption)
        );
    }
    moments(&mut page, &runs[0]);
    events(&mut page, &runs[0]);
    timing(&mut page, runs, latency);
    page.push_str("</body></html>\n");
    page
}

fn heading(page: &mut String, id: &str, name: &str) {
    let _ = writeln!(page, "<h2 id=\"{id}\">{name}</h2>");
}

/// A table: columns whose names begin with `#` hold numbers.
fn table(page: &mut String, header: &[&str], rows: impl IntoIterator<Item = Vec<String>>) {
    page.push_str("<div class=\"wide\"><table><tr>");
    let class = |name: &str| if name.starts_with('#') { " class=\"n\"" } else { "" };
    for name in header {
        let _ = write!(page, "<th{}>{}</th>", class(name), escape(name.trim_start_matches('#')));
    }
    page.push_str("</tr>\n");
    for row in rows {
        page.push_str("<tr>");
        for (cell, name) in row.iter().zip(header) {
            let _ = write!(page, "<td{}>{cell}</td>", class(name));
        }
        page.push_str("</tr>\n");
    }
    page.push_str("</table></div>\n");
}

fn text(text: &str) -> String {
    escape(text).into_owned()
}

fn what_was_run(page: &mut String, runs: &[Run]) {
    heading(page, "run", "What was run");
    let rows = runs.iter().map(|run| {
        let metadata = run.reader.metadata();
        let hash = run
            .reader
            .footer()
            .map_or_else(|| "–".to_owned(), |footer| format!("{:016x}", footer.state_hash));
        let created =
            i64::try_from(metadata.created_unix_s).ok().and_then(|s| jiff::Timestamp::from_second(s).ok());
        vec![
            text(&run.name()),
            text(&metadata.scenario_name),
            metadata.seed.to_string(),
            text(&if metadata.overrides.is_empty() {
                "nothing".to_owned()
            } else {
                metadata.overrides.join(" ")
            }),
            run.ended.steps.to_string(),
            format!("{:.1}", run.end_s),
            run.vehicles.to_string(),
            format!("<code>{hash}</code>"),
            text(&metadata.build.to_string()),
            created.map_or_else(String::new, |time| time.to_string()),
        ]
    });
    let header = [
        "recording",
        "scenario",
        "#seed",
        "changed",
        "#steps",
        "#time [s]",
        "#vehicles",
        "state hash",
        "written by",
        "at",
    ];
    table(page, &header, rows);
    for run in runs {
        for line in doubts(run) {
            let _ = writeln!(page, "<p class=\"warn\">{}: {}</p>", text(&run.name()), text(&line));
        }
    }
}

/// What makes a run's results doubtful.
fn doubts(run: &Run) -> Vec<String> {
    let mut doubts = Vec::new();
    let gaps = run.reader.gaps();
    if !gaps.is_empty() {
        doubts.push(format!("{} steps are missing", steps_in(&gaps)));
    }
    doubts.extend(run.ended.damage.iter().map(|damage| format!("damaged at {damage}")));
    if let Some((step, why)) = &run.ended.lost {
        doubts.push(format!("visits, energies and results are known up to step {step} only: {why}"));
    }
    match run.reader.footer() {
        None => doubts.push("the recording has no end: it was cut off".to_owned()),
        Some(footer) if footer.end != control_zones::record::RunEnd::Finished => {
            doubts.push(footer.end.to_string())
        }
        Some(_) => {}
    }
    if let Some(summary) = &run.ended.summary {
        let o = &summary.overlaps;
        if let Some(first) = &o.first {
            doubts.push(format!(
                "bodies overlapped: {} pairs of vehicles, {:.2} s in all, by up to {:.2} m; first {} and {} in {} at step {}",
                o.pairs, o.time_s, o.deepest_m, first.vehicles[0], first.vehicles[1], first.zone, first.step
            ));
        }
        doubts.extend(summary.stalled.iter().map(|stall| {
            format!(
                "nothing moved in {} from step {} on, {} vehicles inside",
                stall.zone, stall.since_step, stall.vehicles
            )
        }));
        if summary.arrived > summary.departed {
            let inside = summary.arrived - summary.departed;
            doubts.push(format!("{inside} vehicles were still inside at the end and are in no mean"));
        }
    }
    doubts
}

fn results(page: &mut String, groups: &[Group<'_>]) {
    heading(page, "results", "Results");
    let several = groups.iter().any(|group| group.runs.len() > 1);
    page.push_str("<p>Per vehicle; margins are the least of any vehicle at any instant.");
    if several {
        page.push_str(" Of several seeds: mean ± half the 95 % interval (Student).");
    }
    page.push_str("</p>\n");
    for group in groups {
        let seeds: Vec<String> =
            group.runs.iter().map(|run| run.reader.metadata().seed.to_string()).collect();
        let label = if seeds.len() > 1 { "seeds" } else { "seed" };
        let _ = writeln!(page, "<h3>{}, {label} {}</h3>", text(&group.label), seeds.join(", "));
        let used: Vec<usize> = (0..METRICS.len())
            .filter(|at| group.zones().any(|zone| group.cell(zone, &METRICS[*at]) != "–"))
            .collect();
        let name = |at: &usize| match METRICS[*at].unit {
            "" => format!("#{}", METRICS[*at].name),
            unit => format!("#{} [{unit}]", METRICS[*at].name),
        };
        let names: Vec<String> = used.iter().map(name).collect();
        let header: Vec<&str> = std::iter::once("zone").chain(names.iter().map(String::as_str)).collect();
        let rows = group.zones().map(|zone| {
            let cells = used.iter().map(|at| group.cell(zone, &METRICS[*at]));
            std::iter::once(text(zone)).chain(cells).collect()
        });
        table(page, &header, rows.collect::<Vec<_>>());
        let _ = writeln!(
            page,
            "<p>Sum of the zones' objectives, waits counted as time: <b>{}</b> m²/s³.</p>",
            group.total()
        );
        if let [run] = group.runs[..] {
            let _ = writeln!(page, "<p>{}</p>", text(&in_short(run)));
        }
    }
}

fn in_short(run: &Run) -> String {
    let count = |kind| run.events_of(kind).count();
    let mut line = format!(
        "{} vehicles, {:.1} m²/s³ of energy over all visits; {} spells of feasibility enforcement, {} of infeasible rows",
        run.vehicles,
        run.energy,
        count(EventKind::FeasibilityEnforcement),
        count(EventKind::Infeasible)
    );
    if let Some(summary) = &run.ended.summary
        && summary.held_arrivals > 0
    {
        let _ = write!(line, "; {} arrivals had to wait outside", summary.held_arrivals);
    }
    line + "."
}

fn differences(page: &mut String, groups: &[Group<'_>]) {
    heading(page, "differences", "Differences");
    let base = &groups[0];
    let _ = writeln!(
        page,
        "<p>Less <b>{}</b>, seed by seed; with two seeds or more mean ± half the 95 % interval, * where that is clear of \
         zero.</p>",
        text(&base.label)
    );
    for other in &groups[1..] {
        let _ = writeln!(page, "<h3>{}</h3>", text(&other.label));
        let zones: Vec<&str> =
            base.zones().filter(|zone| other.zones().any(|theirs| theirs == *zone)).collect();
        let used: Vec<usize> = (0..METRICS.len())
            .filter(|at| zones.iter().any(|zone| base.change(other, zone, &METRICS[*at]) != "–"))
            .collect();
        let names: Vec<String> = used.iter().map(|at| format!("#{}", METRICS[*at].name)).collect();
        let header: Vec<&str> = std::iter::once("zone").chain(names.iter().map(String::as_str)).collect();
        let rows = zones.iter().map(|zone| {
            let cells = used.iter().map(|at| base.change(other, zone, &METRICS[*at]));
            std::iter::once(text(zone)).chain(cells).collect()
        });
        table(page, &header, rows.collect::<Vec<_>>());
        let _ = writeln!(page, "<p>Sum of the objectives: <b>{}</b> m²/s³.</p>", base.total_change(other));
        let seed = |run: &Run| run.reader.metadata().seed;
        let pair =
            base.runs.iter().find_map(|run| Some((*run, *other.runs.iter().find(|o| seed(o) == seed(run))?)));
        if let Some((a, b)) = pair {
            let found = compare(&a.reader, &b.reader);
            let line = match &found.difference {
                Some(difference) => {
                    format!("The same in {} steps; first difference: {difference}", found.steps)
                }
                None => format!("The same in all {} steps that both have", found.steps),
            };
            let _ = writeln!(page, "<p>{} / {}: {}.</p>", text(&a.name()), text(&b.name()), text(&line));
        }
    }
}

fn moments(page: &mut String, run: &Run) {
    heading(page, "moments", "Worst moments");
    page.push_str(
        "<p>The pairs with the least margins, toward leaders first; toward those who pass a merge or crossing first as the \
         vehicle comes to it.</p>\n",
    );
    let conflicts = Conflicts::of_all(&run.scenario.network);
    let rows = (1..).zip(&run.worst).map(|(number, worst)| {
        let owed = &worst.owed;
        vec![
            number.to_string(),
            format!("<a href=\"#step-{}-{}\">{}</a>", worst.step, owed.vehicle, worst.step),
            format!("{:.1}", worst.time_s),
            text(&run.scenario.network.zones[owed.zone as usize].name),
            owed.vehicle.to_string(),
            text(&partner(&conflicts, owed)),
            format!("{:.2}", worst.margin_m),
            format!("{:.2}", owed.pair.v_mps),
            format!("{:.2}", owed.pair.partner_v_mps),
        ]
    });
    let header = [
        "#",
        "#step",
        "#time [s]",
        "zone",
        "#vehicle",
        "toward",
        "#margin [m]",
        "#v [m/s]",
        "#partner's v [m/s]",
    ];
    table(page, &header, rows.collect::<Vec<_>>());
    for worst in &run.worst {
        moment(page, run, worst);
    }
}

/// The zone at one step.
fn moment(page: &mut String, run: &Run, worst: &Worst) {
    let Ok(Some(step)) = run.reader.step(worst.step) else { return };
    let _ = writeln!(
        page,
        "<details id=\"step-{}-{}\"><summary>step {}, {:.1} s: vehicle {} and {}</summary>\n<p><code>cz show {} --step \
         {}</code></p>",
        worst.step,
        worst.owed.vehicle,
        worst.step,
        worst.time_s,
        worst.owed.vehicle,
        worst.owed.partner,
        text(&run.path.display().to_string()),
        worst.step
    );
    let states = step.state.iter().filter(|state| state.zone == worst.owed.zone && state.zone != NO_ZONE);
    let rows = states.map(|state| {
        let command =
            step.commands.iter().flat_map(|part| &part.records).find(|c| c.vehicle == state.vehicle);
        let command = command.filter(|_| !state.has_left());
        let is_one = [worst.owed.vehicle, worst.owed.partner].contains(&state.vehicle);
        let name = if is_one { format!("<b>{}</b>", state.vehicle) } else { state.vehicle.to_string() };
        vec![
            name,
            text(&place(&run.scenario, state)),
            if state.has_left() { "has left".to_owned() } else { String::new() },
            format!("{:.2}", state.x_m),
            format!("{:.2}", state.v_mps),
            command.map_or_else(|| "–".to_owned(), |c| format!("{:.2}", c.u_mps2)),
            command.map_or_else(String::new, |c| text(&mode(c))),
            command.map_or_else(String::new, |c| text(&verdict(c))),
        ]
    });
    let header = ["#vehicle", "path", "", "#x [m]", "#v [m/s]", "#u [m/s²]", "mode", "verdict"];
    table(page, &header, rows.collect::<Vec<_>>());
    page.push_str("</details>\n");
}

fn events(page: &mut String, run: &Run) {
    heading(page, "events", "Events");
    let kinds = [
        (EventKind::Infeasible, "Rows that no acceleration satisfied"),
        (EventKind::FeasibilityEnforcement, "Feasibility enforcement"),
        (EventKind::Overruled, "Another acceleration than commanded"),
        (EventKind::Late, "Processes that were late"),
        (EventKind::Replaced, "Processes that were replaced"),
        (EventKind::Refused, "Senders whose frames were refused"),
        (EventKind::Steered, "Steering"),
        (EventKind::Exited, "Controllers that ended"),
    ];
    for (kind, name) in kinds {
        let all: Vec<&Event> = run.events_of(kind).collect();
        let _ = writeln!(
            page,
            "<h3>{name}: {}</h3>",
            if all.is_empty() { "none".to_owned() } else { all.len().to_string() }
        );
        if all.is_empty() {
            continue;
        }
        if all.len() > LISTED {
            let _ =
                writeln!(page, "<p>The {LISTED} longest; <code>cz export --to csv</code> writes all.</p>");
        }
        let mut listed = all;
        listed.sort_by_key(|event| std::cmp::Reverse(event.last_step - event.first_step));
        listed.truncate(LISTED);
        listed.sort_by_key(|event| event.first_step);
        let dt_s = run.scenario.dt_s();
        let rows = listed.into_iter().map(|event| {
            let zone = event.zone.and_then(|zone| run.scenario.network.zones.get(zone as usize));
            let who =
                event.vehicle.or(event.controller).map_or_else(String::new, |number| number.to_string());
            let steps = match event.first_step == event.last_step {
                true => event.first_step.to_string(),
                false => format!("{}–{}", event.first_step, event.last_step),
            };
            vec![
                steps,
                format!("{:.1}", event.time_s),
                format!("{:.1}", (event.last_step - event.first_step + 1) as f64 * dt_s),
                zone.map_or_else(String::new, |zone| text(&zone.name)),
                who,
                text(&event.reason),
            ]
        });
        let who = match kind {
            EventKind::Late | EventKind::Replaced => "#controller",
            EventKind::Refused | EventKind::Steered | EventKind::Exited => "",
            _ => "#vehicle",
        };
        table(page, &["#steps", "#from [s]", "#for [s]", "zone", who, "why"], rows.collect::<Vec<_>>());
    }
}

fn timing(page: &mut String, runs: &[Run], latency: &[Latency]) {
    heading(page, "timing", "Timing");
    for run in runs {
        let late: u64 = run.late.iter().sum();
        let who = (0..).zip(&run.late).filter(|(_, late)| **late > 0);
        let who: Vec<String> =
            who.map(|(controller, late): (u32, _)| format!("controller {controller}: {late}")).collect();
        let line = match late {
            0 => "no controller missed a deadline".to_owned(),
            _ => format!("{late} answers did not come in time ({})", who.join(", ")),
        };
        let _ = writeln!(page, "<p>{}: {}.</p>", text(&run.name()), text(&line));
    }
    if latency.is_empty() {
        page.push_str(
            "<p>A recording holds simulated time only. How long steps took is in the summary of the run (<code>cz run \
             --json FILE</code>); <code>cz report --summary FILE</code> shows it here.</p>\n",
        );
        return;
    }
    let rows = latency.iter().map(|latency| {
        vec![
            text(&latency.name),
            latency.processes.to_string(),
            format!("{:.1}", latency.p50_us),
            format!("{:.1}", latency.p99_us),
            format!("{:.1}", latency.p999_us),
            format!("{:.1}", latency.max_us),
            latency.deadlines.clone(),
        ]
    });
    let header =
        ["summary", "#processes", "#p50 [µs]", "#p99 [µs]", "#p99.9 [µs]", "#greatest [µs]", "deadlines"];
    table(page, &header, rows.collect::<Vec<_>>());
}
