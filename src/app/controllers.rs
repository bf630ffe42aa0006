//! `cz run --controller TARGET=COMMAND`: a controller of one's own, without editing a scenario.

use super::AppError;
use super::args::{RunArgs, ScenarioArgs};
use super::supervise::Programs;
use crate::scenario::{OnExit, Plugin, Scenario, declaration, target_and_command};

/// The scenario arguments with `--controller`, `--on-exit` and `--reload` turned into `--set`s, and the scenario they give.
pub(super) fn load(scenario: &ScenarioArgs, run: &RunArgs) -> Result<(ScenarioArgs, Scenario), AppError> {
    let (mut arguments, mut loaded) = declare(scenario, &run.controllers)?;
    for text in &run.on_exit {
        let (target, choice) = text.split_once('=').unwrap_or_default();
        let name = name_of(target);
        let choices = OnExit::ALL.map(OnExit::name).join(", ");
        let Some(choice) = OnExit::of(choice) else {
            let expected = format!("TARGET=CHOICE, CHOICE one of {choices}");
            return Err(AppError::Usage(format!("--on-exit {text}: expected {expected}")));
        };
        if !loaded.plugins.iter().any(|p| p.name == name) {
            let names: Vec<_> = loaded.plugins.iter().map(|p| p.name.as_str()).collect();
            let known = match names.is_empty() {
                true => "the run has no controllers written elsewhere; add --controller".to_owned(),
                false => format!("expected a controller of the run: {}", names.join(", ")),
            };
            return Err(AppError::Usage(format!("--on-exit {text}: {known}")));
        }
        arguments.set.push(format!("controllers.{name}.on_exit=\"{}\"", choice.name()));
    }
    if !run.on_exit.is_empty() {
        loaded = arguments.load()?;
    }
    if run.reload {
        arguments.set.extend(reloading(&loaded)?);
        loaded = arguments.load()?;
    }
    Ok((arguments, loaded))
}

/// What has controllers that may be started again be so, and the check that there is something to be watched.
fn reloading(scenario: &Scenario) -> Result<Vec<String>, AppError> {
    let mut set = Vec::new();
    for Plugin { name, command, on_exit, .. } in &scenario.plugins {
        let Some(command) = command.as_ref().filter(|_| matches!(on_exit, OnExit::End | OnExit::Restart))
        else {
            continue;
        };
        if Programs::of(command).is_none() {
            let expected = "expected one that names an executable by its path, or a .py file";
            return Err(AppError::Usage(format!(
                "--reload: command of controller {name}, {command}: {expected}"
            )));
        }
        set.push(format!("controllers.{name}.on_exit=\"{}\"", OnExit::Restart.name()));
    }
    if set.is_empty() {
        let expected = "a controller with a command, and --on-exit end or restart";
        return Err(AppError::Usage(format!("--reload: expected {expected}")));
    }
    Ok(set)
}

/// The name of the controller declared for a target.
pub(super) fn name_of(target: &str) -> String {
    target.replace('.', "-").replace(',', "_")
}

/// The scenario arguments with `--controller`s turned into `--set`s, and the scenario they give.
///
/// A target is the name of a controller the scenario declares, whose command it becomes, or a list of
/// zones and paths (`merge-1,merge-2.main`) for which a controller is declared.
fn declare(scenario: &ScenarioArgs, controllers: &[String]) -> Result<(ScenarioArgs, Scenario), AppError> {
    let loaded = scenario.load()?;
    if controllers.is_empty() {
        return Ok((scenario.clone(), loaded));
    }
    let mut arguments = scenario.clone();
    let mut declared = Vec::new();
    for text in controllers {
        let (target, command) =
            target_and_command(text).map_err(|problem| AppError::Usage(format!("--controller {problem}")))?;
        if loaded.plugins.iter().any(|p| p.name == target) {
            let command = toml::Value::String(command.to_owned());
            arguments.set.push(format!("controllers.{target}.command={command}"));
            continue;
        }
        if !loaded.plugins.is_empty() {
            let names: Vec<_> = loaded.plugins.iter().map(|p| p.name.as_str()).collect();
            let names = names.join(", ");
            return Err(AppError::Usage(format!(
                "--controller {text}: the scenario declares its controllers; expected one of {names}"
            )));
        }
        declared.push(text.clone());
    }
    let declared = declaration(&declared).map_err(AppError::Usage)?;
    arguments.set.extend(declared);
    let loaded = arguments.load()?;
    Ok((arguments, loaded))
}
