//! `--set key=value`: values written over those of the scenario file.

use super::document::{Document, Node, Origin, Value, parse_value};
use super::error::{ScenarioError, nearest, printable};
use std::collections::BTreeMap;
use std::str::FromStr;

/// One `--set key=value`.
///
/// Keys are dotted. An element of an array of tables is addressed by its `name` or by its index from 0:
/// `zones.merge-1.flow.terminal_mps`, `roads.0.demand.trace`; `*` means all of them: `zones.*.flow`. The value is TOML; what is not TOML is taken
/// as a string, so that `control.replan=from_state` needs no quotes. A whole table can be replaced by an
/// inline table.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Override {
    /// What follows `--set`, in one line.
    text: String,
    path: Vec<String>,
    value: String,
}

impl FromStr for Override {
    type Err = ScenarioError;

    fn from_str(text: &str) -> Result<Self, ScenarioError> {
        let shown = printable(text);
        let error = |message: String| ScenarioError::Override { set: shown.clone(), message };
        let (key, value) =
            text.split_once('=').ok_or_else(|| error("no '='; expected key=value".to_owned()))?;
        let path: Vec<String> = key.split('.').map(|part| part.trim().to_owned()).collect();
        if path.iter().any(String::is_empty) {
            return Err(error("empty key; expected a dotted key such as end.vehicles".to_owned()));
        }
        // Nothing in a scenario is nested this deep; a tree of any depth would be.
        if path.len() > 16 {
            return Err(error("expected a key of at most 16 parts".to_owned()));
        }
        let value = value.trim().to_owned();
        // Checked here so that the command line is refused before anything is read. A value that opens a
        // TOML bracket or quote is meant as TOML: its syntax error must not silently become a string.
        if let Err(message) = parse_value(&value, Origin::Set(0))
            && value.starts_with(['[', '{', '"', '\''])
        {
            return Err(error(format!("not valid TOML: {message}; expected a TOML value")));
        }
        Ok(Self { text: shown, path, value })
    }
}

impl Override {
    /// Writes the value into the document.
    pub(super) fn apply(&self, document: &mut Document) -> Result<(), ScenarioError> {
        let origin = Origin::Set(document.sets.len());
        document.sets.push(self.text.clone());
        let value = parse_value(&self.value, origin)
            .unwrap_or_else(|_| Node { origin, value: Value::String(self.value.clone()) });
        self.write(&mut document.root, 0, &value, origin)
    }

    /// Writes the value where the rest of the key leads from a node.
    fn write(
        &self,
        node: &mut Node,
        depth: usize,
        value: &Node,
        origin: Origin,
    ) -> Result<(), ScenarioError> {
        let Some(part) = self.path.get(depth) else {
            *node = value.clone();
            return Ok(());
        };
        if let (Value::Array(items), "*") = (&mut node.value, part.as_str()) {
            return items.iter_mut().try_for_each(|item| self.write(item, depth + 1, value, origin));
        }
        let child = self.step(node, depth, part, origin)?;
        self.write(child, depth + 1, value, origin)
    }

    /// The child a part of the key leads to. Tables grow as needed: the schema tells later whether the key
    /// exists. Arrays do not.
    fn step<'a>(
        &self,
        node: &'a mut Node,
        depth: usize,
        part: &str,
        origin: Origin,
    ) -> Result<&'a mut Node, ScenarioError> {
        let error = |message: String| {
            Err(ScenarioError::Override { set: self.text.clone(), message: printable(&message) })
        };
        let parent = self.path[..depth].join(".");
        match &mut node.value {
            Value::Table(table) => Ok(table
                .entry(part.to_owned())
                .or_insert_with(|| Node { origin, value: Value::Table(BTreeMap::new()) })),
            Value::Array(items) => {
                let names: Vec<String> = items.iter().filter_map(|n| n.name().map(str::to_owned)).collect();
                let by_name = items.iter().position(|n| n.name() == Some(part));
                match by_name.or_else(|| part.parse().ok().filter(|&i: &usize| i < items.len())) {
                    Some(index) => Ok(&mut items[index]),
                    None => {
                        let hint = nearest(part, names.iter().map(String::as_str))
                            .map(|n| format!("; did you mean {n}?"))
                            .unwrap_or_default();
                        let known = match (items.len(), names.is_empty()) {
                            (0, _) => "nothing, it is empty".to_owned(),
                            (n, true) => format!("an index from 0 to {}", n - 1),
                            (n, false) => format!("{}, or an index from 0 to {}", names.join(", "), n - 1),
                        };
                        error(format!("{parent} has no element {part}; expected {known}{hint}"))
                    }
                }
            }
            value => error(format!("{parent} = {value}: has no keys; expected a table")),
        }
    }
}

impl Node {
    /// The `name` of a table.
    pub(super) fn name(&self) -> Option<&str> {
        let Value::Table(table) = &self.value else { return None };
        match &table.get("name")?.value {
            Value::String(name) => Some(name),
            _ => None,
        }
    }
}
