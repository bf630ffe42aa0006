//! Where a run's shared memory is: a directory and a file-name prefix that follow from the run's name.

use crate::Error;
use iceoryx2::config::Config;
use iceoryx2::node::Node;
use iceoryx2::prelude::{
    CallbackProgression, LogLevel, NodeBuilder, NodeState, SemanticString, SignalHandlingMode, set_log_level,
};
use iceoryx2::service::ipc;
use std::path::{Path, PathBuf};

pub(crate) fn failed(what: &str, reason: &dyn std::fmt::Debug) -> Error {
    Error::Transport { what: what.to_owned(), reason: format!("{reason:?}") }
}

/// The directory of a run, and the prefix of its shared-memory files (`docs/plugin-contract.md`).
fn place(run: &str) -> (PathBuf, String) {
    let uid = rustix::process::getuid().as_raw();
    let base = match std::env::var_os("XDG_RUNTIME_DIR") {
        Some(runtime) if Path::new(&runtime).is_dir() => PathBuf::from(runtime).join("cz"),
        _ => std::env::temp_dir().join(format!("cz-{uid}")),
    };
    let directory = base.join(run);
    let place = crc32fast::hash(directory.as_os_str().as_encoded_bytes());
    let prefix = format!("cz_{uid}_{run}_{place:08x}_");
    (directory, prefix)
}

/// Whether the run has been begun by its world.
pub(crate) fn exists(run: &str) -> bool {
    place(run).0.is_dir()
}

/// A node in the run's space. Whoever leaves last removes what iceoryx2 leaves behind.
pub(crate) struct Space {
    // Taken when dropped, before the files are swept.
    node: Option<Node<ipc::Service>>,
    config: Config,
    directory: PathBuf,
    prefix: String,
}

impl Space {
    pub(crate) fn node(&self) -> &Node<ipc::Service> {
        self.node.as_ref().expect("the node is only taken when the space is dropped")
    }
}

impl Drop for Space {
    fn drop(&mut self) {
        drop(self.node.take());
        let mut is_alone = true;
        let listed = Node::<ipc::Service>::list(&self.config, |state| {
            is_alone &= matches!(state, NodeState::Dead(_));
            CallbackProgression::Continue
        });
        if listed.is_err() || !is_alone {
            return;
        }
        for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&self.prefix) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
        let _ = std::fs::remove_dir_all(&self.directory);
        // Fails, as it should, while another run has its directory there.
        let _ = self.directory.parent().map(std::fs::remove_dir);
    }
}

/// Enters the space of a run that its world has begun.
pub(crate) fn enter(run: &str) -> Result<Space, Error> {
    set_log_level(LogLevel::Fatal);
    let (directory, prefix) = place(run);
    let mut config = Config::default();
    let path = directory.to_string_lossy();
    config.global.set_root_path(
        &iceoryx2::prelude::Path::new(path.as_bytes()).map_err(|e| failed("use the run's directory", &e))?,
    );
    config.global.prefix = iceoryx2::prelude::FileName::new(prefix.as_bytes())
        .map_err(|e| failed("form a file-name prefix from the run's name", &e))?;
    let node = NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()
        .map_err(|e| failed("create a node", &e))?;
    Ok(Space { node: Some(node), config, directory, prefix })
}
