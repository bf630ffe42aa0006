//! Test vectors of the paper's law, for authors who check their numbers.

use crate::conflict::DutyKind;
use crate::control::Terminal;
use crate::control::reference::Problem;
use crate::control::{Law, Memory, Mode, Ocbf, Partner, Situation};
use crate::scenario::{ReferenceLaw, load_embedded};
use serde_json::{Value, json};

/// The vectors as JSON: plans, and whole decisions under the parameters of the paper's setting.
pub(super) fn text() -> String {
    let vectors = json!({
        "about": "plans: corrected transversality condition; decisions: parameters of the scenario paper, \
                  vehicles in OCBF mode without a plan yet; SI units",
        "plans": plans(),
        "decisions": decisions(),
    });
    serde_json::to_string_pretty(&vectors).expect("JSON values have string keys") + "\n"
}

fn plans() -> Vec<Value> {
    let mut vectors = Vec::new();
    for (v0, length_m, beta) in [(14.0, 200.0, 2.0 / 3.0), (20.0, 200.0, 8.0 / 3.0), (8.0, 350.0, 8.0 / 15.0)]
    {
        for terminal in [Terminal::Free, Terminal::Speed(12.0), Terminal::Speed(18.5)] {
            let problem = Problem { beta, v0_mps: v0, length_m, terminal };
            let optimum = problem.solve_forward(ReferenceLaw::Corrected);
            vectors.push(json!({
                "v0": v0, "length": length_m, "beta": beta,
                "terminal": match terminal { Terminal::Free => Value::Null, Terminal::Speed(w) => json!(w) },
                "T": optimum.duration_s, "a": optimum.a, "b": optimum.b, "cost": optimum.cost(beta),
            }));
        }
    }
    vectors
}

fn decisions() -> Vec<Value> {
    let scenario = load_embedded("paper", &[], None).expect("the embedded scenario is valid");
    let law = Ocbf::new(&scenario);
    let mut vectors = Vec::new();
    for (x_m, v_mps) in [(10.0, 16.0), (60.0, 18.0), (120.0, 15.0), (180.0, 19.0)] {
        for partner in [None, Some((DutyKind::RearEnd, 32.0)), Some((DutyKind::Merge, 26.0))] {
            let s = Situation {
                time_s: 10.0,
                x_m,
                v_mps,
                entry_time_s: 10.0 - x_m / 16.0,
                entry_speed_mps: 16.0,
                length_m: 200.0,
                terminal: Terminal::Speed(18.5),
                schedule: None,
                kind: 0,
            };
            let partner = partner.map(|(kind, gap)| Partner {
                conflict_m: 200.0,
                gap_m: scenario.vehicle.standstill_gap_m,
                ..Partner::unplanned(kind, x_m + gap, 15.5, -0.5)
            });
            let mut memory = Memory { mode: Mode::Ocbf, plan: None }.words();
            let decision = law.decide(&s, partner.into_iter(), &mut memory);
            vectors.push(json!({
                "time": s.time_s, "x": x_m, "v": v_mps, "entry_time": s.entry_time_s,
                "entry_speed": s.entry_speed_mps, "length": s.length_m, "terminal": 18.5,
                "partner": partner.map(|p| json!({
                    "kind": if p.kind == DutyKind::RearEnd { "rear_end" } else { "merge" },
                    "x": p.x_m, "v": p.v_mps, "u": p.u_mps2,
                })),
                "u": decision.u_mps2,
            }));
        }
    }
    vectors
}
