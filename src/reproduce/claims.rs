//! The paper's claims as effects measured per replicate, and the verdicts that follow from intervals.

use super::experiment::{FIXED, Policy, Replicate, Traffic};
use super::rate;
use super::runs::{Outcome, Run, Runs};
use super::statistics::{Interval, Quadratic, slope};
use serde::Serialize;

/// What a claim says about its effect.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Expectation {
    /// The effect is positive and about `printed`: within `tolerance` of it.
    Value {
        /// What the paper prints.
        printed: f64,
        /// What still counts as about that.
        tolerance: f64,
    },
    /// The effect is positive.
    Positive,
    /// The effect is zero for all practical purposes: within `tolerance`.
    Zero {
        /// What still counts as zero.
        tolerance: f64,
    },
    /// A location within `tolerance` of `printed`, in the inside of `(low, high)`.
    Location {
        /// What the paper prints.
        printed: f64,
        /// What still counts as near.
        tolerance: f64,
        /// Lower end of the range searched.
        low: f64,
        /// Upper end of the range searched.
        high: f64,
    },
    /// The effect is at least this.
    AtLeast(f64),
}

/// How a claim fares.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// As claimed.
    Holds,
    /// The sign is right, the size is not.
    HoldsInDirection,
    /// Neither.
    DoesNotHold,
    /// There is no effect to measure, or not enough replicates.
    Undecided,
}

impl Verdict {
    /// Words for tables.
    pub fn words(self) -> &'static str {
        match self {
            Verdict::Holds => "holds",
            Verdict::HoldsInDirection => "in direction",
            Verdict::DoesNotHold => "does not hold",
            Verdict::Undecided => "undecided",
        }
    }
}

/// The verdict on an effect's 95 % interval.
///
/// | expectation | holds | in direction |
/// |---|---|---|
/// | value | interval above 0 and meets printed +- tolerance | interval above 0 |
/// | positive | interval above 0 | mean above 0 |
/// | zero | interval within +- tolerance | mean within +- tolerance |
/// | location | interval inside the range and meets printed +- tolerance | interval inside the range |
/// | at least | interval at or above the bound | mean at or above the bound |
pub fn judge(expectation: Expectation, effect: Option<&Interval>) -> Verdict {
    let Some(i) = effect else { return Verdict::Undecided };
    let (full, partly) = match expectation {
        Expectation::Value { printed, tolerance } => {
            (i.low > 0.0 && i.meets(printed - tolerance, printed + tolerance), i.low > 0.0)
        }
        Expectation::Positive => (i.low > 0.0, i.mean > 0.0),
        Expectation::Zero { tolerance } => {
            (i.low >= -tolerance && i.high <= tolerance, i.mean.abs() <= tolerance)
        }
        Expectation::Location { printed, tolerance, low, high } => {
            let inside = i.low > low && i.high < high;
            (inside && i.meets(printed - tolerance, printed + tolerance), inside)
        }
        Expectation::AtLeast(bound) => (i.low >= bound, i.mean >= bound),
    };
    match (full, partly) {
        (true, _) => Verdict::Holds,
        (false, true) => Verdict::HoldsInDirection,
        (false, false) => Verdict::DoesNotHold,
    }
}

/// A claim of the paper.
#[derive(Clone, Copy, Debug)]
pub struct Claim {
    /// Short name.
    pub id: &'static str,
    /// Table or figure it belongs to.
    pub label: &'static str,
    /// What is claimed, and what effect is measured.
    pub text: &'static str,
    /// Unit of the effect.
    pub unit: &'static str,
    /// What is expected of the effect.
    pub expectation: Expectation,
    /// Traffic it is about.
    pub traffic: Traffic,
    needs: Needs,
    effect: fn(&Look<'_>) -> Option<f64>,
}

/// Policies a claim compares.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Needs {
    Sweep,
    FixedAndNone,
    LowerAndNone,
    FeedbackAndNone,
    FeedbackAndFixed,
}

/// A replicate with the outcomes of its policies.
#[derive(Debug)]
struct Look<'a> {
    runs: &'a Runs,
    replicate: &'a Replicate<'a>,
    traffic: Traffic,
    speeds: &'a [f64],
}

impl Look<'_> {
    fn at(&self, policy: Policy) -> &Outcome {
        self.runs.outcome(&self.replicate.run(self.traffic, policy))
    }

    fn total(&self, policy: Policy) -> f64 {
        self.at(policy).total()
    }

    /// By how much `policy` lowers the total of `than`, %.
    fn gain(&self, policy: Policy, than: Policy) -> Option<f64> {
        fall(self.total(than), self.total(policy))
    }

    fn sweep(&self, value: impl Fn(&Outcome) -> f64) -> Vec<f64> {
        self.speeds.iter().map(|&v| value(self.at(Policy::Fixed(v)))).collect()
    }

    fn fit(&self) -> Option<Quadratic> {
        Quadratic::fit(self.speeds, &self.sweep(Outcome::total))
    }
}

/// Fall from `from` to `to`, % of `from`.
fn fall(from: f64, to: f64) -> Option<f64> {
    (from > 0.0).then(|| 100.0 * (from - to) / from)
}

/// All claims, in the paper's order.
pub const CLAIMS: [Claim; 15] = [
    Claim {
        id: "minimum",
        label: "fig:diff_v",
        text: "the total is least near v_m1 = 15 m/s (minimum of the quadratic fit)",
        unit: "m/s",
        expectation: Expectation::Location { printed: 15.0, tolerance: 1.0, low: 12.0, high: 20.0 },
        traffic: Traffic::Constant,
        needs: Needs::Sweep,
        // A fit without minimum counts as one at the end of the range: it must weigh against the claim.
        effect: |l| l.fit().map(|f| f.minimum().unwrap_or(20.0).clamp(12.0, 20.0)),
    },
    Claim {
        id: "quadratic",
        label: "fig:diff_v",
        text: "the total is near-quadratic in v_m1 (R^2 of the fit)",
        unit: "",
        expectation: Expectation::AtLeast(0.95),
        traffic: Traffic::Constant,
        needs: Needs::Sweep,
        effect: |l| l.fit().map(|f| f.r_squared),
    },
    Claim {
        id: "cz1-falls",
        label: "fig:diff_v",
        text: "CZ1 improves with higher v_m1 (fall of its objective per m/s)",
        unit: "per m/s",
        expectation: Expectation::Positive,
        traffic: Traffic::Constant,
        needs: Needs::Sweep,
        effect: |l| Some(-slope(l.speeds, &l.sweep(|o| o.zones[0].mean_objective))),
    },
    Claim {
        id: "cz2-rises",
        label: "fig:diff_v",
        text: "CZ2 worsens with higher v_m1 (rise of its objective per m/s)",
        unit: "per m/s",
        expectation: Expectation::Positive,
        traffic: Traffic::Constant,
        needs: Needs::Sweep,
        effect: |l| Some(slope(l.speeds, &l.sweep(|o| o.zones[1].mean_objective))),
    },
    Claim {
        id: "fe-count",
        label: "tab:fem_time",
        text: "v_m1 = 15 m/s lowers the FE count of CZ2 by 25.8 %",
        unit: "%",
        expectation: Expectation::Value { printed: 25.8, tolerance: 5.0 },
        traffic: Traffic::Constant,
        needs: Needs::FixedAndNone,
        effect: |l| {
            let count = |p| f64::from(l.at(p).zones[1].fe_vehicles);
            fall(count(Policy::None), count(FIXED))
        },
    },
    Claim {
        id: "fe-time",
        label: "tab:fem_time",
        text: "v_m1 = 15 m/s lowers the mean FE time of CZ2 by 60.5 %",
        unit: "%",
        expectation: Expectation::Value { printed: 60.5, tolerance: 5.0 },
        traffic: Traffic::Constant,
        needs: Needs::FixedAndNone,
        effect: |l| {
            let time = |p| l.at(p).zones[1].fe_mean_s;
            fall(time(Policy::None), time(FIXED))
        },
    },
    Claim {
        id: "fe-count-12",
        label: "tab:fem_time",
        text: "v_m1 = 12 m/s lowers the FE count of CZ2 by 58.1 %",
        unit: "%",
        expectation: Expectation::Value { printed: 58.1, tolerance: 5.0 },
        traffic: Traffic::Constant,
        needs: Needs::LowerAndNone,
        effect: |l| {
            let count = |p| f64::from(l.at(p).zones[1].fe_vehicles);
            fall(count(Policy::None), count(Policy::Fixed(12.0)))
        },
    },
    Claim {
        id: "fe-time-12",
        label: "tab:fem_time",
        text: "v_m1 = 12 m/s lowers the mean FE time of CZ2 by 82.6 %",
        unit: "%",
        expectation: Expectation::Value { printed: 82.6, tolerance: 5.0 },
        traffic: Traffic::Constant,
        needs: Needs::LowerAndNone,
        effect: |l| {
            let time = |p| l.at(p).zones[1].fe_mean_s;
            fall(time(Policy::None), time(Policy::Fixed(12.0)))
        },
    },
    Claim {
        id: "fixed-15-percent",
        label: "tab:feedback1",
        text: "fixed v_m1 = 15 m/s lowers the total by about 15 %",
        unit: "%",
        expectation: Expectation::Value { printed: 15.0, tolerance: 3.0 },
        traffic: Traffic::Constant,
        needs: Needs::FixedAndNone,
        effect: |l| l.gain(FIXED, Policy::None),
    },
    Claim {
        id: "feedback-15-percent",
        label: "tab:feedback1",
        text: "feedback lowers the total by about 15 %",
        unit: "%",
        expectation: Expectation::Value { printed: 15.2, tolerance: 3.0 },
        traffic: Traffic::Constant,
        needs: Needs::FeedbackAndNone,
        effect: |l| l.gain(Policy::Feedback, Policy::None),
    },
    Claim {
        id: "feedback-like-fixed",
        label: "tab:feedback1",
        text: "feedback is as good as fixed 15 m/s under constant traffic (difference of the totals)",
        unit: "%",
        expectation: Expectation::Zero { tolerance: 2.0 },
        traffic: Traffic::Constant,
        needs: Needs::FeedbackAndFixed,
        effect: |l| l.gain(Policy::Feedback, FIXED),
    },
    Claim {
        id: "high-traffic",
        label: "fig:rate",
        text: "fixed 15 m/s beats no flow control at 400 veh/h (objective per vehicle over both zones)",
        unit: "%",
        expectation: Expectation::Positive,
        traffic: Traffic::Varying,
        needs: Needs::FixedAndNone,
        effect: |l| {
            let mean = |p| rate::mean_objective(l.at(p), &rate::HIGH);
            fall(mean(Policy::None), mean(FIXED))
        },
    },
    Claim {
        id: "low-traffic",
        label: "fig:rate",
        text: "fixed 15 m/s is too conservative at 100 and 200 veh/h (its loss against no flow control)",
        unit: "%",
        expectation: Expectation::Positive,
        traffic: Traffic::Varying,
        needs: Needs::FixedAndNone,
        effect: |l| {
            let mean = |p| rate::mean_objective(l.at(p), &rate::LOW);
            fall(mean(Policy::None), mean(FIXED)).map(|f| -f)
        },
    },
    Claim {
        id: "varying-beats-fixed",
        label: "tab:feedback",
        text: "feedback beats fixed 15 m/s under varying traffic (printed: 5.2 %)",
        unit: "%",
        expectation: Expectation::Positive,
        traffic: Traffic::Varying,
        needs: Needs::FeedbackAndFixed,
        effect: |l| l.gain(Policy::Feedback, FIXED),
    },
    Claim {
        id: "varying-beats-none",
        label: "tab:feedback",
        text: "feedback beats no flow control under varying traffic (printed: 2.6 %)",
        unit: "%",
        expectation: Expectation::Positive,
        traffic: Traffic::Varying,
        needs: Needs::FeedbackAndNone,
        effect: |l| l.gain(Policy::Feedback, Policy::None),
    },
];

impl Claim {
    /// The runs its effect needs on a replicate.
    pub fn runs(&self, replicate: &Replicate<'_>, speeds: &[f64]) -> Vec<Run> {
        let lower = Policy::Fixed(12.0);
        let policies = match self.needs {
            Needs::Sweep => speeds.iter().map(|&v| Policy::Fixed(v)).collect(),
            Needs::FixedAndNone => vec![FIXED, Policy::None],
            Needs::LowerAndNone => vec![lower, Policy::None],
            Needs::FeedbackAndNone => vec![Policy::Feedback, Policy::None],
            Needs::FeedbackAndFixed => vec![Policy::Feedback, FIXED],
        };
        policies.into_iter().map(|p| replicate.run(self.traffic, p)).collect()
    }

    /// The effect on a replicate whose runs have been performed; `None` where it is not defined, for one
    /// because a run ended in a jam.
    pub fn effect(&self, runs: &Runs, replicate: &Replicate<'_>, speeds: &[f64]) -> Option<f64> {
        let complete = self.runs(replicate, speeds).iter().all(|run| runs.outcome(run).complete);
        complete.then(|| (self.effect)(&Look { runs, replicate, traffic: self.traffic, speeds }))?
    }
}

/// An effect and its verdict under one variant.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Judged {
    /// Variant's name.
    pub variant: String,
    /// The effect.
    pub effect: Option<Interval>,
    /// The verdict.
    pub verdict: Verdict,
}

/// A claim with its verdicts.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ClaimRow {
    /// Short name.
    pub id: &'static str,
    /// Table or figure it belongs to.
    pub label: &'static str,
    /// What is claimed.
    pub text: &'static str,
    /// Unit of the effect.
    pub unit: &'static str,
    /// What is expected.
    pub expectation: Expectation,
    /// Per variant.
    pub verdicts: Vec<Judged>,
}
