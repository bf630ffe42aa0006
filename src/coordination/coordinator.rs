//! The coordinator of a contiguous range of zones, from state and summary frames to coordination.

use super::assign::Assigner;
use super::flow::FlowController;
use super::order::Orders;
use super::summaries::{Audience, is_event};
use crate::conflict::Conflicts;
use crate::control::Terminal;
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
    posts: Vec<Post>,
    assigner: Assigner,
    orders: Orders,
    /// Summaries of this step to zones of this process, delivered in the next one.
    internal: Vec<ZoneSummary>,
    internal_step: u64,
    /// Summaries of this step to zones of other processes.
    external: Vec<ZoneSummary>,
    assignments: Vec<Assignment>,
    /// Zones that have been told something for this step.
    told: Vec<ZoneId>,
}

/// What a coordinator keeps for one zone.
#[derive(Debug)]
struct Post {
    conflicts: Conflicts,
    audience: Audience,
    exits: Vec<ExitPost>,
    /// Terminal condition by exit, as decided last.
    terminals: Vec<Terminal>,
    /// The zone's vehicles in passing order, as decided last.
    order: Vec<u32>,
    told: bool,
}

/// What it keeps for one exit.
#[derive(Debug)]
struct ExitPost {
    flow: FlowController,
    /// The zone it leads to, and the last summary of it.
    to: Option<ZoneId>,
    downstream: Option<ZoneSummary>,
}

impl Post {
    fn new(scenario: &Scenario, zone: ZoneId) -> Post {
        let shape = &scenario.network.zones[zone as usize];
        let exits = shape.exits.iter().map(|exit| ExitPost {
            flow: FlowController::new(scenario, shape, exit),
            to: exit.to.map(|to| to.zone),
            downstream: None,
        });
        Post {
            conflicts: Conflicts::of(&scenario.network, zone),
            audience: Audience::of(&scenario.network, zone),
            exits: exits.collect(),
            terminals: Vec::new(),
            order: Vec::new(),
            told: false,
        }
    }

    /// Keeps what a zone downstream says.
    fn hear(&mut self, summary: &ZoneSummary) {
        for exit in self.exits.iter_mut().filter(|exit| exit.to == Some(summary.from_zone)) {
            exit.downstream = Some(*summary);
        }
    }
}

impl Coordinator {
    /// The coordinator of the given zones.
    pub fn new(scenario: Arc<Scenario>, zones: Range<ZoneId>) -> Coordinator {
        let posts = zones.clone().map(|zone| Post::new(&scenario, zone)).collect();
        Coordinator {
            zones,
            posts,
            assigner: Assigner::default(),
            orders: Orders::new(&scenario),
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
                let post = &mut self.posts[(summary.to_zone - self.zones.start) as usize];
                post.told = true;
                self.told.push(summary.to_zone);
                post.hear(summary);
            }
        }
    }

    /// Takes over from another coordinator: `downstream` are the last summaries its zones acted on, `due`
    /// those sent in the step before the first this one acts in, `in_force` the assignments of before that step.
    pub fn restore(&mut self, downstream: &[ZoneSummary], due: &[ZoneSummary], in_force: &[Assignment]) {
        for group in in_force.chunk_by(|a, b| a.zone == b.zone) {
            if self.zones.contains(&group[0].zone) {
                let mut ranks: Vec<(u32, u32)> = group.iter().map(|a| (a.rank, a.vehicle)).collect();
                ranks.sort_unstable();
                ranks.dedup();
                let order = ranks.into_iter().map(|(_, vehicle)| vehicle).collect();
                self.posts[(group[0].zone - self.zones.start) as usize].order = order;
            }
        }
        for summary in downstream {
            if self.zones.contains(&summary.to_zone) {
                self.posts[(summary.to_zone - self.zones.start) as usize].hear(summary);
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
            let post = &mut self.posts[(zone - self.zones.start) as usize];
            let told = post.told;
            let event = is_event(slice);
            had_event |= event;
            if event {
                for summary in post.audience.summaries(zone, slice) {
                    if self.zones.contains(&summary.to_zone) {
                        self.internal.push(summary);
                    } else {
                        self.external.push(summary);
                    }
                }
            }
            if event || told {
                let terminals = post.exits.iter().map(|exit| exit.flow.terminal(exit.downstream.as_ref()));
                post.terminals.clear();
                post.terminals.extend(terminals);
                let Post { conflicts, terminals, order, .. } = post;
                let policy = self.scenario.network.zones[zone as usize].order;
                let members = &slice[slice.iter().take_while(|state| state.has_left()).count()..];
                self.orders.update(policy, &self.scenario, conflicts, members, order);
                let assignments = &mut self.assignments;
                self.assigner.assign(&self.scenario, conflicts, slice, order, terminals, assignments);
            }
        }
        for zone in self.told.drain(..) {
            self.posts[(zone - self.zones.start) as usize].told = false;
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
