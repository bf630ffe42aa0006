//! What a run is judged by, per zone and in all.

use super::car::Visit;
use super::overlap::OverlapSummary;
use super::standstill::Stall;
use super::traffic::TrafficSummary;
use crate::scenario::ShieldMode;
use serde::{Deserialize, Serialize};

/// Running sums of one zone.
#[derive(Clone, Debug)]
pub(super) struct ZoneMetrics {
    pub vehicles: u32,
    pub time_s: f64,
    pub energy: f64,
    pub wait_s: f64,
    pub exposure_m_s: f64,
    pub fe_vehicles: u32,
    pub fe_s: f64,
    pub infeasible_vehicles: u32,
    pub least_rear_end_m: f64,
    pub least_rear_end_clean_m: f64,
    pub least_merge_m: f64,
    pub least_merge_clean_m: f64,
    pub least_cross_m: f64,
    pub least_cross_clean_m: f64,
    pub order_violations: u32,
    pub overtakes: u32,
}

impl Default for ZoneMetrics {
    fn default() -> ZoneMetrics {
        ZoneMetrics {
            vehicles: 0,
            time_s: 0.0,
            energy: 0.0,
            wait_s: 0.0,
            exposure_m_s: 0.0,
            fe_vehicles: 0,
            fe_s: 0.0,
            infeasible_vehicles: 0,
            least_rear_end_m: f64::INFINITY,
            least_rear_end_clean_m: f64::INFINITY,
            least_merge_m: f64::INFINITY,
            least_merge_clean_m: f64::INFINITY,
            least_cross_m: f64::INFINITY,
            least_cross_clean_m: f64::INFINITY,
            order_violations: 0,
            overtakes: 0,
        }
    }
}

impl ZoneMetrics {
    /// Accounts a vehicle that has left the zone.
    pub(super) fn leave(&mut self, visit: &Visit, time_s: f64) {
        self.vehicles += 1;
        self.time_s += time_s;
        self.energy += visit.energy;
        self.wait_s += visit.wait_s;
        self.exposure_m_s += visit.exposure_m_s;
        if visit.fe_s > 0.0 {
            self.fe_vehicles += 1;
            self.fe_s += visit.fe_s;
        }
        self.infeasible_vehicles += u32::from(visit.infeasible);
        self.observe(visit);
    }

    /// Accounts the margins of a vehicle that leaves, or is still inside when the run ends.
    pub(super) fn observe(&mut self, visit: &Visit) {
        self.least_rear_end_m = self.least_rear_end_m.min(visit.least_rear_end_m);
        if visit.clean_rear_end {
            self.least_rear_end_clean_m = self.least_rear_end_clean_m.min(visit.least_rear_end_m);
        }
        self.least_merge_m = self.least_merge_m.min(visit.least_merge_m);
        if visit.clean_merge {
            self.least_merge_clean_m = self.least_merge_clean_m.min(visit.least_merge_m);
            self.least_cross_clean_m = self.least_cross_clean_m.min(visit.least_cross_m);
        }
        self.least_cross_m = self.least_cross_m.min(visit.least_cross_m);
    }

    pub(super) fn row(&self, zone: &str, beta: f64) -> ZoneSummaryRow {
        let mean = |sum: f64, count: u32| if count == 0 { 0.0 } else { sum / f64::from(count) };
        let seen = |margin: f64| margin.is_finite().then_some(margin);
        let mean_time_s = mean(self.time_s, self.vehicles);
        let mean_energy = mean(self.energy, self.vehicles);
        ZoneSummaryRow {
            zone: zone.to_owned(),
            vehicles: self.vehicles,
            mean_time_s,
            mean_energy,
            mean_objective: beta * mean_time_s + mean_energy,
            mean_wait_s: mean(self.wait_s, self.vehicles),
            mean_exposure_m_s: mean(self.exposure_m_s, self.vehicles),
            fe_vehicles: self.fe_vehicles,
            fe_mean_s: mean(self.fe_s, self.fe_vehicles),
            infeasible_vehicles: self.infeasible_vehicles,
            min_rear_end_margin_m: seen(self.least_rear_end_m),
            min_merge_margin_m: seen(self.least_merge_m),
            min_cross_margin_m: seen(self.least_cross_m),
            min_rear_end_margin_clean_m: seen(self.least_rear_end_clean_m),
            min_merge_margin_clean_m: seen(self.least_merge_clean_m),
            min_cross_margin_clean_m: seen(self.least_cross_clean_m),
            order_violations: self.order_violations,
            overtakes: self.overtakes,
            orders_refused: 0,
        }
    }
}

/// One vehicle's passage through one zone, from origin to exit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CompletedVisit {
    /// The vehicle.
    pub vehicle: u32,
    /// Index of the zone in [`crate::scenario::Network::zones`].
    pub zone: u32,
    /// Instant of entry, s.
    pub entry_time_s: f64,
    /// Instant at which it left, s.
    pub exit_time_s: f64,
    /// Speed at which it left, m/s.
    pub exit_speed_mps: f64,
    /// Energy, the integral of u^2/2, m^2/s^3.
    pub energy: f64,
    /// Time in FE mode, s.
    pub fe_s: f64,
    /// Time it waited outside before it entered, s.
    pub wait_s: f64,
    /// Integral over time of what its rear-end margin lacks, m s.
    pub exposure_m_s: f64,
}

impl CompletedVisit {
    /// Travel time, s.
    pub fn time_s(&self) -> f64 {
        self.exit_time_s - self.entry_time_s
    }
}

/// One zone's results.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ZoneSummaryRow {
    /// Zone name.
    pub zone: String,
    /// Vehicles that left the zone.
    pub vehicles: u32,
    /// Mean travel time, s.
    pub mean_time_s: f64,
    /// Mean energy, the integral of u^2/2, m^2/s^3.
    pub mean_energy: f64,
    /// Mean objective, beta * time + energy (paper: `eqn:energyobj`).
    pub mean_objective: f64,
    /// Mean time its vehicles waited outside, from their scheduled arrival until they entered, s; of those that came by a
    /// road. It counts as time in the total objective.
    pub mean_wait_s: f64,
    /// Mean exposure: the integral over time of what the rear-end margin lacks, m s.
    pub mean_exposure_m_s: f64,
    /// Vehicles that braked in FE mode.
    pub fe_vehicles: u32,
    /// Mean time in FE mode of those vehicles, s.
    pub fe_mean_s: f64,
    /// Vehicles that met an infeasible QP.
    pub infeasible_vehicles: u32,
    /// Least rear-end margin of any vehicle at any instant, m; absent when no vehicle had a leader.
    pub min_rear_end_margin_m: Option<f64>,
    /// Least merging margin of any vehicle at its crossing, m; absent when none was needed.
    pub min_merge_margin_m: Option<f64>,
    /// Least crossing margin of any vehicle at its crossing, m; absent when none was needed.
    pub min_cross_margin_m: Option<f64>,
    /// The same for vehicles that were viable toward each leader when they came to owe it something.
    pub min_rear_end_margin_clean_m: Option<f64>,
    /// The same for vehicles that were viable toward each one that merges or crosses first when they came to owe it
    /// something.
    pub min_merge_margin_clean_m: Option<f64>,
    /// The same at crossings.
    pub min_cross_margin_clean_m: Option<f64>,
    /// Times a vehicle passed a conflict point before one that was to pass it first.
    pub order_violations: u32,
    /// Samples at which a vehicle was ahead of its leader.
    pub overtakes: u32,
    /// Passing orders of the coordinator that the world did not adopt, as they would have put somebody in danger.
    pub orders_refused: u32,
}

/// Results of a run as far as the world knows them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct WorldSummary {
    /// Steps integrated.
    pub steps: u64,
    /// Chained hash of all state frames.
    pub state_hash: u64,
    /// Vehicles that entered the network.
    pub arrived: u32,
    /// Vehicles that left it.
    pub departed: u32,
    /// Arrivals that had to wait outside because they would have overlapped another vehicle, or their road's gate held
    /// them.
    pub held_arrivals: u32,
    /// Vehicles still waiting outside when the run ended.
    pub waiting: u32,
    /// Per zone.
    pub zones: Vec<ZoneSummaryRow>,
    /// Bodies that overlapped.
    pub overlaps: OverlapSummary,
    /// Zones in which nothing moved any more when the run ended.
    pub stalled: Vec<Stall>,
    /// What the gateway did.
    pub shield: ShieldSummary,
    /// What went wrong on purpose, if anything was to.
    pub faults: Option<FaultCounts>,
    /// Who moved the vehicles, where it was not the world itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub traffic: Option<TrafficSummary>,
}

/// How often each fault of the scenario struck. Records are those of the state frames to controllers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FaultCounts {
    /// Commands that never reached their vehicles.
    pub commands_lost: u64,
    /// Commands that were late, whether or not a newer one overtook them.
    pub commands_delayed: u64,
    /// Commands that a silent controller did not give.
    pub commands_stalled: u64,
    /// Records with noise.
    pub records_noisy: u64,
    /// Records with a bias.
    pub records_biased: u64,
    /// Records that repeated older ones.
    pub records_frozen: u64,
}

/// What the actuation gateway did with the commands of each controller.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ShieldSummary {
    /// Off, observing, or on.
    pub mode: ShieldMode,
    /// Per controller process.
    pub controllers: Vec<ShieldRow>,
}

/// Interventions in one controller's commands; in `observe` mode, those that were called for. A command may
/// count under several reasons: beyond the limits, and then bounded by a margin.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ShieldRow {
    /// Controller name.
    pub controller: String,
    /// Commands looked at: one per vehicle and step.
    pub commands: u64,
    /// Of these, commands that were changed, each counted once whatever changed it.
    pub bounded: u64,
    /// Commands that were no number, replaced by `u_min`.
    pub not_finite: u64,
    /// Commands beyond the vehicle's limits, clamped.
    pub limits: u64,
    /// Commands bounded by the greatest speed.
    pub speed: u64,
    /// Commands bounded by the rear-end margin.
    pub rear_end: u64,
    /// Commands bounded by the merging margin.
    pub merge: u64,
    /// Commands bounded by the crossing margin.
    pub cross: u64,
    /// Times a vehicle was not safe toward a partner when it came to owe it something: not guaranteed.
    pub began_unsafe: u32,
    /// Vehicle-steps that ended unsafe although they were guaranteed; 0 with the shield on.
    pub lost: u32,
    /// Least rear-end margin of guaranteed vehicles at any instant, m.
    pub min_rear_end_margin_m: Option<f64>,
    /// Least merging margin of guaranteed vehicles from the merge on, m.
    pub min_merge_margin_m: Option<f64>,
    /// Least crossing margin of guaranteed vehicles, m.
    pub min_cross_margin_m: Option<f64>,
}

impl ShieldRow {
    pub(super) fn new(controller: String) -> ShieldRow {
        ShieldRow { controller, ..ShieldRow::default() }
    }
}
