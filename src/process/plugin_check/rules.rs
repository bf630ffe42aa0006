//! What a controller is held to, and what was found.

use serde::Serialize;

/// A rule of `docs/plugin-contract.md`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
#[allow(missing_docs)] // each is described by `text`
pub enum Rule {
    Attach,
    Schema,
    Run,
    Sender,
    Generation,
    Step,
    Count,
    OncePerStep,
    OwnVehicles,
    NoDuplicates,
    AllVehicles,
    Zone,
    Finite,
    Limits,
    Verdict,
    EmptyZone,
    Pause,
    HardBraking,
    Feedback,
    Deadline,
    Alive,
    Restart,
    CatchUp,
    End,
}

impl Rule {
    /// All rules, in the order of the report.
    pub const ALL: [Rule; 24] = [
        Rule::Attach,
        Rule::Schema,
        Rule::Run,
        Rule::Sender,
        Rule::Generation,
        Rule::Step,
        Rule::Count,
        Rule::OncePerStep,
        Rule::OwnVehicles,
        Rule::NoDuplicates,
        Rule::AllVehicles,
        Rule::Zone,
        Rule::Finite,
        Rule::Limits,
        Rule::Verdict,
        Rule::EmptyZone,
        Rule::Pause,
        Rule::HardBraking,
        Rule::Feedback,
        Rule::Deadline,
        Rule::Alive,
        Rule::Restart,
        Rule::CatchUp,
        Rule::End,
    ];

    /// What the rule asks for.
    pub fn text(self) -> &'static str {
        match self {
            Rule::Attach => "joins the run and says ready",
            Rule::Schema => "has the schema of this version (schema_hash)",
            Rule::Run => "answers for this run (run_id)",
            Rule::Sender => "sends as the controller it was let in as (sender_role, sender_index)",
            Rule::Generation => "carries the generation it was given (generation)",
            Rule::Step => "answers the step it was asked (step)",
            Rule::Count => "announces as many records as it sends (record_count)",
            Rule::OncePerStep => "answers each step once",
            Rule::OwnVehicles => "commands only its own vehicles (vehicle)",
            Rule::NoDuplicates => "commands no vehicle twice (vehicle)",
            Rule::AllVehicles => "commands all its vehicles, in frame order (vehicle)",
            Rule::Zone => "names the vehicle's zone (zone)",
            Rule::Finite => "sends numbers (u_mps2, planned exit)",
            Rule::Limits => "keeps the vehicles' limits (u_mps2)",
            Rule::Verdict => "gives a verdict from 0 to 3 (verdict)",
            Rule::EmptyZone => "answers steps without vehicles",
            Rule::Pause => "waits for a world that pauses",
            Rule::HardBraking => "goes on while a leader brakes to a stop",
            Rule::Feedback => {
                "goes on when it is told what bounded its commands, or that an answer was refused"
            }
            Rule::Deadline => "answers within the deadline, but for one step in a hundred",
            Rule::Alive => "stays alive and answers every step",
            Rule::Restart => "joins again after being killed, and goes on from there",
            Rule::CatchUp => "goes on with the step at hand after steps have passed without it",
            Rule::End => "ends with code 0 when the run does",
        }
    }
}

/// The first breach of a rule, and how many there were.
#[derive(Clone, Debug, Serialize)]
pub struct Breach {
    /// The rule.
    pub rule: Rule,
    /// Step of the first.
    pub step: u64,
    /// What was wrong with it.
    pub what: String,
    /// Number of steps in which it was broken.
    pub count: u64,
}

/// What a check has found.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Rules broken.
    pub breaches: Vec<Breach>,
    /// Rules that could not be tried, because the controller had gone.
    pub untried: Vec<Rule>,
    /// Steps answered.
    pub answered: u64,
    /// Answer times, us: median, 99th percentile, 99.9th, greatest.
    pub latency_us: [f64; 4],
}
