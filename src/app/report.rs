//! The summary of a run: as JSON, and as a table for people.

use super::say::number;
use super::{AppError, print};
use crate::lockstep::RefusedFrames;
use crate::process::{
    DrivenBy, LatencyBin, LatencyUs, Outcome, PluginRow, Punctuality, Replacement, Settled,
};
use crate::record::RunEvent;
use crate::scenario::{Demand, Road, Scenario, ShieldMode};
use crate::world::{FaultCounts, OverlapSummary, ShieldSummary, Stall, TrafficSummary, ZoneSummaryRow};
use comfy_table::{Cell, CellAlignment, Table, presets};
use serde::Serialize;
use std::path::Path;

/// The summary; its JSON keys are a contract.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Summary {
    scenario: String,
    seed: u64,
    /// Where vehicles come from.
    arrivals: &'static str,
    transport: &'static str,
    processes: u32,
    steps: u64,
    dt_s: f64,
    beta: f64,
    state_hash: String,
    wall_s: f64,
    step_latency_us: LatencyUs,
    step_latency_histogram: Vec<LatencyBin>,
    zones: Vec<ZoneSummaryRow>,
    total_objective: f64,
    arrived: u32,
    departed: u32,
    held_arrivals: u32,
    waiting: u32,
    overlaps: OverlapSummary,
    stalled: Vec<Stall>,
    shield: ShieldSummary,
    #[serde(skip_serializing_if = "Option::is_none")]
    faults: Option<FaultCounts>,
    #[serde(skip_serializing_if = "Option::is_none")]
    traffic: Option<TrafficSummary>,
    replacements: Vec<Replacement>,
    refused: Vec<RefusedFrames>,
    late_frames: u64,
    events: Vec<RunEvent>,
    controllers: Vec<PluginRow>,
    #[serde(skip_serializing_if = "Option::is_none")]
    punctuality: Option<Punctuality>,
    placement: Vec<Settled>,
    /// Whether the table says so too: somebody has asked for something.
    #[serde(skip)]
    show_placement: bool,
}

/// Refuses a file for the JSON that cannot be written, before there is anything to write.
pub(super) fn check_json(path: Option<&Path>) -> Result<(), AppError> {
    let Some(path) = path.filter(|path| *path != Path::new("-")) else { return Ok(()) };
    let existed = path.symlink_metadata().is_ok();
    let opened = std::fs::OpenOptions::new().append(true).create(true).open(path);
    opened.map_err(|e| AppError::Usage(format!("--json: cannot write {}: {e}", path.display())))?;
    if !existed {
        let _ = std::fs::remove_file(path);
    }
    Ok(())
}

/// How the frames of a run travelled.
#[derive(Clone, Copy, Debug)]
pub(super) enum Transport {
    InProcess,
    Iceoryx2 { processes: u32 },
}

impl Summary {
    pub fn new(scenario: &Scenario, transport: Transport, outcome: Outcome) -> Summary {
        let (transport, processes) = match transport {
            Transport::InProcess => ("in-process", 1),
            Transport::Iceoryx2 { processes } => ("iceoryx2", processes),
        };
        let world = outcome.world;
        Summary {
            scenario: scenario.name.clone(),
            seed: scenario.seed,
            arrivals: arrivals(scenario),
            transport,
            processes,
            steps: world.steps,
            dt_s: scenario.dt_s(),
            beta: scenario.beta,
            state_hash: format!("{:016x}", world.state_hash),
            wall_s: outcome.wall_s,
            step_latency_us: outcome.step_latency_us,
            step_latency_histogram: outcome.step_latency_histogram,
            total_objective: world
                .zones
                .iter()
                .map(|z| z.mean_objective + scenario.beta * z.mean_wait_s)
                .sum(),
            zones: world.zones,
            arrived: world.arrived,
            departed: world.departed,
            held_arrivals: world.held_arrivals,
            waiting: world.waiting,
            overlaps: world.overlaps,
            stalled: world.stalled,
            shield: world.shield,
            faults: world.faults,
            traffic: world.traffic,
            replacements: outcome.replacements,
            refused: outcome.refused,
            late_frames: outcome.late_frames,
            events: outcome.events,
            controllers: outcome.controllers,
            punctuality: outcome.punctuality,
            placement: outcome.placement,
            show_placement: false,
        }
    }

    /// Has the table say where each process was and what it was granted.
    pub fn with_placement(self, show_placement: bool) -> Summary {
        Summary { show_placement, ..self }
    }

    /// Prints the table, or writes the JSON, or both; what nobody should miss goes to stderr as well.
    pub fn deliver(&self, json: Option<&Path>) -> Result<(), AppError> {
        let results = self.deliver_results(json);
        self.warnings().iter().for_each(|warning| super::say::say(format_args!("cz: warning: {warning}")));
        results
    }

    fn deliver_results(&self, json: Option<&Path>) -> Result<(), AppError> {
        let Some(path) = json else { return print(&self.table()) };
        let text = serde_json::to_string_pretty(self).expect("a summary has string keys only") + "\n";
        if path == Path::new("-") {
            return print(&text);
        }
        // The table first: it is all there is when the file cannot be written.
        let printed = print(&self.table());
        std::fs::write(path, text)
            .map_err(|e| AppError::Failed(format!("cannot write {}: {e}", path.display())))?;
        printed
    }

    /// What makes the results doubtful, a line each.
    fn warnings(&self) -> Vec<String> {
        let mut warnings: Vec<String> = self.overlap_line().into_iter().collect();
        let zones = self.stalled.iter().map(|stall| {
            format!(
                "nothing moves in {} since step {} ({:.1} s), {} inside: the run made no progress there",
                stall.zone,
                stall.since_step,
                stall.since_s,
                number(stall.vehicles.into(), "vehicle")
            )
        });
        warnings.extend(zones);
        let is_on = self.shield.mode == ShieldMode::On;
        let replaced = self.shield.controllers.iter().filter(|row| is_on && row.bounded > row.commands / 2);
        warnings.extend(replaced.map(|row| {
            format!(
                "controller {} hardly drove: the shield replaced {} of its {} commands ({} were no number)",
                row.controller, row.bounded, row.commands, row.not_finite
            )
        }));
        warnings
    }

    fn overlap_line(&self) -> Option<String> {
        let o = &self.overlaps;
        let first = o.first.as_ref()?;
        let among = match o.pairs_uncommanded {
            0 => String::new(),
            all if all == o.pairs => " that nobody commands".to_owned(),
            some => format!(" ({some} of them of two that nobody commands)"),
        };
        Some(format!(
            "bodies overlapped: {} of vehicles{}, {:.2} s in all ({}), by up to {:.2} m; first {} and {} in {} at \
             {:.1} s",
            number(o.pairs, "pair"),
            among,
            o.time_s,
            number(o.samples, "sample"),
            o.deepest_m,
            first.vehicles[0],
            first.vehicles[1],
            first.zone,
            first.step as f64 * self.dt_s
        ))
    }

    /// Zone by zone, and in total.
    fn zone_table(&self) -> Table {
        let mut table = Table::new();
        table.load_style(presets::UTF8_HORIZONTAL_ONLY);
        let mut header = vec![
            "zone",
            "vehicles",
            "wait\n[s]",
            "time\n[s]",
            "energy\n[m²/s³]",
            "objective\n[m²/s³]",
            "FE\nvehicles",
            "FE time\n[s]",
            "infeasible\nvehicles",
            "exposure\n[m s]",
            "rear-end margin\nall / entered safe [m]",
            "merge margin\nall / entered safe [m]",
        ];
        let anybody_crosses = self.zones.iter().any(|zone| zone.min_cross_margin_m.is_some());
        header.extend(anybody_crosses.then_some("cross margin\nall / entered safe [m]"));
        table.set_header(header);
        for zone in &self.zones {
            let margins =
                |all: Option<f64>, clean: Option<f64>| format!("{} / {}", metres(all), metres(clean));
            let mut row = vec![
                zone.zone.clone(),
                zone.vehicles.to_string(),
                format!("{:.3}", zone.mean_wait_s),
                format!("{:.3}", zone.mean_time_s),
                format!("{:.3}", zone.mean_energy),
                format!("{:.3}", zone.mean_objective),
                zone.fe_vehicles.to_string(),
                format!("{:.3}", zone.fe_mean_s),
                zone.infeasible_vehicles.to_string(),
                format!("{:.3}", zone.mean_exposure_m_s),
                margins(zone.min_rear_end_margin_m, zone.min_rear_end_margin_clean_m),
                margins(zone.min_merge_margin_m, zone.min_merge_margin_clean_m),
            ];
            row.extend(
                anybody_crosses.then(|| margins(zone.min_cross_margin_m, zone.min_cross_margin_clean_m)),
            );
            table.add_row(row);
        }
        let mut total = vec![Cell::new("total"), Cell::new(self.departed)];
        total.extend(["", "", ""].map(Cell::new));
        total.push(Cell::new(format!("{:.3}", self.total_objective)));
        table.add_row(total);
        for column in table.column_iter_mut().skip(1) {
            column.set_cell_alignment(CellAlignment::Right);
        }
        table
    }

    fn table(&self) -> String {
        let how = match self.processes {
            1 => "in one process".to_owned(),
            n => format!("in {n} processes over {}", self.transport),
        };
        let l = &self.step_latency_us;
        let mut text = format!(
            "{}, seed {}: {} steps of {} s {how}, {:.2} s wall time\n{}\n\
             step latency p50 {:.1} µs, p99 {:.1}, p99.9 {:.1}, max {:.1}; beta {:.4}; arrivals from {}\n",
            self.scenario,
            self.seed,
            self.steps,
            self.dt_s,
            self.wall_s,
            self.zone_table(),
            l.p50,
            l.p99,
            l.p999,
            l.max,
            self.beta,
            self.arrivals
        );
        if self.held_arrivals > 0 {
            text.push_str(&format!(
                "{} arrivals had to wait outside, which counts as time in the total; {} still waited at the end\n",
                self.held_arrivals, self.waiting
            ));
        }
        let gone = self.departed + self.traffic.as_ref().map_or(0, |traffic| traffic.gone);
        if self.arrived > gone {
            text.push_str(&format!("{} vehicles were still inside at the end\n", self.arrived - gone));
        }
        let sum = |of: fn(&ZoneSummaryRow) -> u32| self.zones.iter().map(of).sum::<u32>();
        let disorder = [
            (sum(|z| z.orders_refused), "passing orders that the world did not adopt"),
            (sum(|z| z.order_violations), "passings before one that was to pass first"),
            (sum(|z| z.overtakes), "samples ahead of the own leader"),
        ];
        let told: Vec<String> = disorder
            .iter()
            .filter(|(count, _)| *count > 0)
            .map(|(count, what)| format!("{what}: {count}"))
            .collect();
        if !told.is_empty() {
            text.push_str(&format!("{}\n", told.join("; ")));
        }
        shield_lines(&self.shield, &mut text);
        for warning in self.warnings() {
            text.push_str(&format!("warning: {warning}\n"));
        }
        if let Some(f) = &self.faults {
            text.push_str(&format!(
                "faults: commands {} lost, {} delayed, {} stalled; records {} noisy, {} biased, {} frozen\n",
                f.commands_lost,
                f.commands_delayed,
                f.commands_stalled,
                f.records_noisy,
                f.records_biased,
                f.records_frozen
            ));
        }
        if let Some(t) = &self.traffic {
            text.push_str(&format!(
                "moved by {}: accelerations within {:.3} m/s² of what was to be held, positions within {:.4} m of the mean \
                 acceleration's; {} commanded by nobody, {} taken out within a zone, {} come behind an exit\n",
                t.name,
                t.greatest_disobedience_mps2,
                t.greatest_deviation_m,
                number(t.uncommanded.into(), "vehicle"),
                t.gone,
                t.behind_exits
            ));
        }
        if let Some(p) = &self.punctuality {
            text.push_str(&punctuality_lines(p));
        }
        self.controllers.iter().for_each(|row| text.push_str(&controller_line(row)));
        for r in &self.replacements {
            text.push_str(&format!(
                "{} was replaced at step {} (generation {}); the step took {:.1} ms\n",
                r.participant, r.step, r.generation, r.step_ms
            ));
        }
        for r in &self.refused {
            text.push_str(&format!("{r}\n"));
        }
        for settled in self.placement.iter().filter(|_| self.show_placement) {
            text.push_str(&format!("{settled}\n"));
        }
        text.push_str(&format!("state hash {}\n", self.state_hash));
        text
    }
}

/// How a controller written elsewhere has fared.
fn controller_line(row: &PluginRow) -> String {
    let mut text = format!("controller {}: {} answered", row.controller, number(row.answered, "step"));
    if let Some(t) = &row.answer_time_us {
        text.push_str(&format!(
            " in p50 {:.1} µs, p99 {:.1}, p99.9 {:.1}, max {:.1}",
            t.p50, t.p99, t.p999, t.max
        ));
    }
    if row.missed > 0 {
        text.push_str(&format!("; {} missed", number(row.missed, "deadline")));
    }
    if row.exits > 0 {
        let times = number(row.exits.into(), "time");
        text.push_str(&format!("; it ended {times} (on_exit {})", row.on_exit.name()));
        if row.driven_by != DrivenBy::Plugin {
            text.push_str(&format!(", and {} drove its vehicles at the end", row.driven_by.name()));
        }
    }
    text + "\n"
}

/// What a scenario's arrivals come from.
fn arrivals(scenario: &Scenario) -> &'static str {
    let is_trace = |road: &Road| matches!(road.demand, Demand::Trace(_));
    match scenario.network.roads.iter().filter(|road| is_trace(road)).count() {
        0 => "the seed",
        traces if traces == scenario.network.roads.len() => "traces",
        _ => "traces and the seed",
    }
}

fn punctuality_lines(p: &Punctuality) -> String {
    let mut text = String::new();
    if p.paced {
        let l = &p.lateness_ns;
        let us = |ns: u64| ns as f64 / 1e3;
        text.push_str(&format!(
            "states published after their instants: p50 {:.1} µs, p90 {:.1}, p99 {:.1}, p99.9 {:.1}, max {:.1}\n",
            us(l.p50),
            us(l.p90),
            us(l.p99),
            us(l.p999),
            us(l.max)
        ));
    }
    text.push_str(&format!("{} deadlines of {:.0} µs missed", p.missed_steps, p.deadline_us));
    for by in &p.missed_by {
        text.push_str(&format!(", {} by {}", by.steps, by.participant));
    }
    if p.began_late > 0 {
        text.push_str(&format!(", {} because earlier steps had taken too long", p.began_late));
    }
    text.push('\n');
    text
}

/// One line per controller the shield had something to say about.
fn shield_lines(shield: &ShieldSummary, text: &mut String) {
    if shield.mode == ShieldMode::Off {
        return;
    }
    for row in &shield.controllers {
        text.push_str(&format!(
            "shield {}, {}: {} of {} commands bounded (by rear end {}, merge {}, cross {}, speed {}, limits \
             {}, no number {}); least margins of guaranteed vehicles {} / {} / {} m; {} pairs began unsafe\n",
            shield.mode.name(),
            row.controller,
            row.bounded,
            row.commands,
            row.rear_end,
            row.merge,
            row.cross,
            row.speed,
            row.limits,
            row.not_finite,
            metres(row.min_rear_end_margin_m),
            metres(row.min_merge_margin_m),
            metres(row.min_cross_margin_m),
            row.began_unsafe
        ));
        if row.lost > 0 {
            text.push_str(&format!("  {} vehicle-steps of guaranteed vehicles ended unsafe\n", row.lost));
        }
    }
}

fn metres(margin: Option<f64>) -> String {
    margin.map_or_else(|| "-".to_owned(), |m| format!("{m:.3}"))
}
