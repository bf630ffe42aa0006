//! Flow control: the terminal speed v_m of a zone from what its downstream neighbour reports
//! (paper: section "Problem 2", `equ:feedback_control`).

mod predicted;

use crate::control::Terminal;
use crate::control::ocbf::mean_optimal_terminal_speed_mps;
use crate::scenario::{Baseline, Exit, FlowPolicy, Observed, Scenario, Zone};
use ipc_schemas::{VehicleState, ZoneSummary};
use predicted::Prediction;

/// One exit's policy, ready to be evaluated at events.
#[derive(Clone, Debug)]
pub struct FlowController {
    policy: FlowPolicy,
    /// v_b of a feedback policy, given or computed, m/s.
    baseline_mps: f64,
    v_max_mps: f64,
    prediction: Option<Prediction>,
}

/// Length of the downstream segment a policy observes, m (0 when it observes none).
pub fn segment_m(policy: &FlowPolicy) -> f64 {
    match policy {
        FlowPolicy::Feedback { segment: Observed::First(l), .. } => *l,
        FlowPolicy::MeanSpeed { segment_m, .. } => *segment_m,
        _ => 0.0,
    }
}

impl FlowController {
    /// The controller of an exit of a zone; a computed baseline is computed here, once.
    pub fn new(scenario: &Scenario, zone: &Zone, exit: &Exit) -> FlowController {
        let baseline_mps = match &exit.flow {
            FlowPolicy::Feedback { baseline: Baseline::Given(speed), .. } => *speed,
            FlowPolicy::Feedback { baseline: Baseline::Optimal(entry_speeds), .. } => {
                let total_m = zone.paths.iter().map(|path| path.length_m).sum::<f64>();
                let mean_length_m = total_m / zone.paths.len() as f64;
                mean_optimal_terminal_speed_mps(scenario, mean_length_m, entry_speeds)
            }
            _ => 0.0,
        };
        let prediction = match exit.flow {
            FlowPolicy::Predicted { min_mps } => Some(Prediction::new(scenario, zone, exit, min_mps)),
            _ => None,
        };
        let v_max_mps = scenario.vehicle.v_max_mps;
        FlowController { policy: exit.flow.clone(), baseline_mps, v_max_mps, prediction }
    }

    /// The terminal condition, given the zone's members and the last summary of the downstream zone (none before its
    /// first event, when it is empty).
    pub fn terminal(&self, members: &[VehicleState], downstream: Option<&ZoneSummary>) -> Terminal {
        match &self.policy {
            FlowPolicy::None => Terminal::Free,
            FlowPolicy::Predicted { .. } => {
                self.prediction.as_ref().map_or(Terminal::Free, |p| p.terminal(members, downstream))
            }
            FlowPolicy::Fixed { terminal_mps } => Terminal::Speed(*terminal_mps),
            FlowPolicy::Feedback { gain_mps, segment, min_mps, .. } => {
                let count = downstream.map_or(0, |s| match segment {
                    Observed::Whole => s.vehicles,
                    Observed::First(_) => s.segment_vehicles,
                });
                let speed = self.baseline_mps - gain_mps * f64::from(count);
                Terminal::Speed(speed.max(*min_mps).min(self.v_max_mps))
            }
            FlowPolicy::MeanSpeed { offset_mps, gain_mps, min_mps, .. } => match downstream {
                Some(s) if s.segment_vehicles > 0 => {
                    let speed =
                        s.segment_mean_speed_mps + offset_mps - gain_mps * f64::from(s.segment_vehicles);
                    Terminal::Speed(speed.max(*min_mps).min(self.v_max_mps))
                }
                // Nobody there to measure a speed of, nobody to be careful of.
                _ => Terminal::Free,
            },
        }
    }
}
