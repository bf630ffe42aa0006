//! What the paper leaves unsaid, varied: which choice moves which claim, and which setting comes closest.
//!
//! Everything here is on the seeded process, with fewer replicates than the tables. A choice *moves* a
//! claim when the 95 % interval of the paired change of its effect, same arrivals where the choice leaves
//! them the same, excludes zero. With this many comparisons one in twenty of the small ones is chance.

mod closest;

use super::ReproduceError;
use super::claims::{CLAIMS, Claim, Verdict, judge};
use super::experiment::{Demand, FIXED, Policy, ROADS, Setting, Traffic};
use super::grid::{Entry, Grid, number};
use super::paper::SECOND_TERMINAL_MPS;
use super::runs::{Progress, Run, Runs};
use super::statistics::Interval;
use closest::{cell_runs, closest_grids, search};
use serde::Serialize;
use std::collections::BTreeSet;

/// Replicates of the one-at-a-time part at most; `--seeds` may ask for fewer.
const MOST_REPLICATES: u64 = 4;
/// Replicates of the design and of the search.
const FEW_REPLICATES: u64 = 3;
/// Fixed speeds of the coarser sweep, m/s.
const SPEEDS: [f64; 6] = [12.0, 14.0, 15.0, 16.0, 18.0, 20.0];

/// A choice the paper does not state, with levels other than ours.
struct Choice {
    name: &'static str,
    ours: &'static str,
    levels: Vec<Level>,
}

/// A level other than ours.
struct Level {
    name: String,
    sets: Vec<String>,
    /// v_m2 where it is given, m/s.
    second_mps: Option<f64>,
}

impl Level {
    fn new((name, sets): (String, Vec<String>)) -> Level {
        Level { name, sets, second_mps: None }
    }
}

fn choice(name: &'static str, ours: &'static str, levels: &[(&str, &[&str])]) -> Choice {
    let level = |&(name, sets): &(&str, &[&str])| {
        Level::new((name.to_owned(), sets.iter().map(|s| (*s).to_owned()).collect()))
    };
    Choice { name, ours, levels: levels.iter().map(level).collect() }
}

/// The same key for every road's demand.
fn demand(key: &str, value: f64) -> Vec<String> {
    ROADS.map(|road| format!("roads.{road}.demand.{key}={value:?}")).into()
}

/// Entry speeds around another mean, the same spread.
fn entry_speed(mean: f64) -> (String, Vec<String>) {
    let sets = [("speed_mean_mps", mean), ("speed_min_mps", mean - 6.0), ("speed_max_mps", mean + 6.0)];
    (format!("{mean}"), sets.iter().flat_map(|(key, value)| demand(key, *value)).collect())
}

fn choices() -> Vec<Choice> {
    let headway = |h: f64| Level::new((format!("{h}"), demand("min_headway_s", h)));
    let printed =
        Level { name: format!("{SECOND_TERMINAL_MPS}"), sets: vec![], second_mps: Some(SECOND_TERMINAL_MPS) };
    vec![
        choice("Δt, s", "0.1", &[("0.05", &["dt_s=0.05"]), ("0.2", &["dt_s=0.2"])]),
        choice(
            "k1, 1/s",
            "1",
            &[("0.5", &["control.k_rear_end_per_s=0.5"]), ("2", &["control.k_rear_end_per_s=2.0"])],
        ),
        choice(
            "k2, 1/s",
            "1",
            &[("0.5", &["control.k_merge_per_s=0.5"]), ("2", &["control.k_merge_per_s=2.0"])],
        ),
        choice(
            "ε, 1/s",
            "10",
            &[("1", &["control.clf_rate_per_s=1.0"]), ("100", &["control.clf_rate_per_s=100.0"])],
        ),
        choice(
            "λ",
            "β",
            &[
                ("0.05", &["control.slack_weight=0.05"]),
                ("10", &["control.slack_weight=10.0"]),
                ("no CLF row", &["control.clf=false"]),
            ],
        ),
        Choice {
            name: "entry speed, m/s",
            ours: "16",
            levels: [13.0, 18.0, 20.0].map(entry_speed).map(Level::new).into(),
        },
        Choice { name: "least headway, s", ours: "1.2", levels: [0.6, 1.8, 2.4].map(headway).into() },
        choice(
            "FE conditions",
            "full",
            &[
                ("barriers only", &["control.fe_conditions=barrier"]),
                ("no FE mode", &["control.fe_conditions=off"]),
            ],
        ),
        choice("feasibility rows", "on", &[("off", &["control.feasibility_rows=false"])]),
        choice("re-planning", "from_entry", &[("from_state", &["control.replan=from_state"])]),
        choice("position feedback", "approximate", &[("exact", &["control.position_feedback=exact"])]),
        choice("safety rows", "continuous", &[("sampled", &["control.safety_rows=sampled"])]),
        Choice { name: "v_m2, m/s", ours: "mean exit speed without flow control", levels: vec![printed] },
        choice("reference", "corrected", &[("as printed", &["control.reference=as_printed"])]),
    ]
}

/// Effect of a claim under a setting.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SettingEffect {
    /// Claim.
    pub claim: &'static str,
    /// Its effect.
    pub effect: Option<Interval>,
    /// Its verdict.
    pub verdict: Verdict,
    /// Paired change against our setting.
    pub change: Option<Interval>,
    /// Whether the change's interval excludes zero.
    pub moves: bool,
}

/// One setting of the one-at-a-time part.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SettingRow {
    /// Choice.
    pub choice: &'static str,
    /// Level.
    pub level: String,
    /// `--set`s.
    pub sets: Vec<String>,
    /// v_m2 under constant and under varying traffic, m/s.
    pub second_mps: [Option<f64>; 2],
    /// Runs in which traffic came to a standstill; claims that need one of them are undecided.
    pub jammed: usize,
    /// Per claim.
    pub effects: Vec<SettingEffect>,
}

/// The setting closest to the paper's tables.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Closest {
    /// `--set`s of the setting, on the seeded process.
    pub sets: Vec<String>,
    /// Root mean square relative deviation over the 16 cells, ours and closest.
    pub deviation: (f64, f64),
    /// Settings tried.
    pub tried: usize,
    /// Claims under it.
    pub effects: Vec<SettingEffect>,
}

/// All of it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Sensitivity {
    /// Replicates of the one-at-a-time part.
    pub replicates: u64,
    /// One at a time; the first is our own setting.
    pub settings: Vec<SettingRow>,
    /// The search.
    pub closest: Closest,
    /// Tables.
    pub grids: Vec<Grid>,
}

/// A claim's effect, replicate by replicate.
type PerReplicate = Vec<Option<f64>>;

fn seeded(sets: Vec<String>) -> Setting {
    Setting::new(Demand::Seeded, sets)
}

const TRAFFICS: [Traffic; 2] = [Traffic::Constant, Traffic::Varying];

/// Runs everything.
pub fn analyse(
    runs: &mut Runs,
    seeds: u64,
    progress: &mut Progress<'_>,
) -> Result<Sensitivity, ReproduceError> {
    let (replicates, few) = (seeds.min(MOST_REPLICATES), seeds.min(FEW_REPLICATES));
    let choices = choices();
    let mut names = vec![("ours", "")];
    let mut settings = vec![seeded(Vec::new())];
    for (choice, level) in choices.iter().flat_map(|c| c.levels.iter().map(move |l| (c.name, l))) {
        names.push((choice, &level.name));
        let setting = seeded(level.sets.clone());
        settings.push(level.second_mps.map_or(setting.clone(), |second| setting.with_second(second)));
    }
    let settings = Setting::settle(settings, &TRAFFICS, replicates, runs, progress)?;
    let needs = |setting: &Setting, n: u64| -> Vec<Run> {
        let of = |seed| CLAIMS.iter().flat_map(move |c| c.runs(&setting.replicate(seed), &SPEEDS));
        (1..=n).flat_map(of).collect()
    };
    let points = design_points().into_iter().map(seeded).collect();
    let points = Setting::settle(points, &[Traffic::Constant], few, runs, progress)?;
    let mut wanted: Vec<Run> = settings.iter().flat_map(|s| needs(s, replicates)).collect();
    wanted.extend(points.iter().flat_map(|s| cell_runs(s, few)));
    wanted.extend(solver_runs(&settings[0]));
    runs.perform(wanted, progress)?;

    let ours = effects_by_replicate(runs, &settings[0], replicates);
    let row = |(&(choice, level), setting): (&(&'static str, &str), &Setting)| SettingRow {
        choice,
        level: level.to_owned(),
        sets: setting.sets.clone(),
        second_mps: setting.second_mps,
        jammed: needs(setting, replicates)
            .into_iter()
            .collect::<BTreeSet<Run>>()
            .iter()
            .filter(|run| !runs.outcome(run).complete)
            .count(),
        effects: effects(runs, setting, replicates, &ours),
    };
    let rows: Vec<SettingRow> = names.iter().zip(&settings).map(row).collect();
    let mut grids = vec![one_at_a_time_grid(&rows, &choices), movers_grid(&rows)];
    grids.push(design_grid(runs, &points, few));
    grids.push(solver_grid(runs, &settings[0]));

    let found = search(runs, few, progress)?;
    let closest = vec![seeded(found.setting.sets.clone())];
    let closest = Setting::settle(closest, &TRAFFICS, replicates, runs, progress)?.remove(0);
    runs.perform(needs(&closest, replicates), progress)?;
    let closest = Closest {
        effects: effects(runs, &closest, replicates, &ours),
        sets: closest.sets,
        deviation: found.deviation,
        tried: found.tried,
    };
    grids.extend(closest_grids(runs, &closest, &found, few));
    Ok(Sensitivity { replicates, settings: rows, closest, grids })
}

fn effects_by_replicate(runs: &Runs, setting: &Setting, n: u64) -> Vec<PerReplicate> {
    let of =
        |claim: &Claim| (1..=n).map(|seed| claim.effect(runs, &setting.replicate(seed), &SPEEDS)).collect();
    CLAIMS.iter().map(of).collect()
}

fn effects(runs: &Runs, setting: &Setting, n: u64, ours: &[PerReplicate]) -> Vec<SettingEffect> {
    let here = effects_by_replicate(runs, setting, n);
    let each = |((claim, here), ours): ((&Claim, PerReplicate), &PerReplicate)| {
        let effect = here.iter().copied().collect::<Option<Vec<f64>>>().and_then(|e| Interval::of(&e));
        let change: Option<Vec<f64>> = here.iter().zip(ours).map(|(a, b)| Some((*a)? - (*b)?)).collect();
        let change = change.and_then(|c| Interval::of(&c));
        SettingEffect {
            claim: claim.id,
            effect,
            verdict: judge(claim.expectation, effect.as_ref()),
            change,
            moves: change.is_some_and(|c| !c.meets(0.0, 0.0)),
        }
    };
    CLAIMS.iter().zip(here).zip(ours).map(each).collect()
}

fn mark(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Holds => "✓",
        Verdict::HoldsInDirection => "~",
        Verdict::DoesNotHold => "✗",
        Verdict::Undecided => "?",
    }
}

fn one_at_a_time_grid(settings: &[SettingRow], choices: &[Choice]) -> Grid {
    let columns = ["choice", "level", "jammed runs"].into_iter().chain(CLAIMS.iter().map(|c| c.id));
    let mut grid = Grid::new(
        "One at a time: effect and verdict of each claim (✓ holds, ~ in direction, ✗ does not hold, ? undecided; * moved)",
        columns,
    );
    for setting in settings {
        let ours = choices.iter().find(|c| c.name == setting.choice).map(|c| c.ours);
        let level = ours.map_or(setting.level.clone(), |o| format!("{} (ours {o})", setting.level));
        let cell = |e: &SettingEffect| {
            let effect = e.effect.map_or("–".to_owned(), |i| number(i.mean, 2).show());
            let moved = if e.moves { " *" } else { "" };
            Entry::from(format!("{effect} {}{moved}", mark(e.verdict)))
        };
        grid.row(
            [setting.choice.into(), level.into(), number(setting.jammed as f64, 0)]
                .into_iter()
                .chain(setting.effects.iter().map(cell)),
        );
    }
    grid
}

fn movers_grid(settings: &[SettingRow]) -> Grid {
    let mut grid = Grid::new(
        "Which choice moves which claim",
        ["claim", "ours", "verdict changes under", "largest significant changes of the effect"],
    );
    let (ours, others) = settings.split_first().expect("our own setting comes first");
    for (i, claim) in CLAIMS.iter().enumerate() {
        let name = |s: &SettingRow| format!("{} {}", s.choice, s.level);
        let verdict = ours.effects[i].verdict;
        let turned: Vec<String> = others
            .iter()
            .filter(|s| s.effects[i].verdict != verdict)
            .map(|s| format!("{} ({})", name(s), s.effects[i].verdict.words()))
            .collect();
        let mut movers: Vec<(f64, String)> = others
            .iter()
            .filter(|s| s.effects[i].moves)
            .filter_map(|s| Some((s.effects[i].change?.mean, name(s))))
            .collect();
        movers.sort_by(|a, b| b.0.abs().total_cmp(&a.0.abs()));
        let movers: Vec<String> = movers.iter().take(4).map(|(c, n)| format!("{n}: {c:+.2}")).collect();
        let or_none =
            |list: Vec<String>| if list.is_empty() { "nothing".to_owned() } else { list.join("; ") };
        grid.row([claim.id.into(), verdict.words().into(), or_none(turned).into(), or_none(movers).into()]);
    }
    grid
}

/// Factors of the small design: name, `--set`s of the other level.
fn factors() -> [(&'static str, Vec<String>); 5] {
    let set = |s: &str| vec![s.to_owned()];
    [
        ("entry speed 16 → 19", entry_speed(19.0).1),
        ("FE conditions full → barriers", set("control.fe_conditions=barrier")),
        ("feasibility rows on → off", set("control.feasibility_rows=false")),
        (
            "k1, k2 1 → 0.5",
            ["control.k_rear_end_per_s=0.5", "control.k_merge_per_s=0.5"].map(str::to_owned).into(),
        ),
        ("re-planning entry → state", set("control.replan=from_state")),
    ]
}

/// All 32 combinations; bit i of the index is factor i.
fn design_points() -> Vec<Vec<String>> {
    let factors = factors();
    let point = |bits: usize| -> Vec<String> {
        let on = factors.iter().enumerate().filter(|(i, _)| bits >> i & 1 == 1);
        on.flat_map(|(_, (_, sets))| sets.clone()).collect()
    };
    (0..1 << factors.len()).map(point).collect()
}

/// Main effects and two-factor interactions.
fn design_grid(runs: &Runs, points: &[Setting], n: u64) -> Grid {
    const RESPONSES: [&str; 5] =
        ["fixed-15-percent", "feedback-15-percent", "feedback-like-fixed", "fe-count", "fe-time"];
    let responses = RESPONSES.map(|id| CLAIMS.iter().find(|c| c.id == id).expect("a claim of that name"));
    let mut grid = Grid::new(
        "Full factorial of five choices: mean change of the effects, percentage points ± 95 %",
        ["factor or interaction"].into_iter().chain(RESPONSES),
    );
    // Contrast of the points whose sign is the product of the factors in `mask`.
    let contrast = |claim: &Claim, mask: usize| {
        let per_replicate = (1..=n).map(|seed| {
            let signed = points.iter().enumerate().map(|(bits, setting)| {
                let sign = if (bits & mask).count_ones() % 2 == mask.count_ones() % 2 { 1.0 } else { -1.0 };
                Some(sign * claim.effect(runs, &setting.replicate(seed), &SPEEDS)?)
            });
            Some(signed.sum::<Option<f64>>()? / (points.len() / 2) as f64)
        });
        per_replicate.collect::<Option<Vec<f64>>>().and_then(|c| Interval::of(&c))
    };
    let factors = factors();
    let mut masks: Vec<(String, usize)> =
        factors.iter().enumerate().map(|(i, (name, _))| ((*name).to_owned(), 1 << i)).collect();
    for i in 0..factors.len() {
        for j in 0..i {
            masks.push((format!("{} × {}", factors[j].0, factors[i].0), 1 << i | 1 << j));
        }
    }
    for (name, mask) in masks {
        let cells = responses.map(|claim| Entry::from(contrast(claim, mask)));
        grid.row([name.into()].into_iter().chain(cells));
    }
    grid
}

/// The shortened runs on which both solvers are compared.
fn solver_runs(ours: &Setting) -> Vec<Run> {
    ["closed_form", "clarabel"]
        .into_iter()
        .flat_map(|solver| [Policy::None, FIXED, Policy::Feedback].map(|p| solver_run(ours, solver, p)))
        .collect()
}

fn solver_run(ours: &Setting, solver: &str, policy: Policy) -> Run {
    let sets = vec!["end.vehicles=12".to_owned(), format!("control.solver={solver}")];
    Setting { sets, ..ours.clone() }.replicate(1).run(Traffic::Constant, policy)
}

fn solver_grid(runs: &Runs, ours: &Setting) -> Grid {
    let mut grid = Grid::new(
        "Solver, first 12 vehicles of seed 1: total objective",
        ["policy", "closed form", "Clarabel", "difference"],
    );
    for (name, policy) in [("none", Policy::None), ("fixed 15", FIXED), ("feedback", Policy::Feedback)] {
        let [a, b] = ["closed_form", "clarabel"].map(|s| runs.outcome(&solver_run(ours, s, policy)).total());
        grid.row([name.into(), number(a, 6), number(b, 6), format!("{:.1e}", b - a).into()]);
    }
    grid
}
