//! `cz run --controller TARGET=COMMAND`: a controller of one's own, without editing a scenario.

use super::AppError;
use super::args::ScenarioArgs;
use crate::scenario::Scenario;

/// The scenario arguments with `--controller`s turned into `--set`s, and the scenario they give.
///
/// A target is the name of a controller the scenario declares, whose command it becomes, or a list of
/// zones and paths (`merge-1,merge-2.main`) for which a controller is declared.
pub(super) fn load(
    scenario: &ScenarioArgs,
    controllers: &[String],
) -> Result<(ScenarioArgs, Scenario), AppError> {
    let loaded = scenario.load()?;
    if controllers.is_empty() {
        return Ok((scenario.clone(), loaded));
    }
    let quote = |text: &str| toml::Value::String(text.to_owned()).to_string();
    let mut arguments = scenario.clone();
    let mut declared = Vec::new();
    for text in controllers {
        let Some((target, command)) = text.split_once('=').filter(|(t, c)| !t.is_empty() && !c.is_empty())
        else {
            let expected = "TARGET=COMMAND, such as merge-2=\"python3 mine.py\"";
            return Err(AppError::Usage(format!("--controller {text}: expected {expected}")));
        };
        if loaded.plugins.iter().any(|p| p.name == target) {
            arguments.set.push(format!("controllers.{target}.command={}", quote(command)));
            continue;
        }
        if !loaded.plugins.is_empty() {
            let names: Vec<_> = loaded.plugins.iter().map(|p| p.name.as_str()).collect();
            let names = names.join(", ");
            return Err(AppError::Usage(format!(
                "--controller {text}: the scenario declares its controllers; expected one of {names}"
            )));
        }
        let (paths, zones): (Vec<_>, Vec<_>) = target.split(',').partition(|t| t.contains('.'));
        let list = |key: &str, items: &[&str]| match items {
            [] => String::new(),
            _ => format!("{key} = [{}], ", items.iter().map(|i| quote(i)).collect::<Vec<_>>().join(", ")),
        };
        declared.push(format!(
            "{{name = {}, {}{}command = {}}}",
            quote(&target.replace('.', "-").replace(',', "_")),
            list("zones", &zones),
            list("paths", &paths),
            quote(command)
        ));
    }
    if !declared.is_empty() {
        arguments.set.push(format!("controllers=[{}]", declared.join(", ")));
    }
    let loaded = arguments.load()?;
    Ok((arguments, loaded))
}
