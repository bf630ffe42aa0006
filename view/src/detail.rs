//! What the page asks about one vehicle, one zone, or a stretch of time.

use crate::index::Line;
use crate::run::Run;
use control_zones::conflict::{Conflicts, DutyKind};
use control_zones::control::{Memory, Words};
use control_zones::record::{InForce, words};
use control_zones::scenario::LawKind;
use control_zones::step::Step;
use ipc_schemas::{ASSIGNMENT_FREE_TERMINAL, NO_ZONE, VehicleCommand, VehicleState};
use serde_json::{Value, json};

/// Points of a course at most.
const COURSE_POINTS: u64 = 1500;
/// Points of a plan.
const PLAN_POINTS: u32 = 40;
/// Traces sent at most.
const TRACES_SENT: usize = 150_000;

impl Run {
    /// A step, or the last before it where it is missing between others.
    fn step(&self, number: u64) -> Result<Step, String> {
        let there = || match self.steps.range() {
            Some((first, last)) => format!("there are steps {first} to {last}"),
            None => "there are none yet".to_owned(),
        };
        let is_between = self.steps.range().is_some_and(|(first, last)| (first..=last).contains(&number));
        let number = self.steps.last_until(number).filter(|_| is_between).unwrap_or(number);
        self.steps.step(number)?.ok_or_else(|| format!("step {number} is not there; {}", there()))
    }

    /// What is in force in a zone in a step; `None` when that is not known yet.
    fn in_force(&self, zone: u32, step: &Step) -> Option<InForce> {
        let at = self.index().acted_before(zone, step.header.step)?;
        let mut in_force = InForce::default();
        if at == step.header.step {
            in_force.take(step);
        } else {
            in_force.take(&self.steps.step(at).ok().flatten()?);
        }
        Some(in_force)
    }

    /// A vehicle in a step: state, command, duties with margins, plan.
    pub fn vehicle(&self, number: u64, vehicle: u32) -> Result<Value, String> {
        let step = self.step(number)?;
        let own = |s: &&VehicleState| s.vehicle == vehicle && !s.has_left();
        let Some(state) = step.state.iter().find(own) else {
            // Where one has been clicked, the scrubber leads to steps before it came and after it left: no error.
            return Ok(json!({ "problem": format!("vehicle {vehicle} is not in step {number}") }));
        };
        let scenario = &self.scenario;
        let command = step.commands.iter().flat_map(|part| &part.records).find(|c| c.vehicle == vehicle);
        let kind = scenario.fleet.get(usize::from(state.kind)).map(|kind| kind.name.clone());
        Ok(json!({
            "vehicle": vehicle,
            "step": number,
            "time_s": scenario.time_s(number),
            "kind": kind,
            "place": words::place(scenario, state),
            "zone": state.zone,
            "path": state.path,
            "x_m": state.x_m,
            "v_mps": state.v_mps,
            "u_before_mps2": state.u_mps2,
            "length_m": state.length_m,
            "entry_time_s": state.entry_time_s,
            "entry_speed_mps": state.entry_speed_mps,
            "command": command.map(|c| json!({
                "u_mps2": c.u_mps2,
                "mode": words::mode(c),
                "verdict": words::verdict(c),
                "planned_exit_time_s": c.planned_exit_time_s,
                "planned_exit_speed_mps": c.planned_exit_speed_mps,
            })),
            "duties": self.duties(&step, state),
            "plan": command.and_then(|command| self.plan(state, command)),
        }))
    }

    /// What a vehicle owes; null when that is not known.
    fn duties(&self, step: &Step, state: &VehicleState) -> Value {
        if state.zone == NO_ZONE {
            return json!([]);
        }
        let Some(in_force) = self.in_force(state.zone, step) else { return Value::Null };
        let conflicts = Conflicts::of(&self.scenario.network, state.zone);
        let slice = of_zone(&step.state, state.zone);
        let mut duties = Vec::new();
        in_force.owed(&self.scenario, step, |owed| {
            if (owed.zone, owed.vehicle) != (state.zone, state.vehicle) {
                return;
            }
            // Toward a leader there is no point, even where there was one before both had passed it.
            let point = Some(owed.point).filter(|_| owed.kind != DutyKind::RearEnd);
            let shape = point.and_then(|point| conflicts.points().get(point as usize));
            let partner = slice.iter().find(|s| s.vehicle == owed.partner);
            duties.push(json!({
                "kind": kind_name(owed.kind),
                "partner": owed.partner,
                "partner_v_mps": owed.pair.partner_v_mps,
                "partner_has_left": partner.is_some_and(VehicleState::has_left),
                "point": shape.and(point),
                "point_name": shape.map(|point| point.name.clone()),
                "to_go_m": shape.map(|_| owed.own_m - state.x_m),
                "margin_m": owed.margin_m(),
                "counts": owed.counts,
            }));
        });
        Value::Array(duties)
    }

    /// The trajectory a vehicle follows, where its law says: instant, position and speed.
    fn plan(&self, state: &VehicleState, command: &VehicleCommand) -> Option<Value> {
        let zone = self.scenario.network.zones.get(state.zone as usize)?;
        let is_ours = self.scenario.plugins.is_empty() && zone.law == LawKind::Ocbf;
        let plan = Memory::recall(&Words { mode: command.mode, words: command.memory() })
            .plan
            .filter(|_| is_ours)?;
        let duration_s = plan.optimum.duration_s;
        let at = |point: u32| {
            let t_s = duration_s * f64::from(point) / f64::from(PLAN_POINTS);
            (plan.start_s + t_s, plan.origin_m + plan.distance_m(t_s), plan.speed_mps(t_s))
        };
        Some(json!((0..=PLAN_POINTS).map(at).collect::<Vec<_>>()))
    }

    /// The whole course of a vehicle, columns side by side.
    pub fn course(&self, vehicle: u32) -> Result<Value, String> {
        let span = self.index().vehicles.get(&vehicle).copied();
        let (first, last) = span.ok_or_else(|| format!("vehicle {vehicle} has not been seen"))?;
        let first = self.steps.range().map_or(first, |(oldest, _)| first.max(oldest));
        let stride = (last.saturating_sub(first) / COURSE_POINTS).max(1);
        let mut columns: [Vec<Value>; 7] = Default::default();
        let (mut before_m, mut last_place) = (0.0, None::<(u32, u32, f64)>);
        let mut visits = Vec::new();
        for number in (first..=last).step_by(stride as usize) {
            let Ok(Some(step)) = self.steps.step(number) else { continue };
            let Some(state) = step.state.iter().find(|s| s.vehicle == vehicle && !s.has_left()) else {
                continue;
            };
            let command = step.commands.iter().flat_map(|part| &part.records).find(|c| c.vehicle == vehicle);
            let place = (state.zone, if state.zone == NO_ZONE { state.link } else { state.path });
            if last_place.is_none_or(|(zone, path, _)| (zone, path) != place) {
                before_m +=
                    last_place.map_or(0.0, |(zone, path, x_m)| self.length_m(zone, path).unwrap_or(x_m));
                visits.push(json!({
                    "zone": state.zone, "path": state.path, "place": words::place(&self.scenario, state),
                    "from_m": before_m, "time_s": self.scenario.time_s(number),
                }));
            }
            last_place = Some((place.0, place.1, state.x_m));
            let values = [
                json!(number),
                json!(before_m + state.x_m),
                json!(state.v_mps),
                json!(command.map(|c| c.u_mps2)),
                json!(command.map(|c| c.mode)),
                json!(command.map(|c| c.verdict)),
                json!(state.x_m),
            ];
            columns.iter_mut().zip(values).for_each(|(column, value)| column.push(value));
        }
        let [step, distance_m, v_mps, u_mps2, mode, verdict, x_m] = columns;
        Ok(json!({
            "vehicle": vehicle, "visits": visits, "step": step, "distance_m": distance_m, "v_mps": v_mps,
            "u_mps2": u_mps2, "mode": mode, "verdict": verdict, "x_m": x_m,
        }))
    }

    /// Length of a path, or of the link of that number, m.
    fn length_m(&self, zone: u32, path_or_link: u32) -> Option<f64> {
        let network = &self.scenario.network;
        if zone != NO_ZONE {
            return Some(network.zones.get(zone as usize)?.paths.get(path_or_link as usize)?.length_m);
        }
        let exits = network.zones.iter().flat_map(|zone| &zone.exits);
        let mut links =
            exits.filter_map(|exit| exit.to).map(|to| to.link_m).filter(|length_m| *length_m > 0.0);
        links.nth(path_or_link as usize)
    }

    /// A zone in a step: passing order, number of vehicles, terminal speeds.
    pub fn zone(&self, number: u64, zone: u32) -> Result<Value, String> {
        self.zone_in(&self.step(number)?, zone)
    }

    /// The first zones in a step.
    pub fn zones(&self, number: u64, count: u64) -> Result<Value, String> {
        let step = self.step(number)?;
        let zones = self.scenario.network.zones.len() as u64;
        (0..count.min(zones) as u32).map(|zone| self.zone_in(&step, zone)).collect()
    }

    fn zone_in(&self, step: &Step, zone: u32) -> Result<Value, String> {
        let shape = self
            .scenario
            .network
            .zones
            .get(zone as usize)
            .ok_or_else(|| format!("there is no zone {zone}"))?;
        let slice = of_zone(&step.state, zone);
        let in_force = self.in_force(zone, step);
        let assigned = in_force.as_ref().map_or(&[][..], |in_force| in_force.of(zone));
        let mut order: Vec<(u32, u32)> = assigned.iter().map(|a| (a.rank, a.vehicle)).collect();
        order.sort_unstable();
        order.dedup();
        let member = |(rank, vehicle): (u32, u32)| {
            let state = slice.iter().find(|s| s.vehicle == vehicle && !s.has_left())?;
            let path = shape.paths.get(state.path as usize)?;
            Some(json!({
                "rank": rank, "vehicle": vehicle, "path": path.name, "x_m": state.x_m,
                "to_go_m": path.length_m - state.x_m, "v_mps": state.v_mps,
            }))
        };
        let exits = (0..).zip(&shape.exits).map(|(at, exit)| {
            let leaves = |vehicle: u32| {
                let state = slice.iter().find(|s| s.vehicle == vehicle && !s.has_left());
                state.and_then(|s| shape.paths.get(s.path as usize)).is_some_and(|path| path.exit == at)
            };
            let told = assigned.iter().find(|a| leaves(a.vehicle));
            let v_m = told.map(|a| match a.flags & ASSIGNMENT_FREE_TERMINAL {
                0 => json!(a.terminal_speed_mps),
                _ => json!("free"),
            });
            json!({ "name": exit.name, "v_m": v_m })
        });
        Ok(json!({
            "zone": zone,
            "name": shape.name,
            "step": step.header.step,
            "n": slice.iter().filter(|s| !s.has_left()).count(),
            "order": in_force.is_some().then(|| order.iter().copied().filter_map(member).collect::<Vec<_>>()),
            "exits": exits.collect::<Vec<_>>(),
            "left": slice.iter().filter(|s| s.has_left()).map(|s| s.vehicle).collect::<Vec<_>>(),
        }))
    }

    /// All steps in at most so many bins, columns side by side.
    pub fn lines(&self, bins: usize) -> Value {
        let lines = self.index().lines.clone();
        let size = lines.len().div_ceil(bins.clamp(1, 5000)).max(1);
        let mut columns: [Vec<Value>; 12] = Default::default();
        for bin in lines.chunks(size) {
            let least = |at: usize| {
                let least = bin.iter().map(|line| line.least[at]).min_by(|a, b| a.0.total_cmp(&b.0));
                least.filter(|(margin, _)| margin.is_finite())
            };
            let most = |of: fn(&Line) -> u32| bin.iter().map(of).max();
            let [rear, merge, cross] = [0, 1, 2].map(least);
            let values = [
                json!(bin[0].step),
                json!(most(|line| line.vehicles)),
                json!(most(|line| line.verdicts[1])),
                json!(most(|line| line.verdicts[2])),
                json!(most(|line| line.verdicts[3])),
                json!(most(|line| line.verdicts[4] + line.verdicts[5])),
                json!(most(|line| line.misses.count_ones())),
                json!(rear.map(|(margin, _)| margin)),
                json!(merge.map(|(margin, _)| margin)),
                json!(cross.map(|(margin, _)| margin)),
                json!(rear.map(|(_, vehicle)| vehicle)),
                json!(merge.or(cross).map(|(_, vehicle)| vehicle)),
            ];
            columns.iter_mut().zip(values).for_each(|(column, value)| column.push(value));
        }
        let [step, vehicles, fe, bound, infeasible, held, misses, rear, merge, cross, rear_of, merge_of] =
            columns;
        json!({
            "step": step, "vehicles": vehicles, "fe": fe, "bound": bound, "infeasible": infeasible, "held": held,
            "misses": misses, "rear_end_m": rear, "merge_m": merge, "cross_m": cross, "rear_end_of": rear_of,
            "point_of": merge_of, "latencies": self.latencies(bins),
        })
    }

    /// How long steps took, us, the longest of each bin; null in a recording, which does not hold it.
    fn latencies(&self, bins: usize) -> Value {
        let Some(live) = &self.live else { return Value::Null };
        let all = live.latencies();
        let size = all.len().div_ceil(bins.clamp(1, 5000)).max(1);
        let bin = |bin: &[(u64, f32)]| (bin[0].0, bin.iter().map(|(_, us)| *us).fold(0.0, f32::max));
        json!(all.chunks(size).map(bin).collect::<Vec<_>>())
    }

    /// Where the vehicles of a zone were in some steps: 5 words each, vehicle, step, path, position and speed as
    /// 32-bit floats.
    pub fn traces(&self, zone: u32, (from, to): (u64, u64)) -> Vec<u8> {
        let index = self.index();
        let first = index.traces.partition_point(|trace| u64::from(trace.step) < from);
        let last = index.traces.partition_point(|trace| u64::from(trace.step) <= to);
        let own: Vec<_> = index.traces[first..last.max(first)].iter().filter(|t| t.zone == zone).collect();
        let every = (own.len() / TRACES_SENT + 1) as u64 * index.stride;
        let mut bytes = Vec::with_capacity(own.len() * 20);
        for trace in own.iter().filter(|trace| u64::from(trace.step).is_multiple_of(every)) {
            for word in [trace.vehicle, trace.step, trace.path] {
                bytes.extend(word.to_le_bytes());
            }
            bytes.extend(trace.x_m.to_le_bytes());
            bytes.extend(trace.v_mps.to_le_bytes());
        }
        bytes
    }

    /// The events on the time line.
    pub fn events(&self) -> Value {
        let index = self.index();
        json!({ "events": index.events, "more": index.more_events })
    }
}

/// The records of one zone in a state frame, which lists zones in ascending order.
fn of_zone(states: &[VehicleState], zone: u32) -> &[VehicleState] {
    let from = states.partition_point(|s| s.zone < zone);
    let own = states[from..].partition_point(|s| s.zone == zone);
    &states[from..from + own]
}

/// A kind of duty in words.
fn kind_name(kind: DutyKind) -> &'static str {
    match kind {
        DutyKind::RearEnd => "rear end",
        DutyKind::Merge => "merge",
        DutyKind::Cross => "cross",
    }
}
