//! What is to be simulated: the network, its demand, and the parameters of vehicles and controllers.
//!
//! A [`Scenario`] is validated: every value in it is finite and within its stated range, every index
//! points at something, and every zone has a way out of the network. Nothing downstream checks these again.

mod arrange;
pub mod arrivals;
mod check;
pub mod circles;
pub mod demand;
pub(crate) mod draw;
mod embedded;
pub mod encode;
mod fault;
pub mod faults;
pub mod flow;
mod human;
mod keys;
pub mod layout;
pub mod load;
pub mod network;
pub mod params;
pub mod plugins;
mod ranges;
pub mod shapes;
pub mod share;

pub use arrivals::ArrivalStream;
pub use circles::Circles;
pub use demand::{Arrival, Demand, Poisson, RatePeriod, SpeedDistribution};
pub use encode::{DecodeError, decode, encode, keep, kept, scenario_hash};
pub use fault::ScenarioFault;
pub use faults::{CommandFaults, Faults, Noise, Scope, SensorFault, SensorKind, Span, Stall};
pub use flow::{Baseline, FlowPolicy, Observed};
pub use human::{HumanParams, Yielding};
pub use keys::document as keys_document;
pub use load::{
    DEFAULT_SCENARIO, Override, ScenarioError, embedded_names, load, load_embedded, load_file, load_given,
    load_recorded, text_of,
};
pub use network::{
    ConflictArea, Crossing, Downstream, EntryRule, Exit, LawKind, Network, PassingOrder, Path, Road, Route,
    Segment, Source, Zone, ZoneId,
};
pub use params::{
    ControlParams, CoordinationParams, FeConditions, PositionFeedback, ReferenceLaw, Replan, SafetyRows,
    ScheduleKind, Solver, VehicleKind, VehicleParams, ViableParams,
};
pub use plugins::{ControllerNames, Drivers, OnExit, Plugin, ShieldMode, declaration, target_and_command};

use serde::{Deserialize, Serialize};

/// A complete, validated scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scenario {
    /// Name shown in tables and summaries.
    pub name: String,
    /// Seed of all random streams.
    pub seed: u64,
    /// Step length, ns. Simulated time is `step * dt_ns`.
    pub dt_ns: u64,
    /// Arrivals after this many vehicles are not generated (over all roads, in order of arrival).
    pub max_vehicles: Option<u32>,
    /// The run ends at this instant at the latest, s. It ends earlier when all demand has arrived
    /// and every vehicle has left.
    pub max_time_s: f64,
    /// Zones, roads and how they hang together.
    pub network: Network,
    /// Vehicle limits and the safety distances.
    pub vehicle: VehicleParams,
    /// Kinds of vehicles; at least one.
    pub fleet: Vec<VehicleKind>,
    /// The controllers' law.
    pub control: ControlParams,
    /// What coordinators do beside assigning duties.
    pub coordination: CoordinationParams,
    /// Weight of time against energy, m^2/s^4 (paper: beta in `eqn:energyobj`).
    pub beta: f64,
    /// Controllers written elsewhere; the built-in pool drives the rest.
    pub plugins: Vec<Plugin>,
    /// What the gateway does with unsafe commands.
    pub shield: ShieldMode,
    /// What goes wrong on purpose.
    pub faults: Option<Faults>,
}

impl Scenario {
    /// The kind of a vehicle: index in [`fleet`](Self::fleet). A hash of seed and vehicle, so nothing is remembered.
    /// On a road with a share of automated vehicles, that decides first whether a human drives.
    pub fn kind_of(&self, vehicle: u32, road: u32) -> u16 {
        if self.fleet.len() == 1 {
            return 0;
        }
        let choice = |purpose, weights: &mut dyn Iterator<Item = f64>| {
            let weights: [f64; ranges::MAX_KINDS] = std::array::from_fn(|_| weights.next().unwrap_or(0.0));
            draw::choice(self.seed, u64::from(vehicle), purpose, weights.iter().copied())
        };
        let is_human = self
            .network
            .roads
            .get(road as usize)
            .and_then(|road| road.automated)
            .map(|share| choice(draw::DRIVER, &mut [share, 1.0 - share].into_iter()) == 1);
        let of_class = |kind: &VehicleKind| is_human.is_none_or(|human| human == kind.human.is_some());
        let share = |kind: &VehicleKind| if of_class(kind) { kind.share } else { 0.0 };
        choice(draw::KIND, &mut self.fleet.iter().map(share)) as u16
    }

    /// Whether any vehicle may be driven by a human.
    pub fn has_humans(&self) -> bool {
        self.fleet.iter().any(|kind| kind.human.is_some())
    }

    /// The driver of a kind of vehicle, if it is a human.
    pub fn human(&self, kind: u16) -> Option<&HumanParams> {
        self.fleet.get(usize::from(kind))?.human.as_ref()
    }

    /// The step length in seconds.
    pub fn dt_s(&self) -> f64 {
        self.dt_ns as f64 * 1e-9
    }

    /// Simulated time of a step in seconds, from integer nanoseconds.
    pub fn time_s(&self, step: u64) -> f64 {
        (step * self.dt_ns) as f64 * 1e-9
    }
}
