//! `cz run --controller TARGET=COMMAND`: a controller of one's own, without editing a scenario.

use super::AppError;
use super::args::ScenarioArgs;
use crate::scenario::{OnExit, Scenario, declaration, target_and_command};

/// The scenario arguments with `--controller`s and `--on-exit`s turned into `--set`s, and the scenario they give.
pub(super) fn load(
    scenario: &ScenarioArgs,
    controllers: &[String],
    on_exit: &[String],
) -> Result<(ScenarioArgs, Scenario), AppError> {
    let (mut arguments, mut loaded) = declare(scenario, controllers)?;
    for text in on_exit {
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
    if !on_exit.is_empty() {
        loaded = arguments.load()?;
    }
    Ok((arguments, loaded))
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
