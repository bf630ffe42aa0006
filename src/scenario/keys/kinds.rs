//! What a declaration of a key consists of.

use crate::scenario::ranges::Range;

/// A key, as messages and documents show it.
pub(in crate::scenario) trait Key: Sync {
    fn name(&self) -> &'static str;
    /// What it takes, in words.
    fn takes(&self) -> String;
    /// What holds without it, in words.
    fn by_default(&self) -> String;
    fn meaning(&self) -> &'static str;
}

/// A key that holds a number.
#[derive(Debug)]
pub(in crate::scenario) struct Number {
    pub name: &'static str,
    pub range: Range,
    /// Where the default is another key's value, there is none here.
    pub default: Option<f64>,
    /// What holds without the key when no number is the default.
    pub(super) otherwise: &'static str,
    pub(super) meaning: &'static str,
}

/// A key that holds one of some words, of which the first is the default.
#[derive(Debug)]
pub(in crate::scenario) struct Choice<T: 'static> {
    pub name: &'static str,
    pub words: &'static [(&'static str, T)],
    pub(super) meaning: &'static str,
}

/// A key that holds `true` or `false`.
#[derive(Debug)]
pub(in crate::scenario) struct Flag {
    pub name: &'static str,
    pub default: bool,
    pub(super) meaning: &'static str,
}

/// A key that holds something else: a name, a list, a table.
#[derive(Debug)]
pub(in crate::scenario) struct Other {
    pub name: &'static str,
    pub(super) takes: &'static str,
    pub(super) by_default: &'static str,
    pub(super) meaning: &'static str,
}

impl Number {
    /// The default, of a key that has one.
    pub(in crate::scenario) const fn default(&self) -> f64 {
        self.default.expect("the key has a number as its default")
    }
}

impl<T: Copy> Choice<T> {
    /// The default.
    pub(in crate::scenario) const fn default(&self) -> T {
        self.words[0].1
    }
}

impl Key for Number {
    fn name(&self) -> &'static str {
        self.name
    }

    fn takes(&self) -> String {
        self.range.to_string().trim_end().to_owned()
    }

    fn by_default(&self) -> String {
        self.default.map_or_else(|| self.otherwise.to_owned(), |default| format!("{default}"))
    }

    fn meaning(&self) -> &'static str {
        self.meaning
    }
}

impl<T: Sync> Key for Choice<T> {
    fn name(&self) -> &'static str {
        self.name
    }

    fn takes(&self) -> String {
        self.words.iter().map(|(word, _)| format!("`{word}`")).collect::<Vec<_>>().join(", ")
    }

    fn by_default(&self) -> String {
        format!("`{}`", self.words[0].0)
    }

    fn meaning(&self) -> &'static str {
        self.meaning
    }
}

impl Key for Flag {
    fn name(&self) -> &'static str {
        self.name
    }

    fn takes(&self) -> String {
        "`true`, `false`".to_owned()
    }

    fn by_default(&self) -> String {
        format!("`{}`", self.default)
    }

    fn meaning(&self) -> &'static str {
        self.meaning
    }
}

impl Key for Other {
    fn name(&self) -> &'static str {
        self.name
    }

    fn takes(&self) -> String {
        self.takes.to_owned()
    }

    fn by_default(&self) -> String {
        self.by_default.to_owned()
    }

    fn meaning(&self) -> &'static str {
        self.meaning
    }
}

pub(super) const fn number(name: &'static str, range: Range, default: f64, meaning: &'static str) -> Number {
    Number { name, range, default: Some(default), otherwise: "", meaning }
}

pub(super) const fn without_default(
    name: &'static str,
    range: Range,
    otherwise: &'static str,
    meaning: &'static str,
) -> Number {
    Number { name, range, default: None, otherwise, meaning }
}

pub(in crate::scenario) const fn other(
    name: &'static str,
    takes: &'static str,
    by_default: &'static str,
    meaning: &'static str,
) -> Other {
    Other { name, takes, by_default, meaning }
}
