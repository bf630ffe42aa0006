//! A TOML document as a tree in which every value knows where it was written.
//!
//! Not serde: a `--set` has no line in the file, so the origin of each value has to survive the merge of
//! file and command line, and most checks need a range, the origin and the key path together anyway.

use super::error::{Place, ScenarioError};
use std::collections::BTreeMap;
use std::fmt;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// Where a value comes from; [`Document::place`] puts it in words.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Origin {
    /// Line of the scenario file, from 1.
    Line(u64),
    /// Index of the `--set` that wrote it.
    Set(usize),
    /// The command line's `--seed`.
    Seed(u64),
}

/// A value and its origin.
#[derive(Clone, Debug)]
pub(super) struct Node {
    pub(super) origin: Origin,
    pub(super) value: Value,
}

/// A TOML value.
#[derive(Clone, Debug)]
pub(super) enum Value {
    String(String),
    /// TOML integers are i64 at least; i128 lets a seed use all of u64.
    Integer(i128),
    Float(f64),
    Boolean(bool),
    /// Dates, and numbers that fit no type: nothing in a scenario takes them, only messages show them.
    Other(String),
    Array(Vec<Node>),
    Table(BTreeMap<String, Node>),
}

/// The file's values with all `--set` applied.
pub(super) struct Document {
    pub(super) file: String,
    pub(super) sets: Vec<String>,
    pub(super) root: Node,
}

impl Document {
    /// Parses the text of a scenario file; `file` is its name in messages.
    pub(super) fn parse(file: &str, text: &str) -> Result<Self, ScenarioError> {
        let lines = Lines::new(text);
        let table = DeTable::parse(text).map_err(|e| ScenarioError::Syntax {
            place: Place::Line { file: file.to_owned(), line: lines.of(e.span().map_or(0, |s| s.start)) },
            message: one_line(e.message()),
        })?;
        let origin = |offset| Origin::Line(lines.of(offset));
        let root =
            Node { origin: Origin::Line(1), value: Value::Table(convert_table(table.get_ref(), &origin)) };
        Ok(Self { file: file.to_owned(), sets: Vec::new(), root })
    }

    /// An origin in words.
    pub(super) fn place(&self, origin: Origin) -> Place {
        match origin {
            Origin::Line(line) => Place::Line { file: self.file.clone(), line },
            Origin::Set(i) => Place::Set(self.sets[i].clone()),
            Origin::Seed(seed) => Place::Seed(seed),
        }
    }
}

/// Parses one TOML value, as the right-hand side of a `--set`.
pub(super) fn parse_value(text: &str, origin: Origin) -> Result<Node, String> {
    let value = DeValue::parse(text).map_err(|e| one_line(e.message()))?;
    Ok(convert(&value, &|_| origin))
}

fn convert_table(table: &DeTable<'_>, origin: &dyn Fn(usize) -> Origin) -> BTreeMap<String, Node> {
    let node = |key: &Spanned<_>, value| {
        let mut node = convert(value, origin);
        // A table made by a dotted key or header starts where its key is written.
        if matches!(node.value, Value::Table(_)) {
            node.origin = origin(key.span().start);
        }
        node
    };
    table.iter().map(|(key, value)| (key.get_ref().to_string(), node(key, value))).collect()
}

fn convert(value: &Spanned<DeValue<'_>>, origin: &dyn Fn(usize) -> Origin) -> Node {
    let converted = match value.get_ref() {
        DeValue::String(s) => Value::String(s.to_string()),
        DeValue::Integer(i) => match i128::from_str_radix(i.as_str(), i.radix()) {
            Ok(number) => Value::Integer(number),
            Err(_) => Value::Other(i.to_string()),
        },
        DeValue::Float(f) => match f.as_str().parse::<f64>() {
            // 1e999 is no infinity the user wrote.
            Ok(number) if number.is_finite() || f.as_str().contains("inf") || number.is_nan() => {
                Value::Float(number)
            }
            _ => Value::Other(f.to_string()),
        },
        DeValue::Boolean(b) => Value::Boolean(*b),
        DeValue::Datetime(d) => Value::Other(d.to_string()),
        DeValue::Array(a) => Value::Array(a.iter().map(|v| convert(v, origin)).collect()),
        DeValue::Table(t) => Value::Table(convert_table(t, origin)),
    };
    Node { origin: origin(value.span().start), value: converted }
}

/// Byte offsets at which lines end.
struct Lines(Vec<usize>);

impl Lines {
    fn new(text: &str) -> Self {
        Self(text.bytes().enumerate().filter(|(_, b)| *b == b'\n').map(|(i, _)| i).collect())
    }

    /// Line number, from 1, of a byte offset.
    fn of(&self, offset: usize) -> u64 {
        1 + self.0.partition_point(|end| *end < offset) as u64
    }
}

fn one_line(message: &str) -> String {
    message.split_whitespace().collect::<Vec<_>>().join(" ")
}

impl fmt::Display for Value {
    /// TOML-like, cut short where it is long: for messages.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let text = match self {
            Self::String(s) => format!("{s:?}"),
            Self::Integer(i) => i.to_string(),
            Self::Float(x) if x.is_nan() => "nan".to_owned(),
            Self::Float(x) => format!("{x:?}"),
            Self::Boolean(b) => b.to_string(),
            Self::Other(s) => s.clone(),
            Self::Array(a) if a.is_empty() => "[]".to_owned(),
            Self::Array(a) if a.iter().any(|n| matches!(n.value, Self::Table(_))) => "[{...}]".to_owned(),
            Self::Array(a) => {
                format!("[{}]", a.iter().map(|n| n.value.to_string()).collect::<Vec<_>>().join(", "))
            }
            Self::Table(_) => "{...}".to_owned(),
        };
        match text.char_indices().nth(60) {
            Some((cut, _)) => write!(f, "{}...", &text[..cut]),
            None => f.write_str(&text),
        }
    }
}
