//! The paper's experiments as runs: traffic, demand, policy, setting.

use super::ReproduceError;
use super::paper::SECOND_TERMINAL_MPS;
use super::runs::{CONSTANT_SCENARIO, Progress, Run, Runs, VARYING_SCENARIO};
use crate::scenario::ReferenceLaw;
use serde::Serialize;

/// Constant or varying rates.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Traffic {
    /// 400 veh/h and road, 120 vehicles, beta = 2/3.
    Constant,
    /// 300, 200, 400, 100, 400 veh/h and road for 400 s each, alpha = 0.25.
    Varying,
}

/// Where arrivals come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Demand {
    /// The traces made with SUMO's human drivers; there are three.
    Traces,
    /// The seeded random process, as many seeds as wished.
    Seeded,
}

/// Seeds of the traces.
pub const TRACE_SEEDS: u64 = 3;

impl Demand {
    /// Both.
    pub const ALL: [Demand; 2] = [Demand::Traces, Demand::Seeded];

    /// Name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Demand::Traces => "SUMO traces",
            Demand::Seeded => "seeded process",
        }
    }

    /// Seeds of this demand's replicates.
    pub fn seeds(self, seeded: u64) -> std::ops::RangeInclusive<u64> {
        1..=match self {
            Demand::Traces => TRACE_SEEDS,
            Demand::Seeded => seeded,
        }
    }
}

/// A column of every table of ours: which demand under which reading of the necessary condition.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Variant {
    /// Demand.
    pub demand: Demand,
    /// Transversality condition.
    pub reference: ReferenceLaw,
}

impl Variant {
    /// All, in the order of the tables' columns.
    pub const ALL: [Variant; 4] = [
        Variant { demand: Demand::Seeded, reference: ReferenceLaw::Corrected },
        Variant { demand: Demand::Traces, reference: ReferenceLaw::Corrected },
        Variant { demand: Demand::Seeded, reference: ReferenceLaw::AsPrinted },
        Variant { demand: Demand::Traces, reference: ReferenceLaw::AsPrinted },
    ];

    /// Name in tables.
    pub fn name(self) -> String {
        let law = match self.reference {
            ReferenceLaw::Corrected => "corrected",
            ReferenceLaw::AsPrinted => "as printed",
        };
        format!("{law}, {}", self.demand.name())
    }

    /// Its `--set`s.
    pub fn sets(self) -> Vec<String> {
        match self.reference {
            ReferenceLaw::Corrected => Vec::new(),
            ReferenceLaw::AsPrinted => vec!["control.reference=as_printed".to_owned()],
        }
    }
}

/// Flow control of the first zone. The second zone's terminal speed is v_m2 (see [`Setting`]) under flow
/// control and free without, as the paper has it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Policy {
    /// No flow control in either zone: the baseline.
    None,
    /// v_m1 is constant, m/s.
    Fixed(f64),
    /// v_m1 = 18 - N(L/4) / 2 under constant traffic, v_m1 = mean speed + 2 - N(L/4) / 2 under varying.
    Feedback,
}

/// The fixed speed the paper compares with, m/s.
pub const FIXED: Policy = Policy::Fixed(15.0);

/// Roads of both scenarios.
pub const ROADS: [&str; 3] = ["main1", "merge1", "merge2"];

/// Demand under further `--set`s, with the second zone's terminal speed v_m2 that belongs to it.
///
/// The paper sets v_m2 to the mean exit speed of the second zone without flow control. That depends on
/// traffic and setting: it is measured for each, over all replicates, to 0.1 m/s as the paper prints it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Setting {
    /// Where arrivals come from.
    pub demand: Demand,
    /// Further `--set`s.
    pub sets: Vec<String>,
    /// v_m2 under constant and under varying traffic, m/s, where it was asked for.
    pub second_mps: [Option<f64>; 2],
}

impl Setting {
    /// A setting in which nobody has measured v_m2: it has runs without flow control only.
    pub fn new(demand: Demand, sets: Vec<String>) -> Setting {
        Setting { demand, sets, second_mps: [None; 2] }
    }

    /// The same with a given v_m2.
    pub fn with_second(self, second_mps: f64) -> Setting {
        Setting { second_mps: [Some(second_mps); 2], ..self }
    }

    /// The runs v_m2 is measured in, as far as it is not given.
    pub fn baselines(&self, traffics: &[Traffic], seeds: u64) -> Vec<Run> {
        let open = traffics.iter().filter(|t| self.second_mps[**t as usize].is_none());
        open.flat_map(|&traffic| self.without_control(traffic, seeds)).collect()
    }

    fn without_control(&self, traffic: Traffic, seeds: u64) -> Vec<Run> {
        self.demand.seeds(seeds).map(|seed| self.replicate(seed).run(traffic, Policy::None)).collect()
    }

    /// The same with v_m2 from performed [baselines](Setting::baselines).
    pub fn measured(mut self, traffics: &[Traffic], seeds: u64, runs: &Runs) -> Setting {
        for &traffic in traffics {
            if self.second_mps[traffic as usize].is_some() {
                continue;
            }
            let baselines = self.without_control(traffic, seeds);
            let speeds = baselines.iter().map(|run| runs.outcome(run).exit_speeds_mps[1]);
            let speeds: Vec<f64> = speeds.filter(|speed| *speed > 0.0).collect();
            // Where nobody got through there is nothing to measure, and every claim is undecided.
            let mean = match speeds.len() {
                0 => SECOND_TERMINAL_MPS,
                n => speeds.iter().sum::<f64>() / n as f64,
            };
            self.second_mps[traffic as usize] = Some((10.0 * mean).round() / 10.0);
        }
        self
    }

    /// Performs the baselines of all settings and measures v_m2 in each.
    pub fn settle(
        settings: Vec<Setting>,
        traffics: &[Traffic],
        seeds: u64,
        runs: &mut Runs,
        progress: &mut Progress<'_>,
    ) -> Result<Vec<Setting>, ReproduceError> {
        runs.perform(settings.iter().flat_map(|s| s.baselines(traffics, seeds)), progress)?;
        Ok(settings.into_iter().map(|s| s.measured(traffics, seeds, runs)).collect())
    }

    /// One of its replicates.
    pub fn replicate(&self, seed: u64) -> Replicate<'_> {
        Replicate { setting: self, seed }
    }
}

/// One replicate: everything but the policy.
#[derive(Clone, Copy, Debug)]
pub struct Replicate<'a> {
    /// Demand and setting.
    pub setting: &'a Setting,
    /// Seed of the arrivals, the same for every policy.
    pub seed: u64,
}

impl Replicate<'_> {
    /// The run of a policy on these arrivals.
    ///
    /// # Panics
    /// When the policy has flow control and the setting is not [measured](Setting::measured) for this traffic.
    pub fn run(&self, traffic: Traffic, policy: Policy) -> Run {
        let (scenario, rates) = match traffic {
            Traffic::Constant => (CONSTANT_SCENARIO, "[{ until_s = 7200.0, vehicles_per_hour = 400.0 }]"),
            Traffic::Varying => (VARYING_SCENARIO, ""),
        };
        let mut sets = Vec::new();
        for road in ROADS {
            match (traffic, self.setting.demand) {
                // What the scenario has by itself.
                (Traffic::Constant, Demand::Traces) | (Traffic::Varying, Demand::Seeded) => {}
                (Traffic::Constant, Demand::Seeded) => sets.push(format!(
                    "roads.{road}.demand={{ rates = {rates}, min_headway_s = 1.2, speed_mean_mps = 16.0, \
                     speed_sd_mps = 1.2, speed_min_mps = 10.0, speed_max_mps = 22.0 }}"
                )),
                (Traffic::Varying, Demand::Traces) => {
                    sets.push(format!("roads.{road}.demand={{ trace = \"sumo-varying-{{seed}}\" }}"))
                }
            }
        }
        let first = match (policy, traffic) {
            (Policy::None, _) => "{ policy = \"none\" }".to_owned(),
            (Policy::Fixed(speed), _) => fixed(speed),
            (Policy::Feedback, Traffic::Constant) => {
                "{ policy = \"feedback\", baseline_mps = 18.0, gain_mps = 0.5, segment_m = 50.0 }".to_owned()
            }
            (Policy::Feedback, Traffic::Varying) => {
                "{ policy = \"mean_speed\", offset_mps = 2.0, gain_mps = 0.5, segment_m = 50.0 }".to_owned()
            }
        };
        let second = match policy {
            Policy::None => first.clone(),
            _ => fixed(self.setting.second_mps[traffic as usize].expect("the setting is measured")),
        };
        sets.push(format!("zones.merge-1.flow={first}"));
        sets.push(format!("zones.merge-2.flow={second}"));
        sets.extend_from_slice(&self.setting.sets);
        Run { scenario, seed: self.seed, sets }
    }
}

fn fixed(speed_mps: f64) -> String {
    format!("{{ policy = \"fixed\", terminal_mps = {speed_mps:?} }}")
}

/// The fixed speeds of `fig:diff_v`, m/s.
pub fn sweep_speeds() -> Vec<f64> {
    (0..=16).map(|i| 12.0 + 0.5 * f64::from(i)).collect()
}
