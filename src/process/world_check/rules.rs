//! What a foreign world is held to, and what was found.

use serde::{Deserialize, Serialize};

/// A rule of `docs/world-contract.md`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[allow(missing_docs)] // each is described by `text`
pub enum WorldRule {
    Attach,
    Schema,
    Header,
    Steps,
    Sound,
    Numbers,
    Numbered,
    Unique,
    Kept,
    Apart,
    Motion,
    Obedience,
    Standing,
    Traffic,
    LateCommands,
    Stopped,
    End,
    Accounts,
    Repeats,
    Abandoned,
    Told,
}

impl WorldRule {
    /// All rules, in the order of the report.
    pub const ALL: [WorldRule; 21] = [
        WorldRule::Attach,
        WorldRule::Schema,
        WorldRule::Header,
        WorldRule::Steps,
        WorldRule::Sound,
        WorldRule::Numbers,
        WorldRule::Numbered,
        WorldRule::Unique,
        WorldRule::Kept,
        WorldRule::Apart,
        WorldRule::Motion,
        WorldRule::Obedience,
        WorldRule::Standing,
        WorldRule::Traffic,
        WorldRule::LateCommands,
        WorldRule::Stopped,
        WorldRule::End,
        WorldRule::Accounts,
        WorldRule::Repeats,
        WorldRule::Abandoned,
        WorldRule::Told,
    ];

    /// What it is called in JSON, and on the command line.
    pub fn name(self) -> String {
        let name = serde_json::to_value(self).expect("a rule is a word");
        name.as_str().unwrap_or_default().to_owned()
    }

    /// What the rule asks for.
    pub fn text(self) -> &'static str {
        match self {
            WorldRule::Attach => {
                "opens the run it is told to, and lets coordinator and controller in (--run)"
            }
            WorldRule::Schema => "has the schema of this version (schema_hash)",
            WorldRule::Header => {
                "sends frames as the world of its run (run_id, sender_role, record_count, time_ns)"
            }
            WorldRule::Steps => "states each step, in order, when the one before is answered (step)",
            WorldRule::Sound => {
                "says what can be (advanced_m, v_mps, newcomers), and goes on until the run ends"
            }
            WorldRule::Numbers => {
                "has vehicles where their paths are, not faster than v_max or than they came (x_m, v_mps)"
            }
            WorldRule::Numbered => "numbers vehicles in the order in which they come, from 0 (vehicle)",
            WorldRule::Unique => "has each vehicle in one place (vehicle)",
            WorldRule::Kept => "loses nobody, and takes nobody out, within the network (advanced_m is NaN)",
            WorldRule::Apart => "brings nobody in where another is (newcomers, x_m)",
            WorldRule::Motion => "moves vehicles as far as their speeds say (advanced_m against v_mps)",
            WorldRule::Obedience => "has commanded vehicles hold their accelerations (u_mps2)",
            WorldRule::Standing => {
                "has whoever brakes stop, and stand while it is not to start (u_mps2 <= 0)"
            }
            WorldRule::Traffic => "has vehicles come that are commanded, and leave",
            WorldRule::LateCommands => "waits for commands that come late",
            WorldRule::Stopped => {
                "goes on where it was after having been stopped for a while (SIGSTOP, SIGCONT)"
            }
            WorldRule::End => "says that the run is over, and ends with code 0",
            WorldRule::Accounts => {
                "reports the hash and the number of vehicles of the frames it sent (--json)"
            }
            WorldRule::Repeats => "repeats: the same seed comes to the same hash, with pauses and without",
            WorldRule::Abandoned => "gives up when nobody answers (--peer-timeout), with another code than 0",
            WorldRule::Told => "ends when told to (SIGTERM), with another code than 0",
        }
    }
}

/// The first breach of a rule, and how many there were.
#[derive(Clone, Debug, Serialize)]
pub struct WorldBreach {
    /// The rule.
    pub rule: WorldRule,
    /// Step of the first.
    pub step: u64,
    /// What was wrong with it.
    pub what: String,
    /// Number of times it was broken.
    pub count: u64,
}

/// What a check has found.
#[derive(Clone, Debug, Serialize)]
pub struct WorldReport {
    /// Rules broken.
    pub breaches: Vec<WorldBreach>,
    /// Rules that could not be tried, because the world had gone or the run was over before.
    pub untried: Vec<WorldRule>,
    /// Steps stated, over all runs.
    pub steps: u64,
    /// Vehicles that came in the first run.
    pub vehicles: u32,
    /// Greatest difference between an acceleration that was to be held and the one that was, m/s^2.
    pub greatest_disobedience_mps2: f64,
    /// Greatest difference between a way and the one that goes with the speeds at its ends, m.
    pub greatest_deviation_m: f64,
}
