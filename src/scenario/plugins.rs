//! Which controller drives which paths, and what the gateway does with its commands.

use super::{Scenario, ZoneId};
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// A controller written elsewhere, which joins the run as a process of its own.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Plugin {
    /// Unique name; the process gives it when it attaches.
    pub name: String,
    /// The paths it drives: zone and path, ascending.
    pub paths: Vec<(ZoneId, u32)>,
    /// Command line with which `cz run` starts it; absent when somebody else does.
    pub command: Option<String>,
    /// What becomes of its vehicles when its process ends in the middle of the run.
    #[serde(default)]
    pub on_exit: OnExit,
}

/// What becomes of the vehicles of a controller written elsewhere when its process ends in the middle of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnExit {
    /// The run ends with it.
    #[default]
    End,
    /// The run waits until it has been started again.
    Restart,
    /// The run waits for a controller of ours, which drives them from then on.
    Builtin,
    /// They make for their speed limits from then on, as far as the shield allows.
    ShieldFallback,
}

impl OnExit {
    /// All of them.
    pub const ALL: [OnExit; 4] = [OnExit::End, OnExit::Restart, OnExit::Builtin, OnExit::ShieldFallback];

    /// The word for it in scenarios, on the command line and in summaries.
    pub fn name(self) -> &'static str {
        match self {
            OnExit::End => "end",
            OnExit::Restart => "restart",
            OnExit::Builtin => "builtin",
            OnExit::ShieldFallback => "shield-fallback",
        }
    }

    /// The one of that name.
    pub fn of(name: &str) -> Option<OnExit> {
        OnExit::ALL.into_iter().find(|choice| choice.name() == name)
    }
}

impl Plugin {
    /// FNV-1a of the name: what a plug-in puts into its attach request. Chosen because it takes three
    /// lines in any language.
    pub fn name_hash(&self) -> u64 {
        ipc_schemas::name_hash(&self.name)
    }
}

/// The `--set` that declares controllers given as TARGET=COMMAND, TARGET being zones and paths such as
/// `merge-1,merge-2.main`; none when there are none.
///
/// # Errors
/// What is expected in place of one that is not of this form.
pub fn declaration(controllers: &[String]) -> Result<Option<String>, String> {
    let quote = |text: &str| toml::Value::String(text.to_owned()).to_string();
    let declared = controllers.iter().map(|text| {
        let (target, command) = target_and_command(text)?;
        let (paths, zones): (Vec<_>, Vec<_>) = target.split(',').partition(|t| t.contains('.'));
        let list = |key: &str, items: &[&str]| match items {
            [] => String::new(),
            _ => format!("{key} = [{}], ", items.iter().map(|i| quote(i)).collect::<Vec<_>>().join(", ")),
        };
        Ok(format!(
            "{{name = {}, {}{}command = {}}}",
            quote(&target.replace('.', "-").replace(',', "_")),
            list("zones", &zones),
            list("paths", &paths),
            quote(command)
        ))
    });
    let declared = declared.collect::<Result<Vec<String>, String>>()?;
    Ok((!declared.is_empty()).then(|| format!("controllers=[{}]", declared.join(", "))))
}

/// The two parts of TARGET=COMMAND.
///
/// # Errors
/// What is expected in place of something else.
pub fn target_and_command(text: &str) -> Result<(&str, &str), String> {
    let parts = text.split_once('=').filter(|(target, command)| !target.is_empty() && !command.is_empty());
    parts.ok_or_else(|| format!("{text}: expected TARGET=COMMAND, such as merge-2=\"python3 mine.py\""))
}

/// What the actuation gateway does with commands that are not safe.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ShieldMode {
    /// They are applied.
    #[default]
    Off,
    /// They are applied, and counted.
    Observe,
    /// They are replaced by the nearest safe ones, and counted.
    On,
}

impl ShieldMode {
    /// The word for it in scenarios and summaries.
    pub fn name(self) -> &'static str {
        match self {
            ShieldMode::Off => "off",
            ShieldMode::Observe => "observe",
            ShieldMode::On => "on",
        }
    }
}

/// Which controller process drives which path: the built-in pool's processes come first, then the
/// plug-ins in order of declaration.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Drivers {
    pool: u32,
    plugins: u32,
    /// Controller index by zone and path.
    of: Vec<Vec<u32>>,
    /// By zone, the controller of all its paths, if it is one.
    of_zone: Vec<Option<u32>>,
    /// By controller, the zones outside which it drives nothing.
    zones: Vec<Range<ZoneId>>,
}

impl Drivers {
    /// The drivers of a run with so many controller processes in all.
    ///
    /// # Panics
    /// When these are fewer than the plug-ins.
    pub fn new(scenario: &Scenario, controllers: u32) -> Drivers {
        let plugins = scenario.plugins.len() as u32;
        let pool = controllers.checked_sub(plugins).expect("every plug-in is a controller process");
        let count = scenario.network.zones.len() as u32;
        let mut of: Vec<Vec<u32>> =
            scenario.network.zones.iter().map(|z| vec![u32::MAX; z.paths.len()]).collect();
        let mut zones: Vec<Range<ZoneId>> =
            (0..pool).map(|index| super::share::zones_of(count, index, pool)).collect();
        for (index, range) in (0..).zip(&zones) {
            range.clone().for_each(|zone| of[zone as usize].fill(index));
        }
        for (plugin, index) in scenario.plugins.iter().zip(pool..) {
            for &(zone, path) in &plugin.paths {
                of[zone as usize][path as usize] = index;
            }
            let first = plugin.paths.iter().map(|&(zone, _)| zone).min();
            let last = plugin.paths.iter().map(|&(zone, _)| zone).max();
            zones.push(first.zip(last).map_or(0..0, |(first, last)| first..last + 1));
        }
        let of_zone = of.iter().map(|of| of.iter().all(|&o| o == of[0]).then(|| of[0])).collect();
        Drivers { pool, plugins, of, of_zone, zones }
    }

    /// The controller that drives a path.
    pub fn of(&self, zone: ZoneId, path: u32) -> u32 {
        self.of[zone as usize][path as usize]
    }

    /// The controller that drives all paths of a zone, if it is one.
    pub fn of_zone(&self, zone: ZoneId) -> Option<u32> {
        self.of_zone[zone as usize]
    }

    /// Zones outside which a controller drives nothing.
    pub fn zones(&self, controller: u32) -> Range<ZoneId> {
        self.zones[controller as usize].clone()
    }

    /// Number of processes of the built-in pool.
    pub fn pool(&self) -> u32 {
        self.pool
    }

    /// Number of controller processes in all.
    pub fn count(&self) -> u32 {
        self.pool + self.plugins
    }
}

/// What the controllers of a run are called in messages: those written elsewhere as the user named them, the others
/// by their number.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ControllerNames {
    pool: u32,
    plugins: Vec<String>,
}

impl ControllerNames {
    /// The names in a run with so many controller processes in all.
    pub fn new(scenario: &Scenario, controllers: u32) -> ControllerNames {
        let plugins: Vec<String> = scenario.plugins.iter().map(|p| p.name.clone()).collect();
        ControllerNames { pool: controllers.saturating_sub(plugins.len() as u32), plugins }
    }

    /// What to call a controller.
    pub fn of(&self, index: u32) -> String {
        let plugin = index.checked_sub(self.pool).and_then(|i| self.plugins.get(i as usize));
        plugin.map_or_else(|| format!("controller {index}"), |name| format!("controller {name}"))
    }
}

impl Scenario {
    /// Whether a path is driven by a plug-in.
    pub fn is_plugged(&self, zone: ZoneId, path: u32) -> bool {
        self.plugins.iter().any(|p| p.paths.contains(&(zone, path)))
    }

    /// Number of controller processes of a run whose built-in pool may have `pool` of them: none when
    /// plug-ins drive every path.
    pub fn controllers(&self, pool: u32) -> u32 {
        let paths: usize = self.network.zones.iter().map(|z| z.paths.len()).sum();
        let plugged: usize = self.plugins.iter().map(|p| p.paths.len()).sum();
        let pool = if plugged == paths { 0 } else { pool };
        pool + self.plugins.len() as u32
    }

    /// The same scenario with the built-in law in place of every plug-in.
    pub fn without_plugins(&self) -> Scenario {
        Scenario { plugins: Vec::new(), ..self.clone() }
    }
}
