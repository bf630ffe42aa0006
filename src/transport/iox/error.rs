//! Why shared memory could not be used.

use rustix::process::{Resource, getrlimit};
use std::path::PathBuf;

/// Where shared memory lies.
pub(super) const SHARED_MEMORY: &str = "/dev/shm";

/// Why the space of a run could not be entered or used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SpaceError {
    /// The run's world has not created the service (yet).
    #[error("service {service} does not exist")]
    NoService {
        /// Service name.
        service: String,
    },
    /// Another world has created the service.
    #[error("service {service} exists already")]
    Exists {
        /// Service name.
        service: String,
    },
    /// The other side declares the service with another record type or with other limits.
    #[error("service {service} is declared differently by the other side: {reason}")]
    Incompatible {
        /// Service name.
        service: String,
        /// What iceoryx2 said.
        reason: String,
    },
    /// A file or directory that is to be used is not ours.
    #[error("cannot use {}: {problem}", .path.display())]
    NotOurs {
        /// Which.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// Shared memory is full, or nearly.
    #[error("{SHARED_MEMORY} has {free} of free memory; the run needs {needed}")]
    NoRoom {
        /// What is left.
        free: String,
        /// What may be needed.
        needed: String,
    },
    /// iceoryx2 or the file system failed.
    #[error("{what}: {reason}")]
    Failed {
        /// What was attempted.
        what: String,
        /// What was said.
        reason: String,
    },
}

/// With fewer files than this a process of a run may not get by.
const FEW_FILES: u64 = 256;

pub(super) fn failed(what: &str, reason: &dyn std::fmt::Debug) -> SpaceError {
    // iceoryx2 does not tell for want of what it failed.
    let few = getrlimit(Resource::Nofile).current.filter(|most| *most < FEW_FILES);
    let hint =
        few.map(|most| format!("; only {most} files may be open, see `ulimit -n`")).unwrap_or_default();
    SpaceError::Failed { what: what.to_owned(), reason: format!("{reason:?}{hint}") }
}
