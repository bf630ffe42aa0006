//! Receiving ends: what came, who sent it, and what was refused.

use crate::Error;
use crate::attach::name;
use crate::space::failed;
use iceoryx2::node::Node;
use iceoryx2::port::ReceiveError;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::CallbackProgression;
use iceoryx2::sample::Sample;
use iceoryx2::service::ipc;
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use ipc_schemas::{FrameHeader, HeaderFault, Record, Role};

/// A frame where it lies in shared memory.
pub(crate) type Frame<R> = Sample<ipc::Service, [R], FrameHeader>;

/// The receiving end of a service.
pub(crate) struct Inbox<R: Record> {
    subscriber: Subscriber<ipc::Service, [R], FrameHeader>,
    /// Knows the ports of the service.
    factory: PortFactory<ipc::Service, [R], FrameHeader>,
    service: String,
}

impl<R: Record> Inbox<R> {
    pub(crate) fn open(node: &Node<ipc::Service>, service: &str) -> Result<Inbox<R>, Error> {
        let factory = node
            .service_builder(&name(service)?)
            .publish_subscribe::<[R]>()
            .user_header::<FrameHeader>()
            .open()
            .map_err(|e| failed(&format!("open {service}"), &e))?;
        let subscriber = factory
            .subscriber_builder()
            .create()
            .map_err(|e| failed(&format!("subscribe to {service}"), &e))?;
        Ok(Inbox { subscriber, factory, service: service.to_owned() })
    }

    /// The next frame, if there is one.
    pub(crate) fn receive(&self) -> Result<Option<Frame<R>>, Error> {
        match self.subscriber.receive() {
            Ok(frame) => Ok(frame),
            // Nothing but frames of senders of whom enough is held already.
            Err(ReceiveError::ExceedsMaxBorrows) => Ok(None),
            Err(error) => Err(failed(&format!("receive from {}", self.service), &error)),
        }
    }

    /// The process behind a sending end, where it still exists.
    pub(crate) fn process_of(&self, origin: u128) -> Option<u32> {
        let mut process = None;
        self.factory.dynamic_config().list_publishers(|publisher| {
            if publisher.publisher_id.value() != origin {
                return CallbackProgression::Continue;
            }
            process = publisher.node_id.pid::<ipc::Service>().ok().map(|pid| pid.value() as u32);
            CallbackProgression::Stop
        });
        process
    }
}

/// Why a frame was not taken.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub(crate) enum Refusal {
    /// The header is not what the protocol asks for.
    #[error("{0}")]
    Header(#[from] HeaderFault),
    /// Another process than the one that has the place it claims.
    #[error("it was sent by another process than the one that has this place, which is {expected}")]
    Stranger {
        /// The process that has the place.
        expected: u32,
    },
    /// A coordinator there is not.
    #[error("the run has {coordinators} coordinators")]
    NoSuchCoordinator {
        /// Their number.
        coordinators: u32,
    },
    /// A zone there is not.
    #[error("record {record}, field zone: there is no zone {zone}")]
    NoSuchZone {
        /// Place in the frame.
        record: usize,
        /// The zone named.
        zone: u32,
    },
}

/// Frames of one sender that were not taken.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refused {
    /// Who sent them: the role and index claimed, and the process where it is known.
    pub sender: String,
    /// Their number.
    pub frames: u64,
    /// What was wrong with the last one.
    pub last: String,
}

impl std::fmt::Display for Refused {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "refused {} frames of {}; the last: {}", self.frames, self.sender, self.last)
    }
}

/// Accounts are kept for this many senders; the rest share one.
const MAX_ACCOUNTS: usize = 16;

#[derive(Debug)]
struct Account {
    origin: u128,
    claim: (u16, u16),
    refused: u64,
    process: Option<u32>,
    last: Refusal,
}

/// What was refused, by sender.
#[derive(Debug, Default)]
pub(crate) struct Refusals(Vec<Account>);

impl Refusals {
    /// Enters a frame of a sending end; its process is asked for once.
    pub(crate) fn enter(
        &mut self,
        header: &FrameHeader,
        origin: u128,
        last: Refusal,
        process: impl FnOnce() -> Option<u32>,
    ) {
        let claim = (header.sender_role, header.sender_index);
        let known = self.0.iter().position(|a| a.origin == origin && a.claim == claim);
        let at = known.unwrap_or_else(|| {
            if self.0.len() < MAX_ACCOUNTS {
                let (process, last) = (process(), last.clone());
                self.0.push(Account { origin, claim, refused: 0, process, last });
            }
            self.0.len() - 1
        });
        self.0[at].refused += 1;
        self.0[at].last = last;
    }

    /// All of it.
    pub(crate) fn report(&self) -> Vec<Refused> {
        let sender = |a: &Account| {
            let (role, index) = a.claim;
            let claim = match Role::from_code(role) {
                Some(Role::World) => "the world".to_owned(),
                Some(role) => format!("{role} {index}"),
                None => format!("a sender of unknown role {role}"),
            };
            a.process.map_or(claim.clone(), |process| format!("{claim} (process {process})"))
        };
        let refused =
            |a: &Account| Refused { sender: sender(a), frames: a.refused, last: a.last.to_string() };
        self.0.iter().map(refused).collect()
    }
}
