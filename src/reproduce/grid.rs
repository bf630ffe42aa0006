//! Tables as data: one structure for the terminal, Markdown and JSON.

use super::statistics::Interval;
use serde::Serialize;
use std::fmt::Write as _;

/// One entry of a table.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Entry {
    /// Words.
    Text(String),
    /// A number, to be shown with that many decimals.
    Number(#[serde(serialize_with = "value_only")] (f64, usize)),
    /// A mean with its 95 % interval.
    Interval(Interval),
    /// Nothing to say.
    Empty(()),
}

fn value_only<S: serde::Serializer>(number: &(f64, usize), serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_f64(number.0)
}

impl From<&str> for Entry {
    fn from(text: &str) -> Entry {
        Entry::Text(text.to_owned())
    }
}

impl From<String> for Entry {
    fn from(text: String) -> Entry {
        Entry::Text(text)
    }
}

impl From<Option<Interval>> for Entry {
    fn from(interval: Option<Interval>) -> Entry {
        interval.map_or(Entry::Empty(()), Entry::Interval)
    }
}

/// A number with its decimals.
pub fn number(value: f64, decimals: usize) -> Entry {
    Entry::Number((value, decimals))
}

impl Entry {
    /// As text.
    pub fn show(&self) -> String {
        match self {
            Entry::Text(text) => text.clone(),
            // A negative zero is a rounding accident, not a statement.
            Entry::Number((value, decimals)) => {
                let text = format!("{value:.decimals$}");
                let zero = text.bytes().all(|b| matches!(b, b'-' | b'0' | b'.'));
                if zero { text.trim_start_matches('-').to_owned() } else { text }
            }
            Entry::Interval(i) => format!("{:.2} ± {:.2}", i.mean, i.half_width()),
            Entry::Empty(()) => "–".to_owned(),
        }
    }
}

/// A table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Grid {
    /// What it shows.
    pub title: String,
    /// Column names.
    pub columns: Vec<String>,
    /// Rows, as long as `columns`.
    pub rows: Vec<Vec<Entry>>,
}

impl Grid {
    /// An empty table.
    pub fn new<C: Into<String>>(title: impl Into<String>, columns: impl IntoIterator<Item = C>) -> Grid {
        let columns = columns.into_iter().map(Into::into).collect();
        Grid { title: title.into(), columns, rows: Vec::new() }
    }

    /// Adds a row.
    pub fn row(&mut self, entries: impl IntoIterator<Item = Entry>) {
        let row: Vec<Entry> = entries.into_iter().collect();
        debug_assert_eq!(row.len(), self.columns.len(), "{}", self.title);
        self.rows.push(row);
    }

    /// As Markdown.
    pub fn markdown(&self) -> String {
        // A bar ends a cell, in code spans too.
        let line = |cells: Vec<String>| format!("| {} |\n", cells.join(" | ").replace('\n', " "));
        let escape = |text: &str| text.replace('|', "\\|");
        let mut out = String::new();
        let _ = writeln!(out, "**{}**\n", self.title);
        out += &line(self.columns.iter().map(|c| escape(c)).collect());
        let numeric = |column: usize| self.rows.iter().all(|r| !matches!(r[column], Entry::Text(_)));
        let rule = |i: usize| if numeric(i) { "---:" } else { "---" }.to_owned();
        out += &line((0..self.columns.len()).map(rule).collect());
        for row in &self.rows {
            out += &line(row.iter().map(|e| escape(&e.show())).collect());
        }
        out
    }

    /// For a terminal.
    pub fn terminal(&self) -> String {
        let mut table = comfy_table::Table::new();
        table.load_style(comfy_table::presets::NOTHING).set_header(&self.columns);
        for row in &self.rows {
            table.add_row(row.iter().map(Entry::show));
        }
        format!("{}\n{table}\n", self.title)
    }
}
