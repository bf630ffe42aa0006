//! A terminal speed chosen by prediction (paper: Problem 2, `equ:upper`).
//!
//! For each speed on a grid the zone's vehicles are foretold through it and through the zone downstream: here the
//! reference to the terminal speed, there the optimum from that speed; in both, nobody leaves sooner than
//! `phi + delta / v` behind the one before. Downstream the vehicles that are there leave first, one such headway apart. The
//! speed of the least mean objective is taken, the greatest of equals.

use crate::control::Terminal;
use crate::control::reference::Problem;
use crate::coordination::schedule::cost::{Cost, Single};
use crate::coordination::schedule::pooling::best_s;
use crate::scenario::{Exit, ReferenceLaw, Scenario, Zone};
use ipc_schemas::{VehicleState, ZoneSummary};

/// Distance between the speeds that are tried, m/s.
const GRID_MPS: f64 = 0.5;
/// Ways left that are shorter are not foretold, m.
const LEAST_M: f64 = 1.0;

/// What a prediction knows beside who is there.
#[derive(Clone, Debug)]
pub(super) struct Prediction {
    beta: f64,
    law: ReferenceLaw,
    reaction_s: f64,
    gap_m: f64,
    v_max_mps: f64,
    min_mps: f64,
    /// Length of each path that leads to the exit, m; infinite for others.
    lengths_m: Vec<f64>,
    /// Length of the way through the zone downstream, m: its longest path, and the link to it.
    downstream_m: f64,
}

impl Prediction {
    pub(super) fn new(scenario: &Scenario, zone: &Zone, exit: &Exit, min_mps: f64) -> Prediction {
        let own = zone.exits.iter().position(|other| other.name == exit.name);
        let leads = |exit: u32| own == Some(exit as usize);
        let lengths_m =
            zone.paths.iter().map(|path| if leads(path.exit) { path.length_m } else { f64::INFINITY });
        let to = exit.to.map(|to| scenario.network.zones[to.zone as usize].longest_m() + to.link_m);
        Prediction {
            beta: scenario.beta,
            law: scenario.control.reference,
            reaction_s: scenario.vehicle.reaction_time_s,
            gap_m: scenario.vehicle.standstill_gap_m,
            v_max_mps: scenario.vehicle.v_max_mps,
            min_mps,
            lengths_m: lengths_m.collect(),
            downstream_m: to.unwrap_or(0.0),
        }
    }

    /// The best terminal speed for the members of a zone; free when none of them leaves by this exit.
    pub(super) fn terminal(&self, members: &[VehicleState], downstream: Option<&ZoneSummary>) -> Terminal {
        let own = || members.iter().filter(|state| self.lengths_m[state.path as usize].is_finite());
        if own().next().is_none() {
            return Terminal::Free;
        }
        let ahead = f64::from(downstream.map_or(0, |summary| summary.vehicles));
        let speeds = ((self.v_max_mps - self.min_mps) / GRID_MPS) as u32;
        let (mut best_mps, mut least) = (self.v_max_mps, f64::INFINITY);
        for at in 0..=speeds {
            let speed_mps = self.v_max_mps - GRID_MPS * f64::from(at);
            let cost = self.cost(own(), speed_mps, ahead);
            if cost < least {
                (best_mps, least) = (speed_mps, cost);
            }
        }
        Terminal::Speed(best_mps)
    }

    /// What vehicles that leave with this speed cost in all, here and downstream.
    fn cost<'a>(&self, own: impl Iterator<Item = &'a VehicleState>, speed_mps: f64, ahead: f64) -> f64 {
        let headway_s = self.reaction_s + self.gap_m / speed_mps;
        let next = Cost::Single(Single { beta: self.beta, left_m: self.downstream_m, v_mps: speed_mps });
        let crossing_s = best_s(&next);
        let (mut left_s, mut out_s) = (f64::NEG_INFINITY, headway_s * ahead);
        let mut total = 0.0;
        for state in own {
            let length_m = (self.lengths_m[state.path as usize] - state.x_m).max(LEAST_M);
            let terminal = Terminal::Speed(speed_mps);
            let problem = Problem { beta: self.beta, v0_mps: state.v_mps.max(0.0), length_m, terminal };
            let alone_s = problem.solve_forward(self.law).duration_s;
            left_s = alone_s.max(left_s + headway_s);
            total += problem.coefficients(left_s).cost(self.beta);
            out_s = (left_s + crossing_s).max(out_s + headway_s);
            total += next.value(out_s - left_s);
        }
        total
    }
}
