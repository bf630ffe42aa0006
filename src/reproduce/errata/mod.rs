//! What is wrong in the paper, each with the numbers that show it.

mod equations;
mod tables;

use super::grid::Grid;
use super::runs::{Run, Runs};
use serde::Serialize;

/// The weight that the paper's tables imply under constant traffic, m^2/s^4.
const BETA: f64 = 2.0 / 3.0;

/// An erratum's name and where it is in the paper.
#[derive(Clone, Copy, Debug)]
pub struct Topic {
    /// What `--only` takes.
    pub id: &'static str,
    /// Labels concerned.
    pub labels: &'static [&'static str],
    /// What is printed.
    pub printed: &'static str,
    /// What is right, and how one knows.
    pub correct: &'static str,
    needs_runs: bool,
    show: fn(&Runs) -> Vec<Grid>,
}

/// All errata.
pub const TOPICS: [Topic; 9] = [
    Topic {
        id: "lost-square",
        labels: &["equ:ucp_vm_5"],
        printed: "β − ½ b + a c = 0",
        correct: "β − ½ b² + a c = 0: the Hamiltonian vanishes along an optimum with free final time. Brute force over T agrees with it; the printed condition adds m²/s⁴ to m/s² and so gives another answer in feet.",
        needs_runs: false,
        show: equations::lost_square,
    },
    Topic {
        id: "cubic",
        labels: &["equ:tm"],
        printed: "β T³ + (2v0+w) T² + (6v0w+6v0²−3L) T − 12Lv0 = 0",
        correct: "β T⁴ − 2(v0²+v0w+w²) T² + 12L(v0+w) T − 18L² = 0: the printed cubic follows correctly from the printed condition, and inherits its misprint.",
        needs_runs: false,
        show: equations::cubic,
    },
    Topic {
        id: "delta-t",
        labels: &["equ:delta_t", "equ:perturb_tm"],
        printed: "ΔT from the cubic's partial derivatives",
        correct: "ΔT = −(g_w/g_T) Δw with the quartic's, polished by Newton; the printed step follows the printed cubic, not the optimum.",
        needs_runs: false,
        show: equations::delta_t,
    },
    Topic {
        id: "derivative-display",
        labels: &["equ:perturb_tm"],
        printed: "∂f/∂t_m = 3β t_m² + (4v0+2v_m) t_m − 3L + 6v0v_m + 6 v_m²",
        correct: "… + 6 v0²: the derivative of equ:tm, and what equ:delta_t uses two displays later.",
        needs_runs: false,
        show: equations::derivative_display,
    },
    Topic {
        id: "phi2",
        labels: &["SafeMerging", "equ:candidate2"],
        printed: "φ₂, never defined",
        correct: "φ₂ = φ/L: b2 = x_c − x − (φ/L) x v − δ is the merging constraint at x = L and vanishes from the start of the zone; only then does the printed row equal L_f b2 + L_g b2 u + k2 b2.",
        needs_runs: false,
        show: equations::phi2,
    },
    Topic {
        id: "alpha-beta",
        labels: &["tab:feedback1", "eqn:energyobj"],
        printed: "α = 0.0625 under constant traffic",
        correct: "every cell of the table implies β = 2/3, that is α = 1/13 = 0.0769; α = 0.0625 gives β = 8/15. The other table is consistent with its α = 0.25.",
        needs_runs: true,
        show: tables::alpha_beta,
    },
    Topic {
        id: "repeated-column",
        labels: &["tab:feedback", "tab:feedback1"],
        printed: "the same time and energy without flow control under both kinds of traffic",
        correct: "traffic and weight differ between the experiments, so the columns cannot agree in three of four entries: one was copied.",
        needs_runs: true,
        show: tables::repeated_column,
    },
    Topic {
        id: "totals",
        labels: &["tab:feedback1", "tab:feedback"],
        printed: "totals that are not CZ1 + CZ2",
        correct: "the sum of two numbers rounded to 0.01 is within 0.015 of the rounded sum; two of the six totals are further off.",
        needs_runs: false,
        show: tables::totals,
    },
    Topic {
        id: "objectives",
        labels: &["tab:feedback1", "tab:feedback", "eqn:energyobj"],
        printed: "obj. = β t + e",
        correct: "checked cell by cell with the β that the column as a whole implies.",
        needs_runs: false,
        show: tables::objectives,
    },
];

/// An erratum with its evidence.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Erratum {
    /// Short name.
    pub id: &'static str,
    /// Labels concerned.
    pub labels: &'static [&'static str],
    /// What is printed.
    pub printed: &'static str,
    /// What is right.
    pub correct: &'static str,
    /// Numbers.
    pub evidence: Vec<Grid>,
}

impl Topic {
    /// The runs v_m2 is measured in.
    pub fn baselines(&self) -> Vec<Run> {
        if self.needs_runs { tables::baselines() } else { Vec::new() }
    }

    /// The runs its numbers need, once its [baselines](Topic::baselines) are performed.
    pub fn runs(&self, runs: &Runs) -> Vec<Run> {
        if self.needs_runs { tables::runs(runs) } else { Vec::new() }
    }

    /// The erratum with its numbers.
    pub fn erratum(&self, runs: &Runs) -> Erratum {
        let Topic { id, labels, printed, correct, .. } = *self;
        Erratum { id, labels, printed, correct, evidence: (self.show)(runs) }
    }
}
