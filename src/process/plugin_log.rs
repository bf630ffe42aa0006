//! How controllers written elsewhere have fared: how long they took to answer, how often they ended, and who drives
//! their vehicles now.

use super::LatencyUs;
use crate::scenario::{OnExit, Plugin, Scenario};
use hdrhistogram::Histogram;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// How a controller written elsewhere has fared.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PluginRow {
    /// Its name.
    pub controller: String,
    /// What was to become of its vehicles when its process ended.
    pub on_exit: OnExit,
    /// How often its process ended in the middle of the run.
    pub exits: u32,
    /// How often its place was taken anew.
    pub generation: u32,
    /// Who drove its vehicles when the run was over.
    pub driven_by: DrivenBy,
    /// Steps it answered.
    pub answered: u64,
    /// Deadlines it missed.
    pub missed: u64,
    /// From the state's publication to its answer, us, of the steps it answered; with the waiting for coordinators in
    /// it, where one acted, and as fine as the world looks. `null` where it answered none.
    pub answer_time_us: Option<LatencyUs>,
}

/// Who drives the vehicles of a controller written elsewhere.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DrivenBy {
    /// The controller itself.
    Plugin,
    /// The built-in law.
    Builtin,
    /// Nobody: they make for their speed limits as far as the shield allows.
    ShieldFallback,
}

impl DrivenBy {
    /// The word for it.
    pub fn name(self) -> &'static str {
        match self {
            DrivenBy::Plugin => "itself",
            DrivenBy::Builtin => "the built-in law",
            DrivenBy::ShieldFallback => "the shield",
        }
    }
}

/// Keeps count of them.
#[derive(Debug)]
pub(super) struct PluginLog {
    rows: Vec<Row>,
    /// Number of controllers of the built-in pool, which come first.
    pool: u32,
    /// When the state of the step at hand was published, and who has not answered it yet, one bit each.
    asked: Option<(Instant, u64)>,
}

#[derive(Debug)]
struct Row {
    name: String,
    on_exit: OnExit,
    exits: u32,
    generation: u32,
    /// Up to which generation, itself not among them, it is known that they have ended.
    ended: u32,
    driven_by: DrivenBy,
    answer_ns: Histogram<u64>,
}

impl PluginLog {
    pub fn new(scenario: &Scenario, pool: u32) -> PluginLog {
        let row = |plugin: &Plugin| Row {
            name: plugin.name.clone(),
            on_exit: plugin.on_exit,
            exits: 0,
            generation: 0,
            ended: 0,
            driven_by: DrivenBy::Plugin,
            answer_ns: super::new_histogram(),
        };
        PluginLog { rows: scenario.plugins.iter().map(row).collect(), pool, asked: None }
    }

    fn row(&mut self, controller: u32) -> Option<&mut Row> {
        let plugin = controller.checked_sub(self.pool)?;
        self.rows.get_mut(plugin as usize)
    }

    /// What is to become of the vehicles of a controller that ends; `None` of one of the pool.
    pub fn on_exit(&self, controller: u32) -> Option<OnExit> {
        let row = self.rows.get(controller.checked_sub(self.pool)? as usize)?;
        Some(row.on_exit)
    }

    /// A state has been published, which these are to answer, one bit each; nobody answers the last.
    pub fn asked(&mut self, all: u64) {
        if self.rows.is_empty() {
            return;
        }
        let drive = |(row, index): (&Row, u32)| u64::from(row.driven_by == DrivenBy::Plugin) << index;
        let plugins: u64 = self.rows.iter().zip(self.pool..).map(drive).sum();
        self.asked = Some((Instant::now(), all & plugins));
    }

    /// These controllers, one bit each, have not answered yet.
    #[inline]
    pub fn still_missing(&mut self, missing: u64) {
        let Some((at, waiting)) = self.asked else { return };
        let answered = waiting & !missing;
        if answered == 0 {
            return;
        }
        let took = at.elapsed();
        self.asked = Some((at, waiting & missing));
        for (row, _) in self.rows.iter_mut().zip(self.pool..).filter(|(_, i)| answered >> i & 1 == 1) {
            // Only an absurd time could not be recorded.
            let _ = row.answer_ns.record(took.as_nanos() as u64);
        }
    }

    /// The step goes on without those that have not answered.
    pub fn gave_up(&mut self) {
        self.asked = None;
    }

    /// The process of a controller has ended.
    pub fn exited(&mut self, controller: u32) {
        if let Some(row) = self.row(controller) {
            row.exits += 1;
            row.ended = row.generation + 1;
            if row.on_exit == OnExit::ShieldFallback {
                row.driven_by = DrivenBy::ShieldFallback;
            }
        }
    }

    /// Its place has been taken anew, by one of ours or not. Returns how many ends of the controller nobody had noticed:
    /// of the process before, while nobody was waited for, and of those that had the place and died before they could begin.
    pub fn taken(&mut self, controller: u32, generation: u32, stands_in: bool) -> u32 {
        let Some(row) = self.row(controller) else { return 0 };
        // That one of ours has ended is no end of the controller's.
        let is_another = generation > row.generation;
        let before =
            u32::from(is_another && row.ended <= row.generation && row.driven_by != DrivenBy::Builtin);
        let between =
            if stands_in { 0 } else { generation.saturating_sub(row.ended.max(row.generation + 1)) };
        row.exits += before + between;
        row.generation = generation;
        row.ended = generation;
        row.driven_by = if stands_in { DrivenBy::Builtin } else { DrivenBy::Plugin };
        before + between
    }

    /// What it has come to; `missed` says of each controller by its index how many deadlines it has missed.
    pub fn report(&self, missed: impl Fn(u32) -> u64) -> Vec<PluginRow> {
        let row = |(row, index): (&Row, u32)| {
            let us = |quantile| row.answer_ns.value_at_quantile(quantile) as f64 / 1e3;
            let max = row.answer_ns.max() as f64 / 1e3;
            let times = || LatencyUs { p50: us(0.5), p99: us(0.99), p999: us(0.999), max };
            PluginRow {
                controller: row.name.clone(),
                on_exit: row.on_exit,
                exits: row.exits,
                generation: row.generation,
                driven_by: row.driven_by,
                answered: row.answer_ns.len(),
                missed: missed(index),
                answer_time_us: (!row.answer_ns.is_empty()).then(times),
            }
        };
        self.rows.iter().zip(self.pool..).map(row).collect()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::scenario::load_embedded;

    #[test]
    fn each_generation_but_the_first_had_an_exit_before_it_whoever_noticed() {
        let mut scenario = load_embedded("two-merges", &[], None).unwrap();
        let paths = vec![(1, 0), (1, 1)];
        scenario.plugins =
            vec![Plugin { name: "mine".into(), paths, command: None, on_exit: OnExit::Restart }];
        let mut log = PluginLog::new(&scenario, 1);
        let row = |log: &PluginLog| log.report(|_| 0).remove(0);
        log.exited(1);
        assert_eq!(log.taken(1, 1, false), 0, "that was noticed");
        assert_eq!(log.taken(1, 2, false), 1, "nobody was waited for when it ended");
        log.exited(1);
        assert_eq!(log.taken(1, 5, false), 2, "two had the place before it, and could not begin");
        log.exited(1);
        let now = row(&log);
        assert_eq!((now.exits, now.generation, now.driven_by), (6, 5, DrivenBy::Plugin));
        assert_eq!(log.taken(1, 7, true) + log.taken(1, 8, true), 0, "ours were replaced");
        assert_eq!((row(&log).exits, row(&log).driven_by), (6, DrivenBy::Builtin));
        // The pool's are none of them.
        assert!(log.taken(0, 7, false) == 0 && log.on_exit(0).is_none());
    }
}
