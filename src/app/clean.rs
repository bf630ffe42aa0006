//! `cz clean`: removes what crashed runs have left.

use super::args::CleanArgs;
use super::{AppError, print};
use crate::process::ProcessError;
use crate::transport::iox::{Condition, Leftover, clean as sweep};

pub(super) fn clean(args: &CleanArgs) -> Result<(), AppError> {
    let found = sweep(args.dry_run).map_err(ProcessError::from)?;
    let mut text = String::new();
    let mut kept = Vec::new();
    let (mut files, mut owners) = (0, 0);
    for Leftover { name, files: paths, condition } in &found {
        if *condition == Condition::Dead {
            owners += 1;
        }
        for path in paths.iter().filter(|_| *condition == Condition::Dead) {
            let what = match (args.dry_run, path.symlink_metadata().is_err()) {
                (true, _) => "would remove",
                (false, true) => "removed",
                (false, false) => "could not remove",
            };
            files += 1;
            text.push_str(&format!("{what} {}\n", path.display()));
        }
        match condition {
            Condition::Dead => {}
            Condition::Alive => kept.push(format!("left {name}: it is active\n")),
            Condition::Foreign(why) => {
                kept.extend(paths.iter().map(|path| format!("left {}: {why}\n", path.display())));
            }
        }
    }
    text.extend(kept);
    text.push_str(&match owners {
        0 => "nothing to remove\n".to_owned(),
        n => format!("{files} files of {n} runs\n"),
    });
    print(&text)
}
