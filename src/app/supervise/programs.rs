//! The programs of a plug-in, watched for changes.

use std::collections::BTreeMap;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// Time between two looks.
pub(super) const LOOK: Duration = Duration::from_millis(200);
/// Files that are looked at.
const MAX_FILES: usize = 1000;
const PYTHON: &str = "py";

/// When a file was written last, and its length in bytes.
type Stamp = (SystemTime, u64);

/// The files that a command names as programs, as they were.
#[derive(Clone, Debug)]
pub(in crate::app) struct Programs {
    /// Those named in the command.
    named: Vec<PathBuf>,
    /// As it was when the program was started.
    known: BTreeMap<PathBuf, Stamp>,
    /// As it was at the last look.
    seen: BTreeMap<PathBuf, Stamp>,
}

impl Programs {
    /// Those that a command line names: executables by their path, and programs in Python. `None` when there are none.
    pub fn of(command: &str) -> Option<Programs> {
        let words = shlex::split(command)?.into_iter().map(PathBuf::from);
        let named: Vec<PathBuf> = words.filter(|word| is_program(word)).collect();
        let known = stamps(&named);
        (!named.is_empty()).then(|| Programs { seen: known.clone(), known, named })
    }

    /// A file that has changed since they were started, once nobody writes to any: since the last look nothing has
    /// changed any more. From then on they are as they are now.
    pub fn changed(&mut self) -> Option<PathBuf> {
        let now = stamps(&self.named);
        let is_settled = now == self.seen && self.named.iter().all(|file| now.contains_key(file));
        self.seen = now;
        if !is_settled || self.seen == self.known {
            return None;
        }
        let differs = |file: &&PathBuf| self.seen.get(*file) != self.known.get(*file);
        let changed = self.seen.keys().chain(self.known.keys()).find(differs).cloned();
        self.known.clone_from(&self.seen);
        changed
    }
}

fn is_program(word: &Path) -> bool {
    let is_path = word.components().count() > 1 || word.starts_with(".");
    let is_executable = |file: &std::fs::Metadata| file.permissions().mode() & 0o111 != 0;
    word.metadata().is_ok_and(|file| {
        file.is_file() && (word.extension().is_some_and(|e| e == PYTHON) || is_path && is_executable(&file))
    })
}

/// The state of these files, and for each program in Python of what it may import from its folder.
fn stamps(named: &[PathBuf]) -> BTreeMap<PathBuf, Stamp> {
    let is_python = |file: &Path| file.extension().is_some_and(|e| e == PYTHON);
    let folder = |file: &Path| match file.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder.to_owned(),
        _ => PathBuf::from("."),
    };
    let beside = named.iter().filter(|file| is_python(file)).filter_map(|file| folder(file).read_dir().ok());
    let beside = beside.flatten().flatten().map(|entry| entry.path()).filter(|file| is_python(file));
    let stamp = |file: PathBuf| {
        let found = file.metadata().ok()?;
        Some((file, (found.modified().ok()?, found.len())))
    };
    named.iter().cloned().chain(beside.take(MAX_FILES)).filter_map(stamp).collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn what_a_command_names_is_watched_and_a_change_is_told_once_it_is_over() {
        let folder = tempfile::tempdir().unwrap();
        let (law, data) = (folder.path().join("law.py"), folder.path().join("out.csv"));
        let beside = folder.path().join("gains.py");
        let write = |file: &Path, text: &str| std::fs::write(file, text).unwrap();
        [&law, &data, &beside].iter().for_each(|file| write(file, "1"));
        let command = format!("exec python3 -u '{}' {} --fast", law.display(), data.display());
        let mut programs = Programs::of(&command).unwrap();
        assert_eq!(programs.changed(), None);
        write(&data, "what a program writes is not the program");
        assert_eq!((programs.changed(), programs.changed()), (None, None));
        write(&beside, "22");
        assert_eq!(programs.changed(), None, "somebody may still be writing");
        assert_eq!((programs.changed(), programs.changed()), (Some(beside.clone()), None));
        // An editor that puts the new one in the place of the old.
        std::fs::remove_file(&law).unwrap();
        assert_eq!((programs.changed(), programs.changed()), (None, None));
        write(&law, "333");
        assert_eq!((programs.changed(), programs.changed(), programs.changed()), (None, Some(law), None));

        let tool = folder.path().join("controller");
        write(&tool, "1");
        assert!(Programs::of(&tool.display().to_string()).is_none(), "it cannot be executed");
        std::fs::set_permissions(&tool, std::fs::Permissions::from_mode(0o755)).unwrap();
        let mut programs = Programs::of(&tool.display().to_string()).unwrap();
        write(&tool, "22");
        assert_eq!((programs.changed(), programs.changed()), (None, Some(tool)));
        assert!(Programs::of("true").is_none() && Programs::of("python3 'law.py").is_none());
    }
}
