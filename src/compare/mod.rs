//! Policies compared on the same arrivals, with paired differences, and beside what no policy can do better than.
//!
//! [`run`] does it: [`policy`] says what is compared, [`sample`] what a run shows, [`cache`] keeps that, [`measure`]
//! lists what is told of it, [`tables`] has the comparisons of docs/control.md.

pub mod cache;
pub mod cli;
pub mod encounters;
pub mod figure;
pub mod measure;
pub mod policy;
mod processes;
pub mod report;
pub mod sample;
pub mod study;
pub mod tables;

use crate::bounds::{Bounds, joint};
use crate::reproduce::ReproduceError;
use crate::reproduce::parallel;
use crate::scenario::{self, Override, Scenario, ScenarioError};
use cache::Cache;
use measure::Row;
use policy::{Member, Policy};
use report::Block;
use sample::Sample;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// What is to be compared.
#[derive(Clone, Debug, PartialEq)]
pub struct Comparison {
    /// Policies by name; differences are against the first.
    pub policies: Vec<String>,
    /// Scenario, the default one when none is named.
    pub scenario: Option<String>,
    /// Seeds: a replicate each.
    pub seeds: Vec<u64>,
    /// `--set`s of all policies, before their own.
    pub sets: Vec<String>,
    /// The policy for whose passing order the centralised optimum is sought, if it is.
    pub joint: Option<String>,
}

impl Comparison {
    /// The command that makes it.
    pub fn command(&self) -> String {
        let quoted = |word: &str| match word.contains([' ', ';', '\'', '"', '{', '*']) {
            true => format!("'{}'", word.replace('\'', "'\\''")),
            false => word.to_owned(),
        };
        let mut text = "cz compare".to_owned();
        let mut add = |word: &str| {
            text.push(' ');
            text.push_str(&quoted(word));
        };
        self.policies.iter().for_each(|policy| add(policy));
        if let Some(scenario) = &self.scenario {
            ["--scenario", scenario].iter().for_each(|word| add(word));
        }
        let (from, to) = (self.seeds.first().unwrap_or(&1), self.seeds.last().unwrap_or(&1));
        ["--seeds", &format!("{from}-{to}")].iter().for_each(|word| add(word));
        self.sets.iter().for_each(|set| ["--set", set].iter().for_each(|word| add(word)));
        if let Some(policy) = &self.joint {
            ["--joint", policy].iter().for_each(|word| add(word));
        }
        text
    }
}

/// How it is done.
#[derive(Debug)]
pub struct Means {
    /// Threads.
    pub jobs: usize,
    /// Where results are kept.
    pub cache: Cache,
}

/// Why a comparison failed.
#[derive(Debug, thiserror::Error)]
pub enum CompareError {
    /// A policy is no good.
    #[error("policy {name}: {message}")]
    Policy {
        /// As it was named.
        name: String,
        /// What is wrong.
        message: String,
    },
    /// A scenario under a policy is no good.
    #[error("policy {name}: {source}")]
    Scenario {
        /// The policy.
        name: String,
        /// What is wrong.
        source: Box<ScenarioError>,
    },
    /// An argument is no good.
    #[error("{0}")]
    Usage(String),
    /// A run, a figure or a file failed.
    #[error(transparent)]
    Failed(#[from] ReproduceError),
}

/// What a comparison is at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Work {
    /// Running the policies.
    Runs,
    /// Working out rigorous bounds.
    Bounds,
    /// Seeking centralised optima.
    Optima,
}

impl Work {
    /// What there is a number of.
    pub fn name(self) -> &'static str {
        match self {
            Work::Runs => "runs",
            Work::Bounds => "bounds",
            Work::Optima => "optima",
        }
    }
}

/// Told how many of what are done, of how many known so far.
pub type Progress<'a> = dyn FnMut(Work, usize, usize) + 'a;

/// One run: a seed under `--set`s.
type Key = (u64, Vec<String>);

/// Performed runs.
struct Performed<'a> {
    comparison: &'a Comparison,
    means: &'a Means,
    samples: BTreeMap<Key, (Arc<Scenario>, Sample)>,
    total: usize,
}

impl Performed<'_> {
    fn key(&self, seed: u64, sets: Vec<String>) -> Key {
        (seed, self.comparison.sets.iter().cloned().chain(sets).collect())
    }

    /// Does the runs, each named by the policy it is for.
    fn perform(
        &mut self,
        wanted: impl IntoIterator<Item = (String, Key)>,
        progress: &mut Progress<'_>,
    ) -> Result<(), CompareError> {
        let mut seen = BTreeSet::new();
        let missing: Vec<(String, Key)> = wanted
            .into_iter()
            .filter(|(_, key)| !self.samples.contains_key(key) && seen.insert(key.clone()))
            .collect();
        self.total += missing.len();
        let (before, total) = (self.samples.len(), self.total);
        let argument = self.comparison.scenario.as_deref();
        let mut fresh = BTreeMap::new();
        let work = |(name, key): &(String, Key)| {
            let (seed, sets) = key;
            let scenario = load(argument, *seed, sets)
                .map_err(|source| CompareError::Scenario { name: name.clone(), source: Box::new(source) })?;
            let sample = if scenario.plugins.is_empty() {
                self.means.cache.sample(&scenario, name)?
            } else {
                // What other programs have to do with it may change with them, so it is not kept.
                processes::sample(argument, *seed, sets, name)?
            };
            Ok((scenario, sample))
        };
        parallel::each(self.means.jobs, &missing, work, |(_, key), result: (Arc<Scenario>, Sample)| {
            fresh.insert(key.clone(), result);
            progress(Work::Runs, before + fresh.len(), total);
        })
        .map_err(|error: CompareError| error)?;
        self.samples.append(&mut fresh);
        Ok(())
    }
}

/// A scenario with a seed and `--set`s.
pub fn load(argument: Option<&str>, seed: u64, sets: &[String]) -> Result<Arc<Scenario>, ScenarioError> {
    let overrides = sets.iter().map(|set| set.parse()).collect::<Result<Vec<Override>, _>>()?;
    Ok(Arc::new(scenario::load(argument, &overrides, Some(seed))?))
}

/// Compares.
pub fn run(
    comparison: &Comparison,
    means: &Means,
    progress: &mut Progress<'_>,
) -> Result<Block, CompareError> {
    if comparison.policies.is_empty() || comparison.seeds.is_empty() {
        return Err(CompareError::Usage(format!("expected a policy; known are {}", policy::known())));
    }
    let mut performed = Performed { comparison, means, samples: BTreeMap::new(), total: 0 };
    let first = performed.key(comparison.seeds[0], Vec::new());
    let base = load(comparison.scenario.as_deref(), first.0, &first.1)
        .map_err(|source| CompareError::Usage(source.to_string()))?;
    let policies = comparison.policies.iter().map(|name| policy::find(name, &base.network));
    let policies: Vec<Policy> = policies.collect::<Result<_, _>>()?;
    for (at, name) in comparison.policies.iter().enumerate() {
        if comparison.policies[..at].contains(name) {
            return Err(CompareError::Usage(format!("policy {name}: named twice; expected once")));
        }
    }
    let named = |name: &String| {
        let at = policies.iter().position(|policy| policy.name == *name);
        at.ok_or_else(|| {
            CompareError::Usage(format!("--joint {name}: expected one of the policies compared"))
        })
    };
    let ordered_by = comparison.joint.as_ref().map(named).transpose()?;
    let exit_mps = exit_speed(&policies, &mut performed, progress)?;

    let key = |performed: &Performed<'_>, seed, member: &Member| performed.key(seed, member.sets(exit_mps));
    let mut wanted = Vec::new();
    for policy in &policies {
        for member in &policy.members {
            let keys = comparison.seeds.iter().map(|&seed| key(&performed, seed, member));
            wanted.extend(keys.map(|key| (policy.name.clone(), key)));
        }
    }
    performed.perform(wanted, progress)?;

    // Of a group, the cheapest member per replicate; a jam is never the cheapest.
    let cheapest = |policy: &Policy, seed: u64| -> (Key, usize) {
        let keys: Vec<Key> = policy.members.iter().map(|m| key(&performed, seed, m)).collect();
        let total = |at: &usize| {
            let total = performed.samples[&keys[*at]].1.total();
            if total.is_nan() { f64::INFINITY } else { total }
        };
        let at = (0..keys.len()).min_by(|a, b| total(a).total_cmp(&total(b))).expect("a policy has members");
        (keys[at].clone(), at)
    };
    let taken: Vec<Vec<(Key, usize)>> = policies
        .iter()
        .map(|policy| comparison.seeds.iter().map(|&seed| cheapest(policy, seed)).collect())
        .collect();
    let bounds = bounds(&taken, &performed, progress)?;
    let mut rows: Vec<Vec<Row>> = Vec::new();
    for keys in &taken {
        let of = |(&seed, (key, member)): (&u64, &(Key, usize))| Row {
            seed,
            member: *member,
            sample: performed.samples[key].1.clone(),
            bounds: bounds[key].clone(),
            joint: None,
        };
        rows.push(comparison.seeds.iter().zip(keys).map(of).collect());
    }
    if let Some(at) = ordered_by {
        seek_joint(&taken[at], &mut rows, &performed, progress)?;
    }
    Ok(Block::new(comparison, &policies, exit_mps, &rows))
}

/// The paper's terminal speed of zones that lead out: the mean exit speed without flow control over all replicates,
/// to 0.1 m/s; 0 when no policy needs it.
fn exit_speed(
    policies: &[Policy],
    performed: &mut Performed<'_>,
    progress: &mut Progress<'_>,
) -> Result<f64, CompareError> {
    if policies.iter().flat_map(|p| &p.members).all(|m| m.measured.is_empty()) {
        return Ok(0.0);
    }
    let baseline = policy::without_control();
    let seeds = &performed.comparison.seeds;
    let keys: Vec<Key> = seeds.iter().map(|&s| performed.key(s, baseline.sets.clone())).collect();
    performed.perform(keys.iter().map(|key| ("paper-none".to_owned(), key.clone())), progress)?;
    let exits: Vec<f64> = keys.iter().map(|key| performed.samples[key].1.exit_mps()).collect();
    Ok(measured_exit_mps(&exits))
}

/// The paper's terminal speed of zones that lead out, m/s, of the mean exit speeds of replicates without flow control.
pub fn measured_exit_mps(exits_mps: &[f64]) -> f64 {
    let mean = exits_mps.iter().sum::<f64>() / exits_mps.len() as f64;
    (10.0 * mean).round() / 10.0
}

/// The rigorous bounds of the runs that were taken; runs with the same vehicles share them.
fn bounds(
    taken: &[Vec<(Key, usize)>],
    performed: &Performed<'_>,
    progress: &mut Progress<'_>,
) -> Result<BTreeMap<Key, Bounds>, CompareError> {
    let mut alike: Vec<Vec<&Key>> = Vec::new();
    for key in taken.iter().flatten().map(|(key, _)| key).collect::<BTreeSet<_>>() {
        let (scenario, sample) = &performed.samples[key];
        let same = |keys: &&mut Vec<&Key>| {
            let (other, there) = &performed.samples[keys[0]];
            scenario.network.zones.iter().zip(&other.network.zones).all(|(a, b)| a.same_shape(b))
                && (scenario.beta, scenario.vehicle) == (other.beta, other.vehicle)
                && sample.entrants() == there.entrants()
        };
        match alike.iter_mut().find(same) {
            Some(keys) => keys.push(key),
            None => alike.push(vec![key]),
        }
    }
    let mut found = BTreeMap::new();
    let work = |keys: &Vec<&Key>| {
        let (scenario, sample) = &performed.samples[keys[0]];
        performed.means.cache.bounds(scenario, sample)
    };
    let (mut done, total) = (0, alike.len());
    progress(Work::Bounds, done, total);
    parallel::each(performed.means.jobs, &alike, work, |keys, bounds: Bounds| {
        found.extend(keys.iter().map(|key| ((*key).clone(), bounds.clone())));
        done += 1;
        progress(Work::Bounds, done, total);
    })?;
    Ok(found)
}

/// Seeks the centralised optimum of each replicate for the order in which a policy's vehicles passed.
fn seek_joint(
    taken: &[(Key, usize)],
    rows: &mut [Vec<Row>],
    performed: &Performed<'_>,
    progress: &mut Progress<'_>,
) -> Result<(), CompareError> {
    let replicates: Vec<(usize, &Key)> = taken.iter().map(|(key, _)| key).enumerate().collect();
    let mut found: BTreeMap<usize, Option<joint::Found>> = BTreeMap::new();
    progress(Work::Optima, 0, replicates.len());
    let work = |&(_, key): &(usize, &Key)| {
        let (scenario, sample) = &performed.samples[key];
        performed.means.cache.joint(scenario, sample)
    };
    parallel::each(performed.means.jobs, &replicates, work, |(at, _), result| {
        found.insert(*at, result);
        progress(Work::Optima, found.len(), replicates.len());
    })?;
    for policy_rows in rows {
        for (at, row) in policy_rows.iter_mut().enumerate() {
            row.joint = found[&at].clone();
        }
    }
    Ok(())
}
