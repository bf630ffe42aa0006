//! The coordinator of a contiguous range of zones, from state and summary frames to coordination.

use super::assign::{Assigner, Decided};
use super::flow::FlowController;
use super::order::{Means, Order, Orders};
use super::schedule::{Heard, Scene, Scheduler};
use super::summaries::{Audience, is_event};
use crate::conflict::Conflicts;
use crate::control::Terminal;
use crate::scenario::{Scenario, ScheduleKind, ZoneId};
use ipc_schemas::{ASSIGNMENT_PASSED, ASSIGNMENT_PASSED_ONCE, Assignment, VehicleState, ZoneSummary};
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
    scheduler: Scheduler,
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
    /// The passing order as decided last.
    order: Order,
    /// What neighbours have told of their vehicles, where zones schedule in tandem.
    heard: Vec<Heard>,
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
        let is_tandem = scenario.coordination.schedule == ScheduleKind::Tandem;
        let network = &scenario.network;
        let heard = network.neighbours(zone).filter(|_| is_tandem).map(|from| {
            let is_downstream = network.downstream(zone).any(|next| next == from);
            let conflicts = is_downstream.then(|| Conflicts::of(network, from));
            Heard { from, conflicts, summaries: Vec::new() }
        });
        Post {
            conflicts: Conflicts::of(network, zone),
            audience: Audience::of(scenario, zone),
            exits: exits.collect(),
            terminals: Vec::new(),
            order: Order::default(),
            heard: heard.collect(),
            told: false,
        }
    }

    /// Keeps what a neighbour says.
    fn hear(&mut self, summaries: &[ZoneSummary]) {
        let from = summaries[0].from_zone;
        for exit in self.exits.iter_mut().filter(|exit| exit.to == Some(from)) {
            exit.downstream = Some(summaries[0]);
        }
        for heard in self.heard.iter_mut().filter(|heard| heard.from == from) {
            heard.summaries.clear();
            heard.summaries.extend_from_slice(summaries);
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
            scheduler: Scheduler::default(),
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
        for group in summaries.chunk_by(is_of_one) {
            let zone = group[0].to_zone;
            if self.zones.contains(&zone) {
                let post = &mut self.posts[(zone - self.zones.start) as usize];
                post.told = true;
                self.told.push(zone);
                post.hear(group);
            }
        }
    }

    /// Takes over from another coordinator: `heard` are the last summaries of each neighbour its zones acted on, `due`
    /// those sent in the step before the first this one acts in, `in_force` the assignments of before that step.
    pub fn restore(&mut self, heard: &[ZoneSummary], due: &[ZoneSummary], in_force: &[Assignment]) {
        for group in in_force.chunk_by(|a, b| a.zone == b.zone) {
            if self.zones.contains(&group[0].zone) {
                let mut ranks: Vec<(u32, u32)> = group.iter().map(|a| (a.rank, a.vehicle)).collect();
                ranks.sort_unstable();
                ranks.dedup();
                let vehicles = ranks.into_iter().map(|(_, vehicle)| vehicle).collect();
                let times = |a: &Assignment| (a.flags & ASSIGNMENT_PASSED) / ASSIGNMENT_PASSED_ONCE;
                let mut passed: Vec<(u32, u16)> = group.iter().map(|a| (a.vehicle, times(a))).collect();
                passed.retain(|(_, times)| *times > 0);
                passed.dedup();
                let order = Order { vehicles, passed };
                self.posts[(group[0].zone - self.zones.start) as usize].order = order;
            }
        }
        for group in heard.chunk_by(is_of_one) {
            if self.zones.contains(&group[0].to_zone) {
                self.posts[(group[0].to_zone - self.zones.start) as usize].hear(group);
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
        let time_s = self.scenario.time_s(step);
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
                // Whoever is told when to leave is not told how fast as well.
                let is_scheduled = self.scenario.coordination.schedule != ScheduleKind::None;
                let members = &slice[slice.iter().take_while(|state| state.has_left()).count()..];
                let terminals = post.exits.iter().map(|exit| match is_scheduled {
                    true => Terminal::Free,
                    false => exit.flow.terminal(members, exit.downstream.as_ref()),
                });
                post.terminals.clear();
                post.terminals.extend(terminals);
                let Post { conflicts, terminals, order, heard, .. } = post;
                let Coordinator { scenario, assigner, orders, scheduler, assignments, .. } = self;
                let scene = Scene { scenario, conflicts, slice, time_s, heard };
                let policy = scenario.network.zones[zone as usize].order;
                orders.update(policy, &scene, order, &mut Means { assigner, scheduler });
                assigner.derive(&scene, &order.vehicles);
                let times_s =
                    if scene.is_scheduled() { scheduler.schedule(&scene, &assigner.queue()) } else { &[] };
                assigner.assign(&scene, &Decided { terminals, passed: &order.passed, times_s }, assignments);
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

/// Whether two summaries tell one zone about one other.
fn is_of_one(a: &ZoneSummary, b: &ZoneSummary) -> bool {
    (a.from_zone, a.to_zone) == (b.from_zone, b.to_zone)
}
