//! The coordinator of a contiguous range of zones, from state and summary frames to coordination.

use super::flow::FlowController;
use super::partners;
use super::summaries::{Audience, is_event};
use crate::scenario::{Scenario, ZoneId};
use ipc_schemas::{Assignment, VehicleState, ZoneSummary};
use std::ops::Range;
use std::sync::Arc;

/// Coordinates some zones; event-driven.
///
/// A zone acts in a step in which a vehicle entered or left it, or in which the summary of a neighbour's
/// event reaches it. It then re-evaluates its terminal speed and sends the full list of assignments.
/// Summaries reach their receiver one step after the event, also between zones of the same process, so
/// the result does not depend on how zones are shared out.
#[derive(Debug)]
pub struct Coordinator {
    scenario: Arc<Scenario>,
    zones: Range<ZoneId>,
    desks: Vec<Desk>,
    /// Summaries of this step to zones of this process, delivered in the next one.
    internal: Vec<ZoneSummary>,
    internal_step: u64,
    /// Summaries of this step to zones of other processes.
    external: Vec<ZoneSummary>,
    assignments: Vec<Assignment>,
    /// Zones whose desk has been told something for this step.
    told: Vec<ZoneId>,
}

/// What a coordinator keeps for one zone.
#[derive(Debug)]
struct Desk {
    flow: FlowController,
    audience: Audience,
    downstream: Option<ZoneSummary>,
    told: bool,
}

impl Coordinator {
    /// The coordinator of the given zones.
    pub fn new(scenario: Arc<Scenario>, zones: Range<ZoneId>) -> Coordinator {
        let network = &scenario.network;
        let desks = zones
            .clone()
            .map(|zone| Desk {
                flow: FlowController::new(&scenario, zone),
                audience: Audience::of(network, zone),
                downstream: None,
                told: false,
            })
            .collect();
        Coordinator {
            zones,
            desks,
            internal: Vec::new(),
            internal_step: 0,
            external: Vec::new(),
            assignments: Vec::new(),
            told: Vec::new(),
            scenario,
        }
    }

    /// The zones it coordinates.
    pub fn zones(&self) -> Range<ZoneId> {
        self.zones.clone()
    }

    /// Simulated time of a step, ns.
    pub fn time_ns(&self, step: u64) -> u64 {
        step * self.scenario.dt_ns
    }

    /// Takes the summaries another coordinator sent in the previous step; those to zones of other
    /// processes are skipped.
    pub fn receive(&mut self, summaries: &[ZoneSummary]) {
        for summary in summaries {
            if self.zones.contains(&summary.to_zone) {
                let downstream = self.scenario.network.downstream(summary.to_zone);
                let desk = &mut self.desks[(summary.to_zone - self.zones.start) as usize];
                desk.told = true;
                self.told.push(summary.to_zone);
                if downstream == Some(summary.from_zone) {
                    desk.downstream = Some(*summary);
                }
            }
        }
    }

    /// Takes over from another coordinator: `downstream` are the last summaries its zones acted on, `due`
    /// those sent in the step before the first this one acts in.
    pub fn restore(&mut self, downstream: &[ZoneSummary], due: &[ZoneSummary]) {
        for summary in downstream {
            if self.zones.contains(&summary.to_zone) {
                self.desks[(summary.to_zone - self.zones.start) as usize].downstream = Some(*summary);
            }
        }
        self.receive(due);
    }

    /// Acts on a state frame that holds at least the zones that act. Afterwards
    /// [`assignments`](Self::assignments) and [`summaries`](Self::summaries) hold what is to be sent. Returns
    /// whether a zone of this process had an event of its own, in which case every neighbouring process
    /// expects a summary frame.
    pub fn act(&mut self, step: u64, states: &[VehicleState]) -> bool {
        let mut had_event = false;
        if self.internal_step + 1 == step {
            let internal = std::mem::take(&mut self.internal);
            self.receive(&internal);
            self.internal = internal;
        }
        self.internal.clear();
        self.internal_step = step;
        self.external.clear();
        self.assignments.clear();
        for slice in states.chunk_by(|a, b| a.zone == b.zone) {
            let zone = slice[0].zone;
            if !self.zones.contains(&zone) {
                continue;
            }
            let desk = &mut self.desks[(zone - self.zones.start) as usize];
            let told = desk.told;
            let event = is_event(slice);
            had_event |= event;
            if event {
                for summary in desk.audience.summaries(zone, slice) {
                    if self.zones.contains(&summary.to_zone) {
                        self.internal.push(summary);
                    } else {
                        self.external.push(summary);
                    }
                }
            }
            if event || told {
                let terminal = desk.flow.terminal(desk.downstream.as_ref());
                let zone = &self.scenario.network.zones[zone as usize];
                partners::assign(zone, slice, terminal, &mut self.assignments);
            }
        }
        for zone in self.told.drain(..) {
            self.desks[(zone - self.zones.start) as usize].told = false;
        }
        had_event
    }

    /// The assignments of the zones that acted.
    pub fn assignments(&self) -> &[Assignment] {
        &self.assignments
    }

    /// The summaries for zones of the given range (another process's).
    pub fn summaries(&self, zones: Range<ZoneId>) -> impl Iterator<Item = ZoneSummary> + '_ {
        self.external.iter().filter(move |s| zones.contains(&s.to_zone)).copied()
    }
}
