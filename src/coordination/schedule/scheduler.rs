//! The schedule of one zone.

use super::chain::{Chain, Passage};
use super::cost::{Cost, Single, Tandem};
use super::pooling::best_s;
use crate::conflict::{Conflicts, Duties, Row};
use crate::coordination::assign::row;
use crate::scenario::{
    CoordinationParams, PassingOrder, Scenario, ScheduleKind, VehicleParams, Zone, ZoneId,
};
use ipc_schemas::{NO_VEHICLE, SUMMARY_COMING, VehicleState, ZoneSummary};

/// What the time of those that others come behind weighs more, as a share of the price: these are scheduled themselves.
const PRICE_WHEN_FOLLOWED: f64 = 0.3;
/// Whoever leaves sooner than this is scheduled for the end of the next zone as if it were in it already, s.
const NEARLY_THERE_S: f64 = 1.0;

/// A zone's vehicles as they are to pass.
#[derive(Clone, Copy)]
pub(in crate::coordination) struct Queue<'a> {
    /// Those that have left, the members in passing order, and those that are about to come; each row's id is its place.
    pub(in crate::coordination) rows: &'a [Row],
    /// Places in the slice of the first two.
    pub(in crate::coordination) at: &'a [u32],
    /// What they owe.
    pub(in crate::coordination) duties: &'a Duties,
    /// What was told of the last.
    pub(in crate::coordination) coming: &'a [ZoneSummary],
}

impl Queue<'_> {
    fn left(&self) -> usize {
        self.rows.iter().take_while(|row| row.has_left).count()
    }
}

/// What a zone has last heard of a neighbour.
#[derive(Clone, Debug)]
pub(in crate::coordination) struct Heard {
    pub(in crate::coordination) from: ZoneId,
    /// The neighbour's conflicts, where vehicles go there from here.
    pub(in crate::coordination) conflicts: Option<Conflicts>,
    pub(in crate::coordination) summaries: Vec<ZoneSummary>,
}

/// A zone at one of its events.
#[derive(Clone, Copy)]
pub(in crate::coordination) struct Scene<'a> {
    pub(in crate::coordination) scenario: &'a Scenario,
    pub(in crate::coordination) conflicts: &'a Conflicts,
    /// Its S(t).
    pub(in crate::coordination) slice: &'a [VehicleState],
    pub(in crate::coordination) time_s: f64,
    pub(in crate::coordination) heard: &'a [Heard],
}

/// Schedules zones; kept from use to use for its allocations.
#[derive(Debug, Default)]
pub(in crate::coordination) struct Scheduler {
    chain: Chain,
    costs: Vec<Cost>,
    passages: Vec<Passage>,
    /// Weight of time of each that is scheduled.
    betas: Vec<f64>,
    times_s: Vec<f64>,
    beyond: Beyond,
}

/// What is worked out about the zones downstream.
#[derive(Debug, Default)]
struct Beyond {
    chain: Chain,
    rows: Vec<Row>,
    duties: Duties,
    passages: Vec<Passage>,
    costs: Vec<Cost>,
    /// Whom the costs belong to: index among those scheduled here.
    whom: Vec<usize>,
    /// When each of those scheduled here leaves the next zone, s from now; infinite for those of whom that is not
    /// known.
    times_s: Vec<f64>,
}

impl Scene<'_> {
    /// Whether the vehicles of this zone are scheduled.
    pub(in crate::coordination) fn is_scheduled(&self) -> bool {
        self.params().schedule != ScheduleKind::None
    }

    /// Whether neighbouring zones' vehicles are scheduled together.
    pub(in crate::coordination) fn is_tandem(&self) -> bool {
        self.params().schedule == ScheduleKind::Tandem
    }

    /// Whether those that are about to come are scheduled together with the zone's own: in tandem, where they will pass
    /// in order of entry. Where newcomers may be put ahead of others their place is not known before they are there.
    pub(in crate::coordination) fn expects_in_order(&self) -> bool {
        self.is_tandem() && self.zone().order == PassingOrder::Fifo
    }

    fn zone(&self) -> &Zone {
        &self.scenario.network.zones[self.slice[0].zone as usize]
    }

    fn params(&self) -> &CoordinationParams {
        &self.scenario.coordination
    }

    fn kind(&self, kind: u16) -> &VehicleParams {
        let fleet = &self.scenario.fleet;
        &fleet.get(usize::from(kind)).unwrap_or(&fleet[0]).vehicle
    }

    /// The vehicles that are about to come from upstream, as far as their zones have told, in the order in which they
    /// are expected.
    pub(in crate::coordination) fn coming(&self, coming: &mut Vec<ZoneSummary>) {
        let told = self.heard.iter().flat_map(|heard| &heard.summaries);
        let zone = &self.scenario.network.zones[self.slice[0].zone as usize];
        coming.clear();
        coming.extend(
            told.filter(|s| s.flags & SUMMARY_COMING != 0 && is_sound(s, zone.paths.len()))
                // Those that have come since are members.
                .filter(|s| !self.slice.iter().any(|state| state.vehicle == s.vehicle)),
        );
        // A zone tells its own in order of entry; of several zones the nearest come first.
        coming.sort_by(|a, b| b.x_m.total_cmp(&a.x_m));
    }

    /// The row of a vehicle that a neighbour has told of.
    pub(in crate::coordination) fn told_row(&self, told: &ZoneSummary, id: u32) -> Row {
        let state = VehicleState {
            path: told.path,
            next_path: told.next_path,
            x_m: told.x_m,
            v_mps: told.v_mps,
            kind: told.kind,
            ..VehicleState::default()
        };
        row(self.scenario, &state, id)
    }

    fn passage(&self, conflicts: &Conflicts, row: &Row, kind: u16) -> Passage {
        let vehicle = self.kind(kind);
        Passage {
            x_m: row.x_m,
            v_mps: row.v_mps.max(0.0),
            length_m: conflicts.length_m(row.path),
            body_m: row.length_m,
            reaction_s: vehicle.reaction_time_s,
            v_max_mps: vehicle.v_max_mps,
            u_max_mps2: vehicle.u_max_mps2,
            known: None,
        }
    }
}

/// Where a vehicle that is about to come is by now, m before the zone, negative, and how fast, m/s: since it was told of it
/// has driven on by a plan whose acceleration ends at zero.
fn on_its_way(told: &ZoneSummary, time_s: f64) -> (f64, f64) {
    let (way_m, v_mps, exit_mps) = (-told.x_m, told.v_mps.max(0.0), told.planned_exit_speed_mps.max(0.1));
    let left_s = (told.planned_exit_time_s - time_s).max(0.0);
    let whole_s = 3.0 * way_m / (2.0 * exit_mps + v_mps);
    if whole_s <= left_s {
        return (told.x_m, v_mps);
    }
    let u_mps2 = 3.0 * (way_m - v_mps * whole_s) / (whole_s * whole_s);
    let slower_mps = 0.5 * u_mps2 * left_s * left_s / whole_s;
    (-(exit_mps - slower_mps / 3.0) * left_s, exit_mps - slower_mps)
}

/// Whether what a neighbour tells of a vehicle can be reckoned with.
fn is_sound(told: &ZoneSummary, paths: usize) -> bool {
    let finite = [told.x_m, told.v_mps, told.planned_exit_time_s, told.planned_exit_speed_mps];
    told.vehicle != NO_VEHICLE && (told.path as usize) < paths && finite.iter().all(|x| x.is_finite())
}

impl Scheduler {
    /// The instants at which the members of a zone are to leave it, in passing order, s from now.
    ///
    pub(in crate::coordination) fn schedule(&mut self, scene: &Scene<'_>, queue: &Queue<'_>) -> &[f64] {
        let Queue { at, duties, .. } = *queue;
        let left = queue.left();
        let members = at.len() - left;
        self.prepare(scene, queue);
        self.times_s.clear();
        self.times_s.extend_from_slice(self.chain.schedule(&self.passages, duties, left, &self.costs));
        if scene.is_tandem() && self.look_beyond(scene, &at[left..]) {
            self.times_s.clear();
            self.times_s.extend_from_slice(self.chain.schedule(&self.passages, duties, left, &self.costs));
        }
        &self.times_s[..members]
    }

    /// What the vehicles of a zone cost when they pass in this order.
    pub(in crate::coordination) fn cost(&mut self, scene: &Scene<'_>, queue: &Queue<'_>) -> f64 {
        self.prepare(scene, queue);
        self.chain.schedule(&self.passages, queue.duties, queue.left(), &self.costs);
        self.chain.cost(&self.costs)
    }

    /// Passages and costs of this zone alone.
    fn prepare(&mut self, scene: &Scene<'_>, queue: &Queue<'_>) {
        let Scheduler { costs, passages, betas, .. } = self;
        let Queue { rows, at, coming, .. } = *queue;
        let left = queue.left();
        let beta = scene.scenario.beta;
        passages.clear();
        costs.clear();
        betas.clear();
        for (place, row) in rows.iter().enumerate() {
            let (kind, planned_s) = match at.get(place) {
                Some(&at) => (scene.slice[at as usize].kind, 0.0),
                None => {
                    let told = &coming[place - at.len()];
                    (told.kind, told.planned_exit_time_s)
                }
            };
            let mut passage = scene.passage(scene.conflicts, row, kind);
            if let Some(told) = place.checked_sub(at.len()).map(|told| &coming[told]) {
                (passage.x_m, passage.v_mps) = on_its_way(told, scene.time_s);
            }
            passages.push(passage);
            if place < left {
                continue;
            }
            // Where several paths cross, many may have nobody behind them; newcomers wait for the last alone.
            let share = if place + 1 == rows.len() { 1.0 } else { PRICE_WHEN_FOLLOWED };
            let weighed = beta * (1.0 + share * scene.params().price_of_time);
            betas.push(weighed);
            let (left_m, v_mps) = (passage.left_m(), passage.v_mps);
            let entry_s = planned_s - scene.time_s;
            costs.push(if entry_s <= NEARLY_THERE_S || passage.x_m >= 0.0 {
                Cost::Single(Single { beta: weighed, left_m, v_mps })
            } else {
                Cost::Second(
                    Tandem {
                        first_beta: 0.0,
                        second_beta: weighed,
                        weight: 1.0,
                        first_m: -passage.x_m,
                        second_m: passage.length_m,
                        v_mps,
                    },
                    entry_s,
                )
            });
        }
    }

    /// Schedules the members through the next zones, for the instants at which they are to leave this one, and makes
    /// those part of their costs. Returns whether any has a next zone.
    fn look_beyond(&mut self, scene: &Scene<'_>, members: &[u32]) -> bool {
        let Scheduler { costs, passages, betas, times_s, beyond, .. } = self;
        let left = passages.len() - costs.len();
        beyond.times_s.clear();
        beyond.times_s.resize(members.len(), f64::INFINITY);
        let mut is_any = false;
        for heard in scene.heard {
            let Some(conflicts) = &heard.conflicts else { continue };
            let goes_there = |&vehicle: &usize| {
                let state = &scene.slice[members[vehicle] as usize];
                let is_direct = scene.zone().onward_m(state.path).is_some();
                state.next_zone == heard.from && is_direct && times_s[vehicle] > NEARLY_THERE_S
            };
            beyond.whom.clear();
            beyond.whom.extend((0..members.len()).filter(goes_there));
            beyond.whom.sort_by(|a, b| times_s[*a].total_cmp(&times_s[*b]));
            if beyond.whom.is_empty() {
                continue;
            }
            is_any = true;
            beyond.known(scene, heard, conflicts);
            let known = beyond.rows.len();
            beyond.costs.clear();
            let (beta, weight) = (scene.scenario.beta, scene.params().tandem_weight);
            for (place, &vehicle) in beyond.whom.iter().enumerate() {
                let is_last = place + 1 == beyond.whom.len();
                let price = scene.params().price_of_time * if is_last { 1.0 } else { PRICE_WHEN_FOLLOWED };
                let state = &scene.slice[members[vehicle] as usize];
                let own = &passages[left + vehicle];
                let mut row = row(scene.scenario, state, beyond.rows.len() as u32);
                row.x_m = -own.left_m();
                (row.path, row.next_path) = (state.next_path, state.then_path);
                let there = scene.passage(conflicts, &row, state.kind);
                beyond.rows.push(row);
                beyond.passages.push(there);
                let tandem = Tandem {
                    first_beta: betas[vehicle] - weight * beta,
                    second_beta: weight * beta * (1.0 + price),
                    weight,
                    first_m: own.left_m(),
                    second_m: there.length_m,
                    v_mps: own.v_mps,
                };
                beyond.costs.push(Cost::Second(tandem, times_s[vehicle]));
            }
            beyond.duties.derive(conflicts, &beyond.rows);
            let times_s = beyond.chain.schedule(&beyond.passages, &beyond.duties, known, &beyond.costs);
            for ((&vehicle, cost), &time_s) in beyond.whom.iter().zip(&beyond.costs).zip(times_s) {
                if let Cost::Second(tandem, _) = cost {
                    costs[vehicle] = Cost::First(*tandem, time_s);
                }
            }
        }
        is_any
    }
}

impl Beyond {
    /// Rows and passages of the vehicles in a zone downstream, which leave it as they plan to.
    fn known(&mut self, scene: &Scene<'_>, heard: &Heard, conflicts: &Conflicts) {
        self.rows.clear();
        self.passages.clear();
        let zone = &scene.scenario.network.zones[heard.from as usize];
        let there = |s: &&ZoneSummary| s.flags & SUMMARY_COMING == 0 && is_sound(s, zone.paths.len());
        for told in heard.summaries.iter().filter(there) {
            let row = Row { has_left: true, ..scene.told_row(told, self.rows.len() as u32) };
            let mut passage = scene.passage(conflicts, &row, told.kind);
            let plan = (told.planned_exit_time_s - scene.time_s, told.planned_exit_speed_mps);
            passage.known = Some(if plan.0 > 0.0 {
                plan
            } else {
                let single =
                    Single { beta: scene.scenario.beta, left_m: passage.left_m(), v_mps: passage.v_mps };
                let time_s = best_s(&Cost::Single(single));
                (time_s, single.exit_mps(time_s))
            });
            self.rows.push(row);
            self.passages.push(passage);
        }
    }
}
