//! Every label of the paper and the functions that implement it, both ways.

use super::grid::Grid;

/// A label and its code: `file` relative to `src/`, item as `fn`, method or type name.
#[derive(Clone, Copy, Debug)]
pub struct Mapping {
    /// Label in the paper.
    pub label: &'static str,
    /// What it stands for.
    pub what: &'static str,
    /// (file, item) pairs; the first is where to start reading.
    pub code: &'static [(&'static str, &'static str)],
}

const fn map(
    label: &'static str,
    what: &'static str,
    code: &'static [(&'static str, &'static str)],
) -> Mapping {
    Mapping { label, what, code }
}

/// The whole paper, in its order.
pub const EQUATIONS: [Mapping; 37] = [
    map(
        "fig:module_CZ",
        "the two-zone network",
        &[("scenario/network.rs", "Network"), ("scenario/embedded.rs", "SCENARIOS")],
    ),
    map(
        "modelF",
        "one zone: passing order, index 0, partners",
        &[("conflict/duties.rs", "derive"), ("world/role.rs", "ZoneState")],
    ),
    map(
        "VehicleDynamics",
        "double integrator under a held command, exact",
        &[
            ("vehicle/held.rs", "position_m"),
            ("vehicle/held.rs", "speed_mps"),
            ("vehicle/held.rs", "passes_m"),
            ("world/integrate.rs", "integrate"),
        ],
    ),
    map(
        "Safety",
        "rear-end safety b1 and its row",
        &[("vehicle/safety.rs", "RearEnd"), ("vehicle/held.rs", "least_margin_m")],
    ),
    map(
        "SafeMerging",
        "merging safety b2 and its row, φ₂ = φ/L",
        &[("vehicle/safety.rs", "Merge"), ("world/integrate.rs", "cross")],
    ),
    map(
        "VehicleConstraints",
        "limits of acceleration, and of speed as barrier rows",
        &[
            ("control/rows.rs", "limits"),
            ("control/ocbf.rs", "rows"),
            ("scenario/params.rs", "VehicleParams"),
        ],
    ),
    map("equ:vm", "terminal speed", &[("control/reference.rs", "Terminal")]),
    map("eqn:energyobja", "the weight α", &[("scenario/load/sections.rs", "beta")]),
    map(
        "eqn:energyobj",
        "cost β t + ∫½u²",
        &[("control/reference.rs", "cost"), ("vehicle/held.rs", "energy"), ("world/metrics.rs", "row")],
    ),
    map(
        "equ:upper",
        "mean objective of a zone: what policies are judged by",
        &[("world/metrics.rs", "ZoneMetrics"), ("reproduce/runs.rs", "total")],
    ),
    map("fig:diagram", "FE mode, reference, tracking controller", &[("control/ocbf.rs", "decide")]),
    map("equ:uc_u", "reference acceleration", &[("control/reference.rs", "acceleration_mps2")]),
    map("equ:uc_v", "reference speed", &[("control/reference.rs", "speed_mps")]),
    map("equ:uc_x", "reference position", &[("control/reference.rs", "distance_m")]),
    map("equ:ucp_vm_1", "entry speed of the reference", &[("control/ocbf.rs", "new_plan")]),
    map("equ:ucp_vm_2", "terminal speed of the reference", &[("control/reference.rs", "coefficients")]),
    map("equ:ucp_vm_4", "terminal position of the reference", &[("control/reference.rs", "coefficients")]),
    map(
        "equ:ucp_vm_5",
        "transversality, β − ½b² + ac = 0 (misprinted)",
        &[("control/reference.rs", "quartic"), ("reproduce/errata/equations.rs", "lost_square")],
    ),
    map(
        "equ:cbf",
        "barrier rows",
        &[("control/ocbf.rs", "rows"), ("vehicle/safety.rs", "row"), ("vehicle/safety.rs", "sampled_row")],
    ),
    map("equ:clf", "CLF row", &[("control/qp.rs", "objective"), ("control/clarabel.rs", "solve")]),
    map("equ:ocbf", "tracking problem over the whole zone, step by step", &[("control/ocbf.rs", "decide")]),
    map("equ:ocbf_qp", "QP of a step", &[("control/qp.rs", "solve"), ("control/clarabel.rs", "solve")]),
    map(
        "equ:candidate",
        "feasibility row of the rear-end row",
        &[
            ("vehicle/safety.rs", "feasibility_row"),
            ("vehicle/safety.rs", "reserve_mps"),
            ("control/ocbf.rs", "entry_conditions_hold"),
        ],
    ),
    map(
        "equ:candidate2",
        "feasibility row of the merging row",
        &[
            ("vehicle/safety.rs", "feasibility_row"),
            ("vehicle/safety.rs", "reserve_mps"),
            ("control/ocbf.rs", "entry_conditions_hold"),
        ],
    ),
    map(
        "sec:flow_control",
        "flow control at events",
        &[("coordination/coordinator.rs", "act"), ("coordination/flow.rs", "FlowController")],
    ),
    map(
        "equ:feedback_control",
        "feedback on the vehicles downstream",
        &[
            ("coordination/flow.rs", "terminal"),
            ("coordination/summaries.rs", "summarise"),
            ("control/ocbf.rs", "mean_optimal_terminal_speed_mps"),
            ("control/reference.rs", "optimal_terminal_speed_mps"),
        ],
    ),
    map("equ:ucp_shift_vm_1", "time counted from the entry", &[("control/reference.rs", "Reference")]),
    map(
        "equ:ucp_shift_vm_4",
        "terminal position, time counted from the entry",
        &[("control/reference.rs", "coefficients")],
    ),
    map(
        "equ:tm",
        "duration: the printed cubic and the quartic that replaces it",
        &[
            ("control/reference.rs", "printed_duration"),
            ("control/reference.rs", "quartic"),
            ("reproduce/errata/equations.rs", "cubic"),
        ],
    ),
    map(
        "equ:perturb_tm",
        "first-order change of the duration",
        &[("control/reference.rs", "perturb"), ("reproduce/errata/equations.rs", "derivative_display")],
    ),
    map(
        "equ:delta_t",
        "ΔT for a change of terminal speed",
        &[("control/reference.rs", "perturb"), ("reproduce/errata/equations.rs", "delta_t")],
    ),
    map("equ:ucp_vm_tm", "coefficients for a given duration", &[("control/reference.rs", "coefficients")]),
    map(
        "fig:diff_v",
        "sweep of fixed v_m1",
        &[("reproduce/tables.rs", "sweep_curves"), ("reproduce/figures.rs", "sweep")],
    ),
    map("tab:fem_time", "feasibility table", &[("reproduce/tables.rs", "feasibility")]),
    map("tab:feedback1", "comparison under constant traffic", &[("reproduce/tables.rs", "performance")]),
    map(
        "fig:rate",
        "objective over time under varying traffic",
        &[("reproduce/tables.rs", "rate_curves"), ("reproduce/figures.rs", "rate")],
    ),
    map("tab:feedback", "comparison under varying traffic", &[("reproduce/tables.rs", "performance")]),
];

/// From label to code.
pub fn forward() -> Grid {
    let mut grid = Grid::new("From the paper to the code", ["label", "what", "code"]);
    for m in &EQUATIONS {
        let code: Vec<String> = m.code.iter().map(|c| path(*c)).collect();
        grid.row([format!("`{}`", m.label).into(), m.what.into(), code.join(", ").into()]);
    }
    grid
}

/// From code to labels.
pub fn backward() -> Grid {
    let mut items: Vec<_> =
        EQUATIONS.iter().flat_map(|m| m.code.iter().map(move |c| (*c, m.label))).collect();
    items.sort_by_key(|(code, _)| *code);
    let mut grid = Grid::new("From the code to the paper", ["code", "labels"]);
    for group in items.chunk_by(|a, b| a.0 == b.0) {
        let labels: Vec<String> = group.iter().map(|(_, label)| format!("`{label}`")).collect();
        grid.row([path(group[0].0).into(), labels.join(", ").into()]);
    }
    grid
}

/// `control::reference::perturb` of ("control/reference.rs", "perturb").
fn path((file, item): (&str, &str)) -> String {
    format!("`{}::{item}`", file.trim_end_matches(".rs").replace('/', "::"))
}
