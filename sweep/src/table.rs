//! The table of a sweep: a row per run.

use crate::outcome::measures;
use crate::plan::{Done, Wanted};
use cz_export::OutError;
use cz_export::parquet::ParquetFile;
use cz_export::tables::{Column, Sink, Table, Type, Value};
use std::path::Path;

fn column(name: &str, kind: Type, unit: Option<&'static str>, meaning: &str) -> Column {
    Column { name: name.to_owned(), kind, unit, meaning: meaning.to_owned() }
}

/// Its columns.
pub fn table() -> Table {
    let mut columns = vec![
        column("scenario", Type::Text, None, "Scenario as it was named."),
        column("policy", Type::Text, None, "Policy as it was named."),
        column("member", Type::Count, None, "Which member of the policy; 0 unless it is a group."),
        column("seed", Type::Count, None, "Seed."),
        column("sets", Type::Text, None, "What was set of the scenario, a KEY=VALUE per line."),
        column("scenario_hash", Type::Text, None, "Hash of the scenario that was run, seed included."),
        column("state_hash", Type::Text, None, "State hash of the run, as cz run prints it."),
        column("complete", Type::Truth, None, "Whether every vehicle got through."),
        column("vehicles", Type::Count, None, "Vehicles that got through."),
    ];
    for measure in measures() {
        columns.push(column(measure.id, Type::Number, measure.unit, measure.name));
    }
    columns.push(column("failure", Type::Text, None, "Why there is no outcome; absent where there is one."));
    Table { name: "sweep", columns }
}

/// Writes it.
///
/// # Errors
/// When the file cannot be written.
pub fn write(path: &Path, runs: &[Wanted], done: &Done) -> Result<(), OutError> {
    let table = table();
    let mut file = ParquetFile::begin(path, &table)?;
    for run in runs {
        let outcome = done.outcomes.get(&run.hash);
        let mut row = vec![
            Value::Text(run.scenario.clone()),
            Value::Text(run.policy.clone()),
            Value::Count(run.member as u64),
            Value::Count(run.seed),
            Value::Text(run.sets.join("\n")),
            Value::Text(format!("{:016x}", run.hash)),
        ];
        match outcome {
            Some(outcome) => {
                row.push(Value::Text(format!("{:016x}", outcome.state_hash)));
                row.push(Value::Truth(outcome.complete));
                row.push(Value::Count(outcome.vehicles));
                row.extend(outcome.values.iter().map(|value| value.map_or(Value::None, Value::Number)));
                row.push(Value::None);
            }
            None => {
                row.resize(table.columns.len() - 1, Value::None);
                row.push(done.failures.get(&run.hash).map_or(Value::None, |why| Value::Text(why.clone())));
            }
        }
        file.row(&row)?;
    }
    file.finish()
}
