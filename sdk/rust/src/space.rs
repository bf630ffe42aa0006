//! Where a run's shared memory is: a directory that follows from the run's name, and a file-name prefix that
//! follows from a file in it.

use crate::Error;
use iceoryx2::config::Config;
use iceoryx2::node::Node;
use iceoryx2::prelude::{LogLevel, NodeBuilder, SemanticString, SignalHandlingMode, set_log_level};
use iceoryx2::service::ipc;
use rustix::fs::{FlockOperation, flock};
use std::fs::File;
use std::io::Read;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

pub(crate) fn failed(what: &str, reason: &dyn std::fmt::Debug) -> Error {
    Error::Transport { what: what.to_owned(), reason: format!("{reason:?}") }
}

/// The file in a run's directory by which it is known.
const MARKER: &str = ".cz-run";

/// Where a run is: its directory, the prefix of its shared-memory files, and the locked file that says that
/// somebody is in it (`docs/plugin-contract.md`).
struct Place {
    directory: PathBuf,
    prefix: String,
    marker: File,
}

/// The place of a run, once its world has begun it.
fn place(run: &str) -> Option<Place> {
    let uid = rustix::process::getuid().as_raw();
    let first = match std::env::var_os("XDG_RUNTIME_DIR") {
        Some(runtime) if Path::new(&runtime).is_dir() => PathBuf::from(runtime).join("cz"),
        _ => std::env::temp_dir().join(format!("cz-{uid}")),
    };
    // The first that is a directory of this user, no link, and for nobody else to write.
    let base = (0..10).find_map(|i| {
        let mut base = first.clone().into_os_string();
        if i > 0 {
            base.push(format!("-{i}"));
        }
        let is_ours = std::fs::symlink_metadata(&base)
            .is_ok_and(|m| m.is_dir() && m.uid() == uid && m.mode() & 0o022 == 0);
        is_ours.then(|| PathBuf::from(base))
    })?;
    let directory = base.join(run);
    let mut marker = File::open(directory.join(MARKER)).ok()?;
    let mut instance = String::new();
    (&mut marker).take(9).read_to_string(&mut instance).ok()?;
    let is_instance = instance.len() == 8 && instance.bytes().all(|b| b.is_ascii_hexdigit());
    let prefix = format!("cz_{uid}_{run}_{instance}_");
    is_instance.then_some(Place { directory, prefix, marker })
}

/// Whether the run has been begun by its world.
pub(crate) fn exists(run: &str) -> bool {
    place(run).is_some()
}

/// A node in the run's space. Whoever leaves last removes what iceoryx2 leaves behind.
pub(crate) struct Space {
    // Taken when dropped, before the files are swept.
    node: Option<Node<ipc::Service>>,
    place: Place,
}

impl Space {
    pub(crate) fn node(&self) -> &Node<ipc::Service> {
        self.node.as_ref().expect("the node is only taken when the space is dropped")
    }
}

impl Drop for Space {
    fn drop(&mut self) {
        drop(self.node.take());
        let Place { directory, prefix, marker } = &self.place;
        // Whoever is in the run holds this lock too.
        if flock(marker, FlockOperation::NonBlockingLockExclusive).is_err() {
            return;
        }
        let entries = |path: &Path| std::fs::read_dir(path).into_iter().flatten().flatten();
        for entry in entries(Path::new("/dev/shm")) {
            if entry.file_name().to_string_lossy().starts_with(prefix) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
        // The marker last, by which the directory is known for a run's.
        for entry in entries(directory).filter(|entry| entry.file_name() != MARKER) {
            let _ = std::fs::remove_dir_all(entry.path());
        }
        let _ = std::fs::remove_file(directory.join(MARKER));
        let _ = std::fs::remove_dir(directory);
        // Fails, as it should, while another run has its directory there.
        let _ = directory.parent().map(std::fs::remove_dir);
    }
}

/// Enters the space of a run that its world has begun.
pub(crate) fn enter(run: &str) -> Result<Space, Error> {
    set_log_level(LogLevel::Fatal);
    let place = place(run).ok_or_else(|| failed("enter the run", &"it has ended"))?;
    flock(&place.marker, FlockOperation::NonBlockingLockShared)
        .map_err(|e| failed("enter the run", &format!("it is ending: {e}")))?;
    let mut config = Config::default();
    let path = place.directory.to_string_lossy();
    config.global.set_root_path(
        &iceoryx2::prelude::Path::new(path.as_bytes()).map_err(|e| failed("use the run's directory", &e))?,
    );
    config.global.prefix = iceoryx2::prelude::FileName::new(place.prefix.as_bytes())
        .map_err(|e| failed("form a file-name prefix from the run's name", &e))?;
    let node = NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()
        .map_err(|e| failed("create a node", &e))?;
    Ok(Space { node: Some(node), place })
}
