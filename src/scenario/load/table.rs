//! Typed reading of a [`Document`]: every failure names place, key path, value found and what was expected.

use super::document::{Document, Node, Origin, Value};
use super::error::{Place, ScenarioError, nearest, printable};
use crate::scenario::keys::{self, Choice, Flag, Keys, Number};
use crate::scenario::ranges::{MAX_COUNT, Range};
use std::collections::BTreeMap;

/// A table being read.
pub(in crate::scenario) struct Table<'a> {
    document: &'a Document,
    path: String,
    origin: Origin,
    entries: &'a BTreeMap<String, Node>,
}

/// A value being read.
#[derive(Clone)]
pub(in crate::scenario) struct Field<'a> {
    document: &'a Document,
    /// Dotted path.
    pub(in crate::scenario) path: String,
    node: &'a Node,
}

impl<'a> Table<'a> {
    /// The document's root.
    pub(super) fn root(document: &'a Document) -> Self {
        let Value::Table(entries) = &document.root.value else {
            unreachable!("the root of a document is parsed as a table, and a --set writes below it")
        };
        Self { document, path: String::new(), origin: document.root.origin, entries }
    }

    /// All entries, in order of key.
    pub(in crate::scenario) fn entries(&self) -> impl Iterator<Item = (&'a str, Field<'a>)> + '_ {
        self.entries
            .iter()
            .map(|(key, node)| (key.as_str(), Field { document: self.document, path: self.key(key), node }))
    }

    /// Refuses keys other than these. Called first, so that a misspelt key is reported as such and not as a
    /// missing one. Of several, the first one in the file.
    pub(in crate::scenario) fn only(&self, known: &[&str]) -> Result<(), ScenarioError> {
        self.only_or_stale(known, &[])
    }

    /// As [`Self::only`]; `stale` keys are overlooked where the file wrote them.
    ///
    /// A table may be one of several variants. Where a `--set` selects another variant than the file's, the
    /// keys the file gave for its own variant are left without meaning, which is no mistake of the user's.
    pub(in crate::scenario) fn only_or_stale(
        &self,
        known: &[&str],
        stale: &[&str],
    ) -> Result<(), ScenarioError> {
        let unknown = self.entries.iter().filter(|(key, node)| {
            let is_stale = stale.contains(&key.as_str()) && matches!(node.origin, Origin::Line(_));
            !known.contains(&key.as_str()) && !is_stale
        });
        let line = |node: &Node| match node.origin {
            Origin::Line(line) => line,
            Origin::Set(_) | Origin::Seed(_) => u64::MAX,
        };
        match unknown.min_by_key(|(_, node)| line(node)) {
            None => Ok(()),
            Some((key, node)) => Err(ScenarioError::UnknownKey {
                place: self.document.place(node.origin),
                key: self.key(key).into(),
                found: node.value.to_string().into(),
                expected: match known {
                    [only] => format!("only {only}").into(),
                    _ => format!("one of {}", known.join(", ")).into(),
                },
                suggestion: nearest(key, known.iter().copied()),
            }),
        }
    }

    /// Refuses keys other than those declared.
    pub(in crate::scenario) fn only_declared(&self, keys: Keys) -> Result<(), ScenarioError> {
        self.only(&keys::names(keys))
    }

    /// Where the table starts.
    pub(in crate::scenario) fn place(&self) -> Place {
        self.document.place(self.origin)
    }

    /// Dotted path of a key of this table.
    pub(in crate::scenario) fn key(&self, key: &str) -> String {
        let key = printable(key);
        if self.path.is_empty() { key } else { format!("{}.{key}", self.path) }
    }

    /// A key that may be absent.
    pub(in crate::scenario) fn get(&self, key: &str) -> Option<Field<'a>> {
        let node = self.entries.get(key)?;
        Some(Field { document: self.document, path: self.key(key), node })
    }

    /// A key that must be there.
    pub(in crate::scenario) fn need(&self, key: &str, expected: &str) -> Result<Field<'a>, ScenarioError> {
        self.get(key).ok_or_else(|| self.missing(key, expected))
    }

    pub(in crate::scenario) fn missing(&self, key: &str, expected: &str) -> ScenarioError {
        ScenarioError::MissingKey {
            place: self.place(),
            key: self.key(key).into(),
            expected: expected.into(),
        }
    }

    /// Two keys of which a table has one. A `--set` of one replaces the file's other.
    pub(in crate::scenario) fn either(&self, a: &str, b: &str) -> (Option<Field<'a>>, Option<Field<'a>>) {
        match (self.get(a), self.get(b)) {
            (Some(a), Some(b)) if a.is_set() && !b.is_set() => (Some(a), None),
            (Some(a), Some(b)) if b.is_set() && !a.is_set() => (None, Some(b)),
            both => both,
        }
    }

    /// Keys found missing from here on are missing because of this field, if it is a `--set`.
    pub(in crate::scenario) fn blame(&mut self, field: &Field<'_>) {
        if field.is_set() {
            self.origin = field.node.origin;
        }
    }

    /// A number that must be there.
    pub(in crate::scenario) fn f64(
        &self,
        key: &str,
        ok: impl Fn(f64) -> bool,
        expected: &str,
    ) -> Result<f64, ScenarioError> {
        self.need(key, expected)?.f64(ok, expected)
    }

    /// A number with a default. The default, too, must be within the range, which may depend on other keys.
    pub(in crate::scenario) fn f64_or(
        &self,
        key: &str,
        default: f64,
        ok: impl Fn(f64) -> bool,
        expected: &str,
    ) -> Result<f64, ScenarioError> {
        match self.get(key) {
            Some(field) => field.f64(ok, expected),
            None if ok(default) => Ok(default),
            None => Err(self.missing(key, &format!("{expected} (the default {default} is not)"))),
        }
    }

    /// The number of a declared key, which must be there.
    pub(in crate::scenario) fn number(&self, key: &Number) -> Result<f64, ScenarioError> {
        self.within(key.name, &key.range)
    }

    /// The number of a declared key, or another.
    pub(in crate::scenario) fn number_or(&self, key: &Number, default: f64) -> Result<f64, ScenarioError> {
        self.within_or(key.name, default, &key.range)
    }

    /// The word of a declared key, or its first.
    pub(in crate::scenario) fn chosen<T: Copy>(&self, key: &Choice<T>) -> Result<T, ScenarioError> {
        self.choice_or_first(key.name, key.words)
    }

    /// `true` or `false`, or the key's default.
    pub(in crate::scenario) fn flag(&self, key: &Flag) -> Result<bool, ScenarioError> {
        self.bool_or(key.name, key.default)
    }

    /// A number within a range.
    pub(in crate::scenario) fn within(&self, key: &str, range: &Range) -> Result<f64, ScenarioError> {
        self.need(key, &range.to_string())?.within(range)
    }

    /// The same, with a default.
    pub(in crate::scenario) fn within_or(
        &self,
        key: &str,
        default: f64,
        range: &Range,
    ) -> Result<f64, ScenarioError> {
        self.f64_or(key, default, |value| range.contains(value), &range.to_string())
    }

    /// `true` or `false`, with a default.
    pub(in crate::scenario) fn bool_or(&self, key: &str, default: bool) -> Result<bool, ScenarioError> {
        match self.get(key) {
            None => Ok(default),
            Some(field) => match field.node.value {
                Value::Boolean(value) => Ok(value),
                _ => Err(field.bad("true or false")),
            },
        }
    }

    /// One of some words, with the first as default.
    pub(in crate::scenario) fn choice_or_first<T: Copy>(
        &self,
        key: &str,
        choices: &[(&str, T)],
    ) -> Result<T, ScenarioError> {
        match self.get(key) {
            None => Ok(choices[0].1),
            Some(field) => field.choice(choices),
        }
    }

    /// A name that must be there.
    pub(in crate::scenario) fn name(&self) -> Result<&'a str, ScenarioError> {
        self.need("name", EXPECTED_NAME)?.word()
    }

    /// The tables of an array of tables that must be there and not empty.
    pub(in crate::scenario) fn tables(
        &self,
        key: &str,
        expected: &str,
    ) -> Result<Vec<Table<'a>>, ScenarioError> {
        let items = self.need(key, expected)?.items(expected)?;
        items.iter().map(|item| item.table(expected)).collect()
    }
}

const EXPECTED_NAME: &str = "a name of 1 to 64 letters, digits, '_' or '-'";

impl<'a> Field<'a> {
    /// A string that may be a name.
    pub(in crate::scenario) fn word(&self) -> Result<&'a str, ScenarioError> {
        let name = self.str(EXPECTED_NAME)?;
        let allowed = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
        if name.is_empty() || name.len() > 64 || !name.chars().all(allowed) {
            return Err(self.bad(EXPECTED_NAME));
        }
        Ok(name)
    }

    /// The error for a value that is not what was expected.
    pub(in crate::scenario) fn bad(&self, expected: &str) -> ScenarioError {
        self.bad_because(None, expected)
    }

    /// The same, with what is wrong in words.
    pub(in crate::scenario) fn bad_because(&self, problem: Option<String>, expected: &str) -> ScenarioError {
        ScenarioError::BadValue {
            place: self.place(),
            key: self.path.as_str().into(),
            found: self.found().into(),
            problem: problem.map(Into::into),
            expected: expected.into(),
        }
    }

    /// Where the value is written.
    pub(in crate::scenario) fn place(&self) -> Place {
        self.document.place(self.node.origin)
    }

    /// The value, as messages show it.
    pub(in crate::scenario) fn found(&self) -> String {
        self.node.value.to_string()
    }

    /// Whether the value comes from a `--set`.
    pub(in crate::scenario) fn is_set(&self) -> bool {
        matches!(self.node.origin, Origin::Set(_))
    }

    /// A finite number within a range.
    pub(in crate::scenario) fn f64(
        &self,
        ok: impl Fn(f64) -> bool,
        expected: &str,
    ) -> Result<f64, ScenarioError> {
        let number = match self.node.value {
            Value::Integer(i) => i as f64,
            Value::Float(x) => x,
            _ => return Err(self.bad(expected)),
        };
        if number.is_finite() && ok(number) { Ok(number) } else { Err(self.bad(expected)) }
    }

    /// The same.
    pub(in crate::scenario) fn within(&self, range: &Range) -> Result<f64, ScenarioError> {
        self.f64(|value| range.contains(value), &range.to_string())
    }

    /// An integer within a range.
    pub(in crate::scenario) fn integer<T: TryFrom<i128>>(
        &self,
        least: i128,
        expected: &str,
    ) -> Result<T, ScenarioError> {
        match self.node.value {
            Value::Integer(i) if i >= least => T::try_from(i).map_err(|_| self.bad(expected)),
            _ => Err(self.bad(expected)),
        }
    }

    /// A string.
    pub(in crate::scenario) fn str(&self, expected: &str) -> Result<&'a str, ScenarioError> {
        match &self.node.value {
            Value::String(s) => Ok(s),
            _ => Err(self.bad(expected)),
        }
    }

    /// One of some words.
    pub(in crate::scenario) fn choice<T: Copy>(&self, choices: &[(&str, T)]) -> Result<T, ScenarioError> {
        let word = match &self.node.value {
            Value::String(s) => s.as_str(),
            _ => "",
        };
        choices.iter().find(|(w, _)| *w == word).map(|(_, value)| *value).ok_or_else(|| {
            let words: Vec<String> = choices.iter().map(|(w, _)| format!("{w:?}")).collect();
            self.bad(&words.join(" or "))
        })
    }

    /// A table.
    pub(in crate::scenario) fn table(&self, expected: &str) -> Result<Table<'a>, ScenarioError> {
        match &self.node.value {
            Value::Table(entries) => Ok(Table {
                document: self.document,
                path: self.path.clone(),
                origin: self.node.origin,
                entries,
            }),
            _ => Err(self.bad(expected)),
        }
    }

    /// The elements of an array that is not empty. Their paths use names where they have one.
    pub(in crate::scenario) fn items(&self, expected: &str) -> Result<Vec<Field<'a>>, ScenarioError> {
        match &self.node.value {
            Value::Array(items) if !items.is_empty() => Ok(items
                .iter()
                .enumerate()
                .map(|(i, node)| Field {
                    document: self.document,
                    path: match node.name() {
                        Some(name) => format!("{}.{name}", self.path),
                        None => format!("{}.{i}", self.path),
                    },
                    node,
                })
                .collect()),
            _ => Err(self.bad(expected)),
        }
    }
}

/// Reads the names of an array of tables, which must be unique.
pub(in crate::scenario) fn unique_names<'a>(
    tables: &[Table<'a>],
    what: &str,
) -> Result<Vec<&'a str>, ScenarioError> {
    let mut seen = std::collections::BTreeSet::new();
    let mut names = Vec::with_capacity(tables.len());
    for table in tables {
        let name = table.name()?;
        if !seen.insert(name) {
            let expected = format!("a name no other {what} has");
            return Err(table.need("name", &expected)?.bad_because(Some("used twice".into()), &expected));
        }
        names.push(name);
    }
    if names.len() > MAX_COUNT {
        let table = &tables[MAX_COUNT];
        let expected = format!("at most {MAX_COUNT} {what} entries");
        return Err(table.need("name", &expected)?.bad_because(Some("too many".into()), &expected));
    }
    Ok(names)
}

/// Index of the name a field gives.
pub(super) fn find(field: &Field<'_>, what: &str, names: &[&str]) -> Result<usize, ScenarioError> {
    let expected = || {
        let article = if what.starts_with(['a', 'e', 'i', 'o', 'u']) { "an" } else { "a" };
        let word = field.str("").unwrap_or("");
        let hint = nearest(word, names.iter().copied());
        let hint = hint.map(|h| format!("; did you mean {h}?")).unwrap_or_default();
        let mut list = names.iter().take(20).copied().collect::<Vec<_>>().join(", ");
        if names.len() > 20 {
            list += ", ...";
        }
        format!("the name of {article} {what}: {list}{hint}")
    };
    let name = field.str("").map_err(|_| field.bad(&expected()))?;
    let found = names.iter().position(|n| *n == name);
    found.ok_or_else(|| field.bad_because(Some(format!("unknown {what}")), &expected()))
}
