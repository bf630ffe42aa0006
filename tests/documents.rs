//! Documents name only what exists: files, commands and their flags, scenario keys, items of the code.
//!
//! Not everything in backticks can be decided. What is decided: links and paths; lines and code spans that begin with
//! `cz`; `--set`; and names that can only be code, of several words in one (`TwoWords`, `two_words`, `TWO_WORDS`).

#![allow(clippy::unwrap_used)]

use control_zones::reproduce::equations::EQUATIONS;
use control_zones::scenario::{Override, load};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Folders with nothing of ours in them, or nothing that documents speak of.
const SKIPPED: [&str; 4] = ["target", ".git", "__pycache__", "build"];
/// Subcommands that other programs of this workspace have, and where these are.
const SIBLINGS: [(&str, &str); 5] = [
    ("export", "export/src"),
    ("report", "export/src"),
    ("sweep", "sweep/src"),
    ("top", "view/src"),
    ("view", "view/src"),
];
/// Flags that documents say there is not.
const NOT_THERE: [&str; 1] = ["--isolate"];
/// Names of other people's code.
const THEIRS: [&str; 5] = [
    "ptrace_scope",
    "F_SEAL_FUTURE_WRITE",
    "UnableToGenerateUniqueNodeId",
    "dev_permissions",
    "find_package",
];
/// Keys of `--set` that are there as examples of the form only.
const FORMS: [&str; 1] = ["KEY=VALUE"];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// All files below a folder.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut all = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if path.is_dir() {
            if !SKIPPED.contains(&name.as_str()) {
                all.extend(files(&path));
            }
        } else {
            all.push(path);
        }
    }
    all.sort();
    all
}

fn relative(path: &Path) -> String {
    path.strip_prefix(root()).unwrap_or(path).to_string_lossy().into_owned()
}

/// A document, in pieces.
struct Document {
    name: String,
    folder: PathBuf,
    text: String,
}

impl Document {
    fn all() -> Vec<Document> {
        let documents = files(root()).into_iter().filter(|path| path.extension().is_some_and(|e| e == "md"));
        let read = |path: PathBuf| Document {
            name: relative(&path),
            folder: path.parent().unwrap().to_owned(),
            text: std::fs::read_to_string(&path).unwrap(),
        };
        documents.map(read).collect()
    }

    /// Code spans of the running text, and lines of code blocks.
    fn code(&self) -> (Vec<String>, Vec<String>) {
        let (mut spans, mut lines, mut running) = (Vec::new(), Vec::new(), String::new());
        let mut fenced = false;
        for line in self.text.lines() {
            if line.trim_start().starts_with("```") {
                fenced = !fenced;
            } else if fenced || line.starts_with("    ") {
                lines.push(line.trim().to_owned());
            } else {
                running.push_str(line);
                running.push('\n');
            }
        }
        for paragraph in running.split("\n\n") {
            let parts: Vec<&str> = paragraph.split('`').collect();
            spans.extend(parts.iter().skip(1).step_by(2).map(|span| span.replace('\n', " ")));
        }
        (spans, lines)
    }

    /// What is a command of ours, from `cz` on.
    fn commands(&self) -> Vec<String> {
        let (spans, lines) = self.code();
        let command = |code: &String| {
            let code = code.trim_start_matches("$ ");
            let code = code
                .strip_prefix("cargo run --release -- ")
                .map(|rest| format!("cz {rest}"))
                .unwrap_or(code.to_owned());
            code.starts_with("cz ").then_some(code)
        };
        spans.iter().chain(&lines).filter_map(command).collect()
    }
}

/// Words of a command line, up to what is not of our program: a comment, another command, another program's arguments.
fn words(command: &str) -> Vec<String> {
    let (mut words, mut word, mut quote, mut any) = (Vec::new(), String::new(), None, false);
    for c in command.chars() {
        match (quote, c) {
            (Some(open), c) if c == open => quote = None,
            (Some(_), c) => word.push(c),
            (None, '\'' | '"') => (quote, any) = (Some(c), true),
            (None, ' ') => {
                if any || !word.is_empty() {
                    words.push(std::mem::take(&mut word));
                }
                any = false;
            }
            (None, c) => word.push(c),
        }
    }
    words.push(word);
    let ends = |word: &String| ["#", "|", "&&", ">", "--", "&", "…"].contains(&word.as_str());
    let end = words.iter().position(ends).unwrap_or(words.len());
    words.truncate(end);
    words.retain(|word| !word.is_empty());
    words
}

/// What `cz … --help` says.
fn help(of: &[&str]) -> String {
    let output = Command::new(env!("CARGO_BIN_EXE_cz")).args(of).arg("--help").output().unwrap();
    assert!(output.status.success(), "cz {} --help", of.join(" "));
    String::from_utf8(output.stdout).unwrap()
}

/// The text of all sources in a folder.
fn sources_in(folder: &str) -> String {
    let sources = files(&root().join(folder)).into_iter().map(std::fs::read_to_string);
    sources.map(Result::unwrap).collect()
}

/// Subcommands and flags of our program.
struct Program {
    /// Flags by subcommand, such as `plugin check`.
    flags: BTreeMap<String, BTreeSet<String>>,
    siblings: BTreeMap<&'static str, String>,
    /// Where our own arguments are declared, the hidden ones too.
    arguments: String,
}

fn listed(help: &str) -> Vec<String> {
    let Some((_, commands)) = help.split_once("Commands:\n") else { return Vec::new() };
    let lines = commands.lines().take_while(|line| !line.trim().is_empty());
    let names = lines.filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    names
        .filter_map(|line| line.split_whitespace().next())
        .filter(|name| *name != "help")
        .map(str::to_owned)
        .collect()
}

fn flags_in(help: &str) -> BTreeSet<String> {
    let is_flag = |c: char| c.is_ascii_alphanumeric() || c == '-';
    let starts = help.match_indices("--").filter(|(at, _)| !help[..*at].ends_with(is_flag));
    starts.map(|(at, _)| help[at..].chars().take_while(|c| is_flag(*c)).collect()).collect()
}

impl Program {
    fn ask() -> Program {
        let mut flags = BTreeMap::from([(String::new(), flags_in(&help(&[])))]);
        let mut siblings = BTreeMap::new();
        // The last is hidden.
        for name in listed(&help(&[])).into_iter().chain(["keep".to_owned()]) {
            if let Some((sibling, folder)) = SIBLINGS.iter().find(|(sibling, _)| *sibling == name) {
                siblings.insert(*sibling, sources_in(folder));
                continue;
            }
            // What is in Python declares its arguments as they are written.
            if ["sumo", "import"].contains(&name.as_str()) {
                let declared =
                    std::fs::read_to_string(root().join("sdk/python/control_zones/sumo/command.py")).unwrap();
                flags.insert(name, flags_in(&declared));
                continue;
            }
            let text = help(&[&name]);
            for inner in listed(&text) {
                flags.insert(format!("{name} {inner}"), flags_in(&help(&[&name, &inner])));
            }
            flags.insert(name, flags_in(&text));
        }
        Program { flags, siblings, arguments: sources_in("src/app/args") }
    }

    /// Whether arguments declared in these sources have a flag.
    fn declares(sources: &str, flag: &str) -> bool {
        let field = flag.trim_start_matches("--").replace('-', "_");
        sources.contains(&format!("pub {field}:"))
    }

    /// What is wrong with a command line.
    fn judge(&self, words: &[String]) -> Option<String> {
        let name = words.get(1)?;
        let is_example = name.chars().any(|c| !c.is_ascii_lowercase());
        if is_example {
            return None;
        }
        let flags =
            words.iter().filter(|word| word.starts_with("--")).map(|word| word.split('=').next().unwrap());
        let mut flags = flags.map(|flag| flag.trim_end_matches(|c: char| !c.is_ascii_alphanumeric()));
        if let Some(sources) = self.siblings.get(name.as_str()) {
            let unknown = flags.find(|flag| *flag != "--help" && !Program::declares(sources, flag));
            return unknown.map(|flag| format!("cz {name} has no {flag}"));
        }
        let inner = words.get(2).map(|inner| format!("{name} {inner}"));
        let known = inner.and_then(|inner| self.flags.get(&inner)).or_else(|| self.flags.get(name));
        let Some(known) = known else { return Some(format!("there is no cz {name}")) };
        let is_unknown = |flag: &&str| !known.contains(*flag) && !self.knows_hidden(flag);
        flags.find(is_unknown).map(|flag| format!("cz {name} has no {flag}"))
    }

    fn knows_hidden(&self, flag: &str) -> bool {
        NOT_THERE.contains(&flag) || Program::declares(&self.arguments, flag)
    }

    fn knows_flag(&self, flag: &str) -> bool {
        self.knows_hidden(flag)
            || self.flags.values().any(|flags| flags.contains(flag))
            || self.siblings.values().any(|sources| Program::declares(sources, flag))
    }
}

#[test]
fn links_and_paths_lead_somewhere() {
    let all: Vec<String> = files(root()).iter().map(|path| relative(path)).collect();
    let folders: BTreeSet<&str> = all.iter().filter_map(|path| Some(path.split_once('/')?.0)).collect();
    let mut wrong = Vec::new();
    for document in Document::all() {
        for (at, _) in document.text.match_indices("](") {
            let target = document.text[at + 2..].split([')', '#', ' ']).next().unwrap();
            if !target.is_empty() && !target.contains("://") && !document.folder.join(target).exists() {
                wrong.push(format!("{}: link to {target}", document.name));
            }
        }
        for span in document.code().0 {
            let path = span.split([' ', ':', '#']).next().unwrap_or_default().trim_end_matches('/');
            let is_plain = path.chars().all(|c| c.is_ascii_alphanumeric() || "_-./".contains(c));
            let in_ours = path.split_once('/').is_some_and(|(folder, _)| folders.contains(folder));
            let ending = path.rsplit_once('.').map_or("", |(_, ending)| ending);
            let is_source = ["rs", "md", "py", "sh"].contains(&ending) && !path.starts_with('-');
            // Users' own files, and other people's.
            let is_example = ["mine.py", "mine.rs", "report.md", "attributeStats.py"].contains(&path);
            if !is_plain || !(in_ours || is_source) || is_example || path.starts_with('/') {
                continue;
            }
            let there = all.iter().any(|known| {
                known == path
                    || known.ends_with(&format!("/{path}"))
                    || known.starts_with(&format!("{path}/"))
            });
            let beside = document.folder.join(path).exists() || root().join("src").join(path).exists();
            if !there && !beside {
                wrong.push(format!("{}: `{path}`", document.name));
            }
        }
    }
    assert!(wrong.is_empty(), "documents name files that do not exist:\n{}", wrong.join("\n"));
}

#[test]
fn commands_and_flags_exist() {
    let program = Program::ask();
    let (mut wrong, mut seen) = (Vec::new(), 0);
    for document in Document::all() {
        for command in document.commands() {
            seen += 1;
            if let Some(problem) = program.judge(&words(&command)) {
                wrong.push(format!("{}: {problem}: `{command}`", document.name));
            }
        }
        // Of a span that is a flag.
        for span in document.code().0.iter().filter(|span| span.starts_with("--") && span.len() > 2) {
            let flag: String = span.chars().take_while(|c| c.is_ascii_alphanumeric() || *c == '-').collect();
            if !program.knows_flag(&flag) {
                wrong.push(format!("{}: no command has {flag}", document.name));
            }
        }
    }
    assert!(seen > 60, "only {seen} commands were found: is this test blind?");
    assert!(wrong.is_empty(), "documents name commands that do not exist:\n{}", wrong.join("\n"));
}

#[test]
fn keys_of_set_exist() {
    let (mut wrong, mut seen) = (Vec::new(), 0);
    for document in Document::all() {
        for command in document.commands() {
            let words = words(&command);
            let sets: Vec<&String> = words
                .windows(2)
                .filter(|pair| pair[0] == "--set")
                .map(|pair| &pair[1])
                .filter(|set| !FORMS.contains(&set.as_str()))
                .collect();
            if sets.is_empty() {
                continue;
            }
            seen += sets.len();
            let after = |option: &str| words.windows(2).find(|pair| pair[0] == option).map(|pair| &pair[1]);
            // The default scenario where none is named, as with recordings, or any (`NAME`).
            let argument = words.get(2).filter(|_| words[1] == "run").or(after("--scenario"));
            let named = argument
                .filter(|name| name.contains(|c: char| c.is_ascii_lowercase()) && !name.starts_with("--"));
            // Traces of some seeds exist and of others do not: the first of a range is one of those meant.
            let seed = after("--seeds").and_then(|seeds| seeds.split_once('-')?.0.parse().ok());
            let overrides: Result<Vec<Override>, _> = sets.iter().map(|set| set.parse()).collect();
            let loaded = overrides.and_then(|overrides| load(named.map(String::as_str), &overrides, seed));
            if let Err(error) = loaded {
                wrong.push(format!("{}: `{command}`: {error}", document.name));
            }
        }
    }
    assert!(seen > 8, "only {seen} keys were found: is this test blind?");
    assert!(wrong.is_empty(), "documents set what cannot be set:\n{}", wrong.join("\n"));
}

/// Whether a name can only be code: several words in one.
fn is_code(name: &str) -> bool {
    let has_lower = name.contains(|c: char| c.is_ascii_lowercase());
    let has_upper = name.contains(|c: char| c.is_ascii_uppercase());
    // What begins with an underscore may be the end of several names.
    let is_name = name.starts_with(|c: char| c.is_ascii_alphabetic());
    // A letter and an index is a symbol of the mathematics.
    let is_symbol = name.find('_') == Some(1) && name.matches('_').count() == 1;
    let inner_underscore = name.trim_matches('_').contains('_') && !is_symbol;
    let camel = name.starts_with(|c: char| c.is_ascii_uppercase())
        && has_lower
        && !name.contains('_')
        && name[1..].contains(|c: char| c.is_ascii_uppercase());
    camel || (is_name && inner_underscore && !(has_lower && has_upper))
}

fn names(text: &str) -> impl Iterator<Item = &str> {
    text.split(|c: char| !(c.is_ascii_alphanumeric() || c == '_')).filter(|name| !name.is_empty())
}

#[test]
fn names_of_code_are_in_the_code() {
    let sources = ["rs", "py", "h", "c", "cpp", "hpp", "toml", "csv", "sh", "cmake", "in"];
    let mut known: BTreeSet<String> = BTreeSet::new();
    for path in files(root()) {
        // This file names what does not exist.
        if path.ends_with("tests/documents.rs") {
            continue;
        }
        known.extend(names(&relative(&path)).map(str::to_owned));
        if path.extension().is_some_and(|ending| sources.iter().any(|known| ending == *known)) {
            let text = String::from_utf8_lossy(&std::fs::read(&path).unwrap()).into_owned();
            known.extend(names(&text).map(str::to_owned));
        }
    }
    let (mut wrong, mut seen) = (BTreeSet::new(), 0);
    for document in Document::all() {
        let (spans, lines) = document.code();
        for span in spans.iter().chain(lines.iter().filter(|line| line.starts_with("cargo test"))) {
            // The name of a test may be the beginning of one.
            let is_filter = span.starts_with("cargo test");
            for name in names(span).filter(|name| is_code(name) && !THEIRS.contains(name)) {
                seen += 1;
                if !(known.contains(name) || is_filter && known.iter().any(|known| known.contains(name))) {
                    wrong.insert(format!("{}: `{name}`", document.name));
                }
            }
        }
    }
    assert!(seen > 300, "only {seen} names were found: is this test blind?");
    let wrong: Vec<String> = wrong.into_iter().collect();
    assert!(wrong.is_empty(), "documents name what is not in the code:\n{}", wrong.join("\n"));
}

/// What may stand in the table of views beside names of a package: what the language has by itself.
const OF_THE_LANGUAGE: [&str; 4] = ["str", "to_string", "True", "None"];

/// What stands between neither of two marks.
fn outside(text: &str, begins: &str, ends: &str) -> String {
    let mut parts = text.split(begins);
    let first = parts.next().unwrap_or_default().to_owned();
    parts.fold(first, |all, part| all + part.split_once(ends).map_or("", |(_, rest)| rest))
}

/// The names in lines of sources that begin with one of these words, without remarks: these declare nothing.
fn declared(paths: &[String], words: &[&str]) -> BTreeSet<String> {
    let mut known = BTreeSet::new();
    for path in paths {
        let text = std::fs::read_to_string(root().join(path)).unwrap();
        let text = match path.ends_with(".py") {
            true => text.split("\"\"\"").step_by(2).collect::<Vec<_>>().concat(),
            false => outside(&text, "/*", "*/"),
        };
        let mark = if path.ends_with(".py") { "#" } else { "//" };
        let lines = text.lines().map(|line| line.split(mark).next().unwrap_or_default().trim_start());
        let lines = lines.filter(|line| words.iter().any(|word| line.starts_with(word)));
        lines.for_each(|line| known.extend(names(line).map(str::to_owned)));
    }
    known
}

#[test]
fn names_of_the_view_are_in_the_package_of_their_language() {
    let text = std::fs::read_to_string(root().join("docs/plugins.md")).unwrap();
    let rows = text.lines().skip_while(|line| !line.starts_with("| | Python")).skip(2);
    let rows: Vec<&str> = rows.take_while(|line| line.starts_with('|')).collect();
    assert!(rows.len() > 8, "the table of views is not where it was");
    let of = |folder: &str, files: &[&str]| {
        files.iter().map(|file| format!("{folder}/{file}")).collect::<Vec<String>>()
    };
    let python = of("sdk/python/control_zones", &["_view.py", "_session.py", "_schemas.py"]);
    let rust = of("sdk/rust/src", &["lib.rs", "view.rs"]);
    let rust = [rust, of("ipc_schemas/src", &["feedback.rs", "state.rs"])].concat();
    let c = of("sdk/include/control_zones", &["plugin.h", "plugin.hpp"]);
    let c = [c, of("ipc_schemas/include", &["cz_schemas.h"])].concat();
    let packages = [
        ("Python", declared(&python, &[""])),
        ("Rust", declared(&rust, &["pub ", "fn "])),
        ("C and C++", declared(&c, &[""])),
    ];
    let (mut wrong, mut seen) = (Vec::new(), 0);
    for row in rows {
        let cells: Vec<&str> = row.trim_matches('|').split('|').collect();
        assert_eq!(cells.len(), 4, "{row}");
        // What the row says by itself goes for all of them.
        for (cell, (language, known)) in cells[1..].iter().zip(&packages) {
            for span in cell.split('`').skip(1).step_by(2).chain(cells[0].split('`').skip(1).step_by(2)) {
                // What a thing is called in the example is the reader's.
                let mine =
                    ["vehicle", "step", "state", "i", "k", "controller", "partner", "partners", "summary"];
                for name in names(span).filter(|name| !OF_THE_LANGUAGE.contains(name)) {
                    let is_mine = mine.contains(&name) && span.contains(['.', '[', '(']);
                    seen += 1;
                    let code = format!("CZ_{name}");
                    if !(is_mine || known.contains(name) || known.contains(&code)) {
                        wrong.push(format!("{language}: `{name}` of `{span}`"));
                    }
                }
            }
        }
    }
    assert!(seen > 80, "only {seen} names were found: is this test blind?");
    assert!(wrong.is_empty(), "the table of views names what a package has not:\n{}", wrong.join("\n"));
}

#[test]
fn the_map_from_equations_to_code_is_the_present_one() {
    let text = std::fs::read_to_string(root().join("docs/reproduction.md")).unwrap();
    for map in EQUATIONS {
        let item = |(file, item): &(&str, &str)| {
            format!("`{}::{item}`", file.trim_end_matches(".rs").replace('/', "::"))
        };
        let code: Vec<String> = map.code.iter().map(item).collect();
        let line = format!("| `{}` | {} | {} |\n", map.label, map.what, code.join(", "));
        assert!(text.contains(&line), "not in docs/reproduction.md: {line}");
        for item in code {
            let line = text.lines().find(|line| line.starts_with(&format!("| {item} | ")));
            assert!(
                line.is_some_and(|line| line.contains(map.label)),
                "docs/reproduction.md does not lead from {item}"
            );
        }
    }
}

#[test]
fn decisions_are_in_the_order_of_their_dates() {
    let text = std::fs::read_to_string(root().join("docs/decisions.md")).unwrap();
    let dates: Vec<&str> =
        text.lines().filter_map(|line| line.strip_prefix("## ")?.split(" · ").next()).collect();
    assert!(dates.len() > 20 && dates.is_sorted(), "decisions are not oldest first: {dates:?}");
}

#[test]
fn what_does_not_exist_is_found() {
    assert_eq!(words("cz run --set 'a={x=1, y=2}' # why"), ["cz", "run", "--set", "a={x=1, y=2}"]);
    let program = Program::ask();
    let judge = |command: &str| program.judge(&words(command));
    assert_eq!(judge("cz run intersection --record a.czlog"), None);
    assert_eq!(judge("cz fly"), Some("there is no cz fly".to_owned()));
    assert_eq!(judge("cz show a.czlog --sideways"), Some("cz show has no --sideways".to_owned()));
    assert_eq!(judge("cz plugin check --deadline-ms 5 -- mine"), None);
    assert!(is_code("LeftCar") && is_code("leave_zone") && is_code("STATE_LEFT"));
    assert!(!is_code("World") && !is_code("u_") && !is_code("XXH3"));
}

/// What is left out of the tests stands in CONTRIBUTING.md, by the name of its file.
#[test]
fn tests_that_are_run_by_hand_are_named() {
    let contributing = std::fs::read_to_string(root().join("CONTRIBUTING.md")).unwrap();
    let mut seen = 0;
    for folder in ["tests", "view/tests"] {
        for file in
            files(&root().join(folder)).iter().filter(|file| file.extension().is_some_and(|e| e == "rs"))
        {
            let left_out = std::fs::read_to_string(file).unwrap().matches("\n#[ignore").count();
            // Several files may be one module.
            let own = file.parent().filter(|parent| parent.join("mod.rs").exists()).unwrap_or(file);
            let name = own.file_stem().unwrap().to_str().unwrap();
            let named = contributing.matches(&format!("`{name}`")).count();
            assert!(left_out == 0 || named > 0, "{}: CONTRIBUTING.md names no `{name}`", file.display());
            seen += left_out;
        }
    }
    assert!(seen >= 10, "{seen}: this looks for something else than there is");
}
