//! The report as Markdown, and its tables for the terminal.

use super::claims::{ClaimRow, Expectation, Verdict};
use super::experiment::Variant;
use super::grid::{Entry, Grid, number};
use super::optimality::{self, BOUND_PERCENT};
use super::{Report, equations};
use std::fmt::Write as _;

/// The verdict table.
pub fn verdicts(claims: &[ClaimRow]) -> Grid {
    let variants = Variant::ALL.map(|v| v.name());
    let columns = ["claim", "of", "printed"].map(str::to_owned).into_iter().chain(variants);
    let mut grid = Grid::new("Verdicts: effect ± 95 % and verdict", columns);
    for claim in claims {
        let printed = match claim.expectation {
            Expectation::Value { printed, tolerance } => format!("{printed} ± {tolerance} {}", claim.unit),
            Expectation::Positive => "> 0".to_owned(),
            Expectation::Zero { tolerance } => format!("0 ± {tolerance} {}", claim.unit),
            Expectation::Location { printed, tolerance, .. } => {
                format!("{printed} ± {tolerance} {}", claim.unit)
            }
            Expectation::AtLeast(bound) => format!("≥ {bound}"),
        };
        let cells = claim.verdicts.iter().map(|j| {
            let effect = j.effect.map_or("–".to_owned(), |i| Entry::Interval(i).show());
            Entry::from(format!("{} ({effect})", j.verdict.words()))
        });
        grid.row([claim.text.into(), claim.label.into(), printed.into()].into_iter().chain(cells));
    }
    grid
}

/// Every table of the report, in order, for the terminal; the verdicts last, where they are read.
pub fn terminal(report: &Report) -> String {
    let mut out = String::new();
    let mut add = |grid: &Grid| {
        let _ = writeln!(out, "{}", grid.terminal());
    };
    report.tables.iter().flat_map(|(_, grids)| grids).for_each(&mut add);
    if !report.optimality.is_empty() {
        optimality::grids(&report.optimality).iter().for_each(&mut add);
        add(&optimality_summary(report));
    }
    if let Some(s) = &report.sensitivity {
        s.grids.iter().for_each(&mut add);
    }
    for erratum in &report.errata {
        let mut head = Grid::new(
            format!("Erratum {} ({})", erratum.id, erratum.labels.join(", ")),
            ["printed", "correct"],
        );
        head.row([erratum.printed.into(), erratum.correct.into()]);
        add(&head);
        erratum.evidence.iter().for_each(&mut add);
    }
    if !report.claims.is_empty() {
        add(&verdicts(&report.claims));
    }
    out
}

/// The worst deviations of the optimality check.
fn optimality_summary(report: &Report) -> Grid {
    let mut grid = Grid::new(
        format!(
            "Analytic reference against the transcription: greatest |excess|, % (bound {BOUND_PERCENT} %)"
        ),
        ["cases", "number", "corrected", "as printed", "within the bound"],
    );
    let worst = |cases: &[&optimality::Check], cost: fn(&optimality::Check) -> f64| {
        cases.iter().map(|c| c.excess_percent(cost(c)).abs()).fold(0.0, f64::max)
    };
    for (name, leader) in [("no leader", false), ("leader given, not in the way", true)] {
        let cases: Vec<&optimality::Check> =
            report.optimality.iter().filter(|c| c.leader.is_some() == leader && !c.leader_binds()).collect();
        let corrected = worst(&cases, |c| c.corrected.1);
        grid.row([
            name.into(),
            number(cases.len() as f64, 0),
            number(corrected, 4),
            number(worst(&cases, |c| c.as_printed.1), 4),
            if corrected <= BOUND_PERCENT { "yes" } else { "no" }.into(),
        ]);
    }
    grid
}

/// The whole report.
pub fn report(report: &Report) -> String {
    let mut out = String::from("# Reproduction of the paper's numbers\n\n");
    let _ = writeln!(
        out,
        "Written by `cz reproduce --seeds {}` from {} simulations; do not edit. The paper is *Scaling up \
         the Optimal Safe Control of Connected and Automated Vehicles to a Traffic Network: A Hierarchical \
         Framework of Modular Control Zones* (K. Xu, C. G. Cassandras). Its simulation code, traffic and \
         several parameters are not published, so equal numbers cannot be expected; what can be asked is \
         whether its claims hold, and on which unstated choices they rest.\n",
        report.seeds, report.simulations
    );
    out.push_str(
        "Every policy meets the same arrivals, and differences are taken run by run before their mean and \
         95 % Student-t interval. *Seeded* is the random process, *SUMO* the three traces made with SUMO's \
         human drivers (three replicates: wide intervals). *Corrected* plans with β − ½b² + ac = 0, *as \
         printed* with the paper's misprint. Constant traffic uses β = 2/3, which the paper's table \
         implies; varying traffic α = 0.25. The second zone's v_m2 is the mean exit speed without flow \
         control, as the paper defines it, measured per column and setting.\n\n",
    );
    if !report.claims.is_empty() {
        out.push_str("## Verdicts\n\n");
        out.push_str(VERDICT_RULES);
        section(&mut out, &[verdicts(&report.claims)]);
        out.push_str(&findings(report));
    }
    for (label, grids) in &report.tables {
        let _ = writeln!(out, "## `{label}`\n");
        let prefix = format!("{label}:");
        for (name, caption) in report.figures().iter().filter(|(_, c)| c.starts_with(&prefix)) {
            let _ = writeln!(out, "![{caption}](figures/{name}.svg)\n");
        }
        if *label == "fig:rate" {
            out.push_str(
                "The curves are of vehicles that pass both zones, smoothed exponentially with a time \
                 constant of 60 s; the paper does not say how it counts vehicles of the second side road.\n\n",
            );
        }
        section(&mut out, grids);
    }
    if !report.errata.is_empty() {
        out.push_str("## Errata\n\nEach is shown by `cz reproduce --only ID`.\n\n");
        for e in &report.errata {
            let labels: Vec<String> = e.labels.iter().map(|l| format!("`{l}`")).collect();
            let _ = writeln!(out, "### {} ({})\n", e.id, labels.join(", "));
            let _ = writeln!(out, "Printed: {}\n\nCorrect: {}\n", e.printed, e.correct);
            section(&mut out, &e.evidence);
        }
    }
    if let Some(s) = &report.sensitivity {
        let _ = writeln!(
            out,
            "## Sensitivity to what the paper leaves unsaid\n\nSeeded process, {} replicates, coarser \
             sweep (12, 14, 15, 16, 18, 20 m/s). A choice moves a claim (*) when the interval of the paired \
             change excludes zero; of so many comparisons one in twenty is chance. The search goes choice \
             by choice through stated levels only: entry speed 14–22 m/s, least headway 0.6–3 s, k1 and \
             k2 0.25–4, ε 1–100, λ 0.05–10, Δt 0.05–0.2 s, both FE readings, feasibility rows on and off, \
             both re-planning modes, both references. It is a search, not evidence: a close setting shows \
             what the paper may have used, not that it did.\n",
            s.replicates
        );
        section(&mut out, &s.grids);
    }
    if !report.optimality.is_empty() {
        out.push_str(
            "## Optimality\n\nProblem 1 by direct transcription, solved by Clarabel; nothing of the \
             analytic solution enters. Where the leader is in the way (negative margin) the reference is not \
             feasible and may cost less. The OCBF column is the cost of the controller as driven: it may \
             be below the optimum where it misses the terminal speed, which the transcription must meet \
             exactly; with a free terminal speed it is what tracking and the barrier rows cost.\n\n",
        );
        section(&mut out, &optimality::grids(&report.optimality));
        section(&mut out, &[optimality_summary(report)]);
    }
    out.push_str("## Equations and code\n\n");
    section(&mut out, &[equations::forward(), equations::backward()]);
    while out.ends_with("\n\n") {
        out.pop();
    }
    out
}

const VERDICT_RULES: &str = "A claim with a number *holds* when the interval of its effect lies above zero \
and meets the printed value ± the tolerance shown, and *holds in direction* when it only lies above zero. \
\"> 0\" holds when the interval lies above zero, in direction when only the mean does. \"0 ±\" holds when \
the interval stays within the tolerance, in direction when the mean does. A location must lie inside the \
range of the sweep; R² holds when its interval reaches no lower than the bound. Everything else *does not \
hold*.\n\n";

/// The verdicts in one paragraph, from the first (seeded, corrected) variant.
fn findings(report: &Report) -> String {
    let list = |verdict: Verdict| {
        let ids: Vec<String> = report
            .claims
            .iter()
            .filter(|c| c.verdicts[0].verdict == verdict)
            .map(|c| {
                let effect = c.verdicts[0]
                    .effect
                    .map_or(String::new(), |i| format!(": {}", Entry::Interval(i).show()));
                format!("{}{effect} {}", c.text, c.unit).trim_end().to_owned()
            })
            .collect();
        ids
    };
    let mut out = String::new();
    for verdict in [Verdict::Holds, Verdict::HoldsInDirection, Verdict::DoesNotHold, Verdict::Undecided] {
        let claims = list(verdict);
        if !claims.is_empty() {
            let _ = writeln!(
                out,
                "On the seeded process, corrected, {} of {} {}:\n",
                claims.len(),
                report.claims.len(),
                match verdict {
                    Verdict::Holds => "hold",
                    Verdict::HoldsInDirection => "hold in direction",
                    Verdict::DoesNotHold => "do not hold",
                    Verdict::Undecided => "are undecided",
                }
            );
            for claim in claims {
                let _ = writeln!(out, "- {claim}");
            }
            out.push('\n');
        }
    }
    out
}

fn section(out: &mut String, grids: &[Grid]) {
    for grid in grids {
        let _ = writeln!(out, "{}", grid.markdown());
    }
}
