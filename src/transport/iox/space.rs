//! The shared-memory space of one run: its node, its services, and their removal.
//!
//! A run has a directory of its own and a file-name prefix of its own (`place`). Whoever leaves last removes
//! both, including the one global file iceoryx2 leaves behind.

use super::bell::{BellRope, Bells};
use super::error::{SHARED_MEMORY, SpaceError, failed};
use super::leftovers::sweep_dead_runs;
use super::name::RunName;
use super::place::{Base, Found, Place, Presence, prefixes_in_shared_memory, shared_memory};
use super::ports::{Factory, IoxInbox, IoxOutbox};
use super::unfinished::remove_unfinished;
use super::watchdog::within_bounds;
use crate::transport::{Backlog, TransportError};
use iceoryx2::config::Config;
use iceoryx2::port::BackpressureAction;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::{
    AllocationStrategy, LogLevel, Node, NodeBuilder, SemanticString, ServiceName, SignalHandlingMode,
    set_log_level,
};
use iceoryx2::sample::Sample;
use iceoryx2::service::builder::publish_subscribe::{PublishSubscribeCreateError, PublishSubscribeOpenError};
use iceoryx2::service::ipc;
use ipc_schemas::{
    AttachReply, AttachRequest, FrameHeader, Record, Role, SERVICE_ATTACH, SERVICE_ATTACH_REPLY,
};
use rustix::fs::statvfs;
use rustix::io::Errno;
use std::io::Write;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::rc::Rc;

/// How many ports of a service there may be, and what waits in them. Each send walks all subscriber slots, so
/// these are tight.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ServiceLimits {
    /// Publishers.
    pub publishers: usize,
    /// Subscribers.
    pub subscribers: usize,
    /// Processes.
    pub nodes: usize,
    /// What a sender's frames may do in a receiver that has not taken them yet.
    pub backlog: Backlog,
}

/// An open service of a run.
#[derive(Debug)]
pub struct Service<R: Record> {
    name: String,
    factory: Rc<Factory<R>>,
}

impl<R: Record> Service<R> {
    /// A sending port for frames of about `expected_records`; longer frames make it grow.
    pub fn outbox(&self, expected_records: usize) -> Result<IoxOutbox<R>, SpaceError> {
        let publisher = self
            .factory
            .publisher_builder()
            .max_loaned_samples(1)
            .initial_max_slice_len(expected_records.max(1))
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            // Nobody waits for a receiver that does not take its frames.
            .set_backpressure_handler(|_| BackpressureAction::DiscardData)
            .create()
            .map_err(|e| failed(&format!("create a publisher of {}", self.name), &e))?;
        Ok(IoxOutbox::new(self.name.clone(), publisher, self.factory.clone()))
    }

    /// A receiving port.
    pub fn inbox(&self) -> Result<IoxInbox<R>, SpaceError> {
        let subscriber = self
            .factory
            .subscriber_builder()
            .create()
            .map_err(|e| failed(&format!("create a subscriber of {}", self.name), &e))?;
        Ok(IoxInbox::new(self.name.clone(), subscriber, self.factory.clone()))
    }
}

/// Membership in a run's space. Dropped, it leaves; the last to leave removes everything.
#[derive(Debug)]
pub struct RunSpace {
    // Declared first so that it is dropped before the files are swept.
    node: Option<Node<ipc::Service>>,
    presence: Option<Presence>,
    run: RunName,
    /// Where the run's bells are.
    pub(super) bells_path: PathBuf,
    prefix: String,
}

/// The file in shared memory that names a run's world, and the same while it is written.
const WORLD: &str = "world";
const BEGINNING: &str = ".begins";
/// Of the 255 characters iceoryx2 allows a path, what its longest file names leave for directory and prefix.
const LONGEST_PATH: usize = 136;
/// Room in shared memory below which no run is begun, bytes.
const LEAST_ROOM: u64 = 1 << 20;
/// Frames of one sender a receiver may hold: the world keeps those of this step and of the one before, and
/// holds on to two bad ones so that others get their turn.
const BORROWED: usize = 4;

impl RunSpace {
    /// Enters the space of a run, creating it when nobody else has. Whoever creates one removes what dead runs
    /// have left, whatever their names.
    pub fn enter(run: &RunName) -> Result<RunSpace, SpaceError> {
        // Everything iceoryx2 reports comes back as an error value, which says it better.
        set_log_level(LogLevel::Fatal);
        let Some(base) = Base::open(true)? else { unreachable!("a missing one is made") };
        let (place, begins) = match base.find(run) {
            Found::Run(place) if !place.is_dead() => (place, false),
            Found::Run(dead) => {
                base.remove(&dead);
                (base.begin(run)?, true)
            }
            Found::Nothing => (base.begin(run)?, true),
            Found::Foreign(problem) => return Err(foreign(&base, run, &problem)),
        };
        let presence = Some(place.enter()?);
        // Nobody takes away the directory of a run somebody is in; the next need not wait for what takes longer.
        drop(base);
        let config = config(&place)?;
        let node = within_bounds(&place.prefix, &format!("coming into run {run}"), || {
            let node = NodeBuilder::new()
                .config(&config)
                .signal_handling_mode(SignalHandlingMode::Disabled)
                .create::<ipc::Service>()
                .map_err(|e| failed("create a node", &e))?;
            close_to_others(&place.prefix);
            node.try_cleanup_dead_nodes();
            Ok(node)
        })?;
        if begins {
            sweep_dead_runs();
        }
        let bells_path = Path::new(SHARED_MEMORY).join(format!("{}bells", place.prefix));
        Ok(RunSpace { node: Some(node), presence, run: run.clone(), bells_path, prefix: place.prefix })
    }

    pub(super) fn node(&self) -> &Node<ipc::Service> {
        self.node.as_ref().expect("the node is only taken when the space is dropped")
    }

    /// The process that has said last that it is the run's world, which may be gone.
    pub fn world(&self) -> Option<u32> {
        std::fs::read_to_string(self.file(WORLD)).ok()?.parse().ok()
    }

    /// Says that this process is the run's world and has created its services.
    pub fn announce_world(&self) -> Result<(), SpaceError> {
        self.put(WORLD, std::process::id().to_string().as_bytes())
    }

    /// Puts a file beside the run's others, for its owner alone.
    pub fn put(&self, name: &str, bytes: &[u8]) -> Result<(), SpaceError> {
        let (path, beginning) = (self.file(name), self.file(&format!("{name}{BEGINNING}")));
        // Complete when it appears under its name.
        let open =
            std::fs::OpenOptions::new().write(true).create(true).truncate(true).mode(0o600).open(&beginning);
        open.and_then(|mut file| file.write_all(bytes))
            .and_then(|()| std::fs::rename(&beginning, &path))
            .map_err(|e| failed(&format!("write {}", path.display()), &e))
    }

    /// What is in a file beside the run's others, if there is one.
    pub fn get(&self, name: &str) -> Option<Vec<u8>> {
        std::fs::read(self.file(name)).ok()
    }

    /// Takes down what a world that is gone has said.
    pub fn forget_world(&self) {
        let _ = std::fs::remove_file(self.file(WORLD));
    }

    fn file(&self, name: &str) -> PathBuf {
        Path::new(SHARED_MEMORY).join(format!("{}{name}", self.prefix))
    }

    /// Creates a service as the run's world.
    pub fn create<R: Record>(&self, name: &str, limits: ServiceLimits) -> Result<Service<R>, SpaceError> {
        let factory = self
            .node()
            .service_builder(&service_name(name)?)
            .publish_subscribe::<[R]>()
            .user_header::<FrameHeader>()
            .enable_safe_overflow(limits.backlog == Backlog::Last)
            .history_size(0)
            .subscriber_max_buffer_size(limits.backlog.frames())
            .subscriber_max_borrowed_samples(BORROWED)
            .max_publishers(limits.publishers)
            .max_subscribers(limits.subscribers)
            .max_nodes(limits.nodes)
            .create()
            .map_err(|e| create_error(name, e))?;
        Ok(Service { name: name.to_owned(), factory: Rc::new(factory) })
    }

    /// Opens a service the world has created.
    pub fn open<R: Record>(&self, name: &str) -> Result<Service<R>, SpaceError> {
        let builder = self.node().service_builder(&service_name(name)?);
        let builder = builder.publish_subscribe::<[R]>().user_header::<FrameHeader>();
        let factory = within_bounds(&self.prefix, &format!("opening {name}"), || builder.open())
            .map_err(|e| open_error(name, e))?;
        Ok(Service { name: name.to_owned(), factory: Rc::new(factory) })
    }

    /// Opens the world's side of attaching.
    pub fn create_attach_server(
        &self,
        participants: usize,
        reply_bytes: usize,
    ) -> Result<AttachServer, SpaceError> {
        // Refused participants take slots too, until they leave.
        let slots = participants + 8;
        let requests = self
            .node()
            .service_builder(&service_name(SERVICE_ATTACH)?)
            .publish_subscribe::<AttachRequest>()
            .subscriber_max_buffer_size(4)
            .max_publishers(slots)
            .max_subscribers(1)
            .max_nodes(slots + 1)
            .create()
            .map_err(|e| create_error(SERVICE_ATTACH, e))?;
        let replies = self
            .node()
            .service_builder(&service_name(SERVICE_ATTACH_REPLY)?)
            .publish_subscribe::<[u8]>()
            .user_header::<AttachReply>()
            .subscriber_max_buffer_size(4)
            .max_publishers(1)
            .max_subscribers(slots)
            .max_nodes(slots + 1)
            .create()
            .map_err(|e| create_error(SERVICE_ATTACH_REPLY, e))?;
        Ok(AttachServer {
            requests: requests
                .subscriber_builder()
                .create()
                .map_err(|e| failed("subscribe to attach requests", &e))?,
            replies: replies
                .publisher_builder()
                .initial_max_slice_len(reply_bytes)
                // What is handed over to a replacement may be longer than the scenario.
                .allocation_strategy(AllocationStrategy::PowerOfTwo)
                .create()
                .map_err(|e| failed("publish attach replies", &e))?,
        })
    }

    /// Opens a participant's side of attaching.
    pub fn open_attach_line(&self) -> Result<AttachLine, SpaceError> {
        within_bounds(&self.prefix, "asking the world for a place", || self.attach_line())
    }

    fn attach_line(&self) -> Result<AttachLine, SpaceError> {
        let requests = self
            .node()
            .service_builder(&service_name(SERVICE_ATTACH)?)
            .publish_subscribe::<AttachRequest>()
            .open()
            .map_err(|e| open_error(SERVICE_ATTACH, e))?;
        let replies = self
            .node()
            .service_builder(&service_name(SERVICE_ATTACH_REPLY)?)
            .publish_subscribe::<[u8]>()
            .user_header::<AttachReply>()
            .open()
            .map_err(|e| open_error(SERVICE_ATTACH_REPLY, e))?;
        Ok(AttachLine {
            world: self.bells()?.rope(Role::World, 0),
            replies: replies
                .subscriber_builder()
                .create()
                .map_err(|e| failed("subscribe to attach replies", &e))?,
            requests: requests
                .publisher_builder()
                .create()
                .map_err(|e| failed("publish attach requests", &e))?,
        })
    }

    /// Removes what processes killed in this run have left, while others go on.
    pub fn sweep_dead(&self) {
        within_bounds(&self.prefix, "removing what dead processes have left", || {
            self.node().try_cleanup_dead_nodes()
        });
    }

    /// Removes what a process of the run that was killed has not finished creating, for which others would wait.
    pub fn remove_unfinished(run: &RunName) {
        let prefixes = prefixes_in_shared_memory();
        prefixes.iter().filter(|(name, _)| name == run).for_each(|(_, prefix)| remove_unfinished(prefix));
    }

    /// Says so when shared memory has no room for what the run's files may grow to: whoever writes where there
    /// is none is killed.
    pub fn check_room(&self) -> Result<(), SpaceError> {
        let wrong = |e: Errno| failed(&format!("look at {SHARED_MEMORY}"), &e);
        let memory = statvfs(SHARED_MEMORY).map_err(wrong)?;
        let free = memory.f_bavail * memory.f_frsize;
        let needed: u64 = shared_memory(&self.prefix)
            .iter()
            .filter_map(|path| std::fs::metadata(path).ok())
            .map(|file| file.len().saturating_sub(file.blocks() * 512))
            .sum::<u64>()
            .max(LEAST_ROOM);
        if free >= needed {
            return Ok(());
        }
        let mib = |bytes: u64| format!("{:.1} MiB", bytes as f64 / f64::from(1 << 20));
        Err(SpaceError::NoRoom { free: mib(free), needed: mib(needed) })
    }

    /// Removes everything a run has left when none of its processes lives any more; does nothing
    /// otherwise. Returns whether the space is now empty.
    pub fn sweep(run: &RunName) -> Result<bool, SpaceError> {
        let Some(base) = Base::open(false)? else { return Ok(true) };
        match base.find(run) {
            Found::Nothing => {}
            Found::Run(place) if place.is_dead() => base.remove(&place),
            Found::Run(_) => return Ok(false),
            Found::Foreign(problem) => return Err(foreign(&base, run, &problem)),
        }
        base.remove_if_empty();
        Ok(true)
    }
}

impl Drop for RunSpace {
    fn drop(&mut self) {
        drop(self.node.take());
        drop(self.presence.take());
        // What cannot be removed now is removed by the next who looks.
        let _ = RunSpace::sweep(&self.run);
    }
}

fn foreign(base: &Base, run: &RunName, problem: &str) -> SpaceError {
    let problem = format!("{problem}; choose another name with --run");
    SpaceError::NotOurs { path: base.path.join(run.to_string()), problem }
}

/// Takes from other users what iceoryx2 lets them have: it creates one file per prefix, a counter of nodes,
/// for everybody to write. All others it creates for this user alone. While it is being written it is for nobody
/// to read, by which others know that it is not complete: then it is left to who writes it.
fn close_to_others(prefix: &str) {
    use std::os::unix::fs::PermissionsExt;
    let is_open = |path: &Path| std::fs::metadata(path).is_ok_and(|file| file.mode() & 0o077 != 0);
    for path in shared_memory(prefix) {
        if path.extension().is_some_and(|extension| extension == "global_mgmt") && is_open(&path) {
            let _ = std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o600));
        }
    }
}

fn config(place: &Place) -> Result<Config, SpaceError> {
    let mut config = Config::default();
    let path = place.directory.to_string_lossy();
    let (length, most) = (path.len(), LONGEST_PATH.saturating_sub(place.prefix.len()));
    if length > most {
        // iceoryx2 panics when it forms the path of a connection.
        let problem = format!(
            "{length} characters are too many for the paths of files in it, expected at most {most}; set XDG_RUNTIME_DIR to a shorter one"
        );
        return Err(SpaceError::NotOurs { path: place.directory.clone(), problem });
    }
    let path = iceoryx2::prelude::Path::new(path.as_bytes())
        .map_err(|e| failed(&format!("use the directory {path}"), &e))?;
    config.global.set_root_path(&path);
    config.global.prefix = iceoryx2::prelude::FileName::new(place.prefix.as_bytes())
        .map_err(|e| failed("form a file-name prefix", &e))?;
    Ok(config)
}

pub(super) fn service_name(name: &str) -> Result<ServiceName, SpaceError> {
    ServiceName::new(name).map_err(|e| failed(&format!("form the service name {name}"), &e))
}

fn create_error(name: &str, error: PublishSubscribeCreateError) -> SpaceError {
    match error {
        PublishSubscribeCreateError::AlreadyExists => SpaceError::Exists { service: name.to_owned() },
        other => failed(&format!("create service {name}"), &other),
    }
}

fn open_error(name: &str, error: PublishSubscribeOpenError) -> SpaceError {
    use PublishSubscribeOpenError as Open;
    let service = name.to_owned();
    match error {
        // A service that is being created or removed will exist or not exist a moment later.
        Open::DoesNotExist | Open::IsMarkedForDestruction | Open::HangsInCreation => {
            SpaceError::NoService { service }
        }
        Open::IncompatibleTypes
        | Open::IncompatibleMessagingPattern
        | Open::IncompatibleAttributes
        | Open::ExceedsMaxNumberOfNodes => SpaceError::Incompatible { service, reason: format!("{error:?}") },
        other => failed(&format!("open service {name}"), &other),
    }
}

/// The world's side of attaching.
#[derive(Debug)]
pub struct AttachServer {
    requests: Subscriber<ipc::Service, AttachRequest, ()>,
    replies: Publisher<ipc::Service, [u8], AttachReply>,
}

impl AttachServer {
    /// The next request, if there is one.
    pub fn next_request(&self) -> Result<Option<AttachRequest>, TransportError> {
        match self.requests.receive() {
            Ok(sample) => Ok(sample.map(|s| *s.payload())),
            Err(e) => Err(attach_failure(SERVICE_ATTACH, &e)),
        }
    }

    /// Answers a request with the scenario's bytes behind the reply.
    pub fn reply(&self, reply: AttachReply, scenario: &[u8]) -> Result<(), TransportError> {
        let mut sample = self
            .replies
            .loan_slice_uninit(scenario.len())
            .map_err(|e| attach_failure(SERVICE_ATTACH_REPLY, &e))?;
        *sample.user_header_mut() = reply;
        sample.write_from_slice(scenario).send().map_err(|e| attach_failure(SERVICE_ATTACH_REPLY, &e))?;
        Ok(())
    }
}

/// A participant's side of attaching.
#[derive(Debug)]
pub struct AttachLine {
    /// It may be asleep.
    world: BellRope,
    requests: Publisher<ipc::Service, AttachRequest, ()>,
    replies: Subscriber<ipc::Service, [u8], AttachReply>,
}

/// A reply to somebody's request.
#[derive(Debug)]
pub struct ReplyFrame(Sample<ipc::Service, [u8], AttachReply>);

impl ReplyFrame {
    /// The reply.
    pub fn reply(&self) -> &AttachReply {
        self.0.user_header()
    }

    /// The encoded scenario.
    pub fn scenario(&self) -> &[u8] {
        self.0.payload()
    }
}

impl AttachLine {
    /// Sends a request.
    pub fn request(&self, request: AttachRequest) -> Result<(), TransportError> {
        self.requests.send_copy(request).map_err(|e| attach_failure(SERVICE_ATTACH, &e))?;
        self.world.ring();
        Ok(())
    }

    /// The next reply, if there is one; possibly to somebody else.
    pub fn next_reply(&self) -> Result<Option<ReplyFrame>, TransportError> {
        match self.replies.receive() {
            Ok(sample) => Ok(sample.map(ReplyFrame)),
            Err(e) => Err(attach_failure(SERVICE_ATTACH_REPLY, &e)),
        }
    }
}

fn attach_failure(service: &str, error: &dyn std::fmt::Debug) -> TransportError {
    TransportError::Failed { service: service.to_owned(), reason: format!("{error:?}") }
}

impl RunSpace {
    /// Creates the bells of a run, as its world: the only one, which its services have shown.
    pub fn create_bells(&self) -> Result<Bells, SpaceError> {
        let path = &self.bells_path;
        // What a killed world has left.
        let _ = std::fs::remove_file(path);
        Bells::create(path).map_err(|e| failed(&format!("create {}", path.display()), &e))
    }

    /// The bells of a run whose world has created its services.
    pub fn bells(&self) -> Result<Bells, SpaceError> {
        let path = &self.bells_path;
        Bells::open(path).map_err(|e| match e.kind() {
            // A world that has just begun makes them in a moment.
            std::io::ErrorKind::NotFound => SpaceError::NoService { service: "bells".to_owned() },
            _ => failed(&format!("use {}", path.display()), &e),
        })
    }
}
