//! Blocks of bytes for whoever looks on: a service that overflows, so that nobody waits for a reader, or one
//! that says when it is full.

use super::error::{SpaceError, failed};
use super::ports::process_behind;
use super::space::{RunSpace, service_name};
use crate::transport::TransportError;
use iceoryx2::port::BackpressureAction;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::{AllocationStrategy, CallbackProgression};
use iceoryx2::sample::Sample;
use iceoryx2::service::ipc;
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use rustix::process::{Pid, test_kill_process};

/// The sending end, which also keeps the service.
#[derive(Debug)]
pub struct BlockOutbox {
    service: String,
    publisher: Publisher<ipc::Service, [u8], ()>,
    factory: PortFactory<ipc::Service, [u8], ()>,
}

impl BlockOutbox {
    /// Whether somebody has opened the other end, and lives: whoever was killed has not closed it.
    pub fn has_reader(&self) -> bool {
        let mut has_one = false;
        self.factory.dynamic_config().list_subscribers(|subscriber| {
            let process = process_behind(&subscriber.node_id).and_then(|id| Pid::from_raw(id as i32));
            has_one = process.is_none_or(|process| test_kill_process(process).is_ok());
            if has_one { CallbackProgression::Stop } else { CallbackProgression::Continue }
        });
        has_one
    }

    /// Sends a block of that many bytes, which `fill` writes piece by piece where it will be read. `false` when
    /// nobody got it: there is no reader, or as many blocks wait as may in a service that does not overflow.
    ///
    /// # Panics
    /// When `fill` writes another number of bytes.
    pub fn send(
        &self,
        length: usize,
        fill: impl FnOnce(&mut dyn FnMut(&[u8])),
    ) -> Result<bool, TransportError> {
        let failed = |reason: String| TransportError::Failed { service: self.service.clone(), reason };
        let mut sample = self.publisher.loan_slice(length).map_err(|e| failed(format!("{e:?}")))?;
        let mut rest = sample.payload_mut();
        fill(&mut |piece| {
            let (here, after) = std::mem::take(&mut rest).split_at_mut(piece.len());
            here.copy_from_slice(piece);
            rest = after;
        });
        assert!(rest.is_empty(), "a block is as long as was said");
        let reached = sample.send().map_err(|e| failed(format!("{e:?}")))?;
        Ok(reached > 0)
    }
}

/// The receiving end.
#[derive(Debug)]
pub struct BlockInbox {
    service: String,
    subscriber: Subscriber<ipc::Service, [u8], ()>,
}

/// A block where it lies in shared memory.
#[derive(Debug)]
pub struct Block(Sample<ipc::Service, [u8], ()>);

impl Block {
    /// Its bytes.
    pub fn bytes(&self) -> &[u8] {
        self.0.payload()
    }
}

impl BlockInbox {
    /// The next block, if there is one. Blocks that came faster than they were taken are gone.
    pub fn receive(&self) -> Result<Option<Block>, TransportError> {
        match self.subscriber.receive() {
            Ok(sample) => Ok(sample.map(Block)),
            Err(e) => Err(TransportError::Failed { service: self.service.clone(), reason: format!("{e:?}") }),
        }
    }
}

impl RunSpace {
    /// Creates a service for blocks of about so many bytes, so many of which may wait to be read by each of so many
    /// readers; when there are more, the oldest gives way, or the newest is not sent.
    pub fn create_blocks(
        &self,
        name: &str,
        expected: usize,
        (waiting, readers): (usize, usize),
        overflows: bool,
    ) -> Result<BlockOutbox, SpaceError> {
        let factory = self
            .node()
            .service_builder(&service_name(name)?)
            .publish_subscribe::<[u8]>()
            .enable_safe_overflow(overflows)
            .subscriber_max_buffer_size(waiting)
            .subscriber_max_borrowed_samples(2)
            .max_publishers(1)
            .max_subscribers(readers)
            .max_nodes(2 + readers)
            .create()
            .map_err(|e| failed(&format!("create service {name}"), &e))?;
        let publisher = factory
            .publisher_builder()
            .initial_max_slice_len(expected)
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            .set_backpressure_handler(|_| BackpressureAction::DiscardData)
            .create()
            .map_err(|e| failed(&format!("create a publisher of {name}"), &e))?;
        Ok(BlockOutbox { service: name.to_owned(), publisher, factory })
    }

    /// Opens the receiving end; `None` while there is no such service.
    pub fn open_blocks(&self, name: &str) -> Result<Option<BlockInbox>, SpaceError> {
        let Ok(factory) =
            self.node().service_builder(&service_name(name)?).publish_subscribe::<[u8]>().open()
        else {
            return Ok(None);
        };
        let subscriber = factory
            .subscriber_builder()
            .create()
            .map_err(|e| failed(&format!("create a subscriber of {name}"), &e))?;
        Ok(Some(BlockInbox { service: name.to_owned(), subscriber }))
    }
}

/// Bytes of one message at most.
const MOST_ORDER_BYTES: usize = 256;
/// Orders that may wait to be taken, and processes that may give some.
const WAITING_ORDERS: usize = 16;
const GIVERS: usize = 2;

/// Where a run is steered from outside: messages of a few bytes, from whoever has opened the other end.
#[derive(Debug)]
pub struct SteeringInbox {
    service: String,
    subscriber: Subscriber<ipc::Service, [u8], ()>,
    _factory: PortFactory<ipc::Service, [u8], ()>,
}

/// The other end: where they are sent.
#[derive(Debug)]
pub struct SteeringOutbox {
    service: String,
    publisher: Publisher<ipc::Service, [u8], ()>,
}

impl SteeringInbox {
    /// A copy of the next message, if there is one.
    pub fn receive(&self) -> Result<Option<Vec<u8>>, TransportError> {
        match self.subscriber.receive() {
            Ok(sample) => Ok(sample.map(|sample| sample.payload().to_vec())),
            Err(e) => Err(TransportError::Failed { service: self.service.clone(), reason: format!("{e:?}") }),
        }
    }
}

impl SteeringOutbox {
    /// Sends a message.
    pub fn send(&self, message: &[u8]) -> Result<(), TransportError> {
        let failed = |reason: String| TransportError::Failed { service: self.service.clone(), reason };
        let mut sample = self.publisher.loan_slice(message.len()).map_err(|e| failed(format!("{e:?}")))?;
        sample.payload_mut().copy_from_slice(message);
        sample.send().map_err(|e| failed(format!("{e:?}")))?;
        Ok(())
    }
}

impl RunSpace {
    /// Creates a service for steering.
    pub fn create_steering(&self, name: &str) -> Result<SteeringInbox, SpaceError> {
        let factory = self
            .node()
            .service_builder(&service_name(name)?)
            .publish_subscribe::<[u8]>()
            .enable_safe_overflow(true)
            .subscriber_max_buffer_size(WAITING_ORDERS)
            .max_publishers(GIVERS)
            .max_subscribers(1)
            .max_nodes(2 + GIVERS)
            .create()
            .map_err(|e| failed(&format!("create service {name}"), &e))?;
        let subscriber = factory
            .subscriber_builder()
            .create()
            .map_err(|e| failed(&format!("create a subscriber of {name}"), &e))?;
        Ok(SteeringInbox { service: name.to_owned(), subscriber, _factory: factory })
    }

    /// Opens the end from which a run is steered; `None` when there is no such service.
    pub fn open_steering(&self, name: &str) -> Result<Option<SteeringOutbox>, SpaceError> {
        let Ok(factory) =
            self.node().service_builder(&service_name(name)?).publish_subscribe::<[u8]>().open()
        else {
            return Ok(None);
        };
        let publisher = factory
            .publisher_builder()
            .initial_max_slice_len(MOST_ORDER_BYTES)
            .create()
            .map_err(|e| failed(&format!("create a publisher of {name}"), &e))?;
        Ok(Some(SteeringOutbox { service: name.to_owned(), publisher }))
    }
}
