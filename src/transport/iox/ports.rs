//! The boxes over iceoryx2 ports.

use super::bell::{BellRope, ring_all};
use crate::trace::{self, Phase};
use crate::transport::{Frame, Inbox, Loan, Outbox, Slots, TransportError};
use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::{LoanError, ReceiveError};
use iceoryx2::prelude::CallbackProgression;
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::ipc;
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use ipc_schemas::{FrameHeader, Record};
use std::rc::Rc;

/// The sending end of a service.
#[derive(Debug)]
pub struct IoxOutbox<R: Record> {
    service: String,
    publisher: Publisher<ipc::Service, [R], FrameHeader>,
    bells: Vec<BellRope>,
    /// Who rings them instead, when awake.
    deputies: Vec<BellRope>,
    /// Knows the ports of the service.
    factory: Rc<Factory<R>>,
}

impl<R: Record> IoxOutbox<R> {
    pub(super) fn new(
        service: String,
        publisher: Publisher<ipc::Service, [R], FrameHeader>,
        factory: Rc<Factory<R>>,
    ) -> Self {
        IoxOutbox { service, publisher, bells: Vec::new(), deputies: Vec::new(), factory }
    }

    /// Rings these bells after every send.
    pub fn ringing(mut self, bells: impl IntoIterator<Item = BellRope>) -> Self {
        self.bells.extend(bells);
        self
    }

    /// Leaves the ringing to these while any of them is awake.
    pub fn leaving_it_to(mut self, deputies: impl IntoIterator<Item = BellRope>) -> Self {
        self.deputies.extend(deputies);
        self
    }
}

impl<R: Record> Outbox<R> for IoxOutbox<R> {
    type Loan<'a> = IoxLoan<'a, R>;

    fn loan(
        &mut self,
        header: FrameHeader,
        count: usize,
        fill: impl FnOnce(&mut Slots<'_, R>),
    ) -> Result<IoxLoan<'_, R>, TransportError> {
        trace::enter(Phase::Publish);
        let mut sample = self.publisher.loan_slice_uninit(count).map_err(|error| match error {
            LoanError::ExceedsMaxLoans => {
                unreachable!("a loan borrows the outbox, so there is never a second one")
            }
            other => self.failed(&other),
        })?;
        *sample.user_header_mut() = FrameHeader { record_count: count as u32, ..header };
        let mut slots = Slots::new(sample.payload_mut());
        fill(&mut slots);
        slots.assert_full();
        // SAFETY: `assert_full` has established that all `count` records have been written.
        let sample = unsafe { sample.assume_init() };
        Ok(IoxLoan { service: &self.service, sample, bells: &self.bells, deputies: &self.deputies })
    }

    fn receivers(&self, visit: &mut dyn FnMut(Option<u32>)) {
        self.factory.dynamic_config().list_subscribers(|subscriber| {
            visit(process_behind(&subscriber.node_id));
            CallbackProgression::Continue
        });
    }
}

impl<R: Record> IoxOutbox<R> {
    fn failed(&self, error: &dyn std::fmt::Debug) -> TransportError {
        TransportError::Failed { service: self.service.clone(), reason: format!("{error:?}") }
    }
}

/// A frame being written in shared memory.
#[derive(Debug)]
pub struct IoxLoan<'a, R: Record> {
    service: &'a str,
    sample: SampleMut<ipc::Service, [R], FrameHeader>,
    bells: &'a [BellRope],
    deputies: &'a [BellRope],
}

impl<R: Record> Loan<R> for IoxLoan<'_, R> {
    fn records(&self) -> &[R] {
        self.sample.payload()
    }

    fn send(self) -> Result<usize, TransportError> {
        let service = self.service;
        let reached = self.sample.send().map_err(|error| TransportError::Failed {
            service: service.to_owned(),
            reason: format!("{error:?}"),
        })?;
        if self.deputies.iter().all(BellRope::is_asleep) {
            ring_all(self.bells);
        }
        trace::enter(Phase::Compute);
        Ok(reached)
    }
}

/// The receiving end of a service.
#[derive(Debug)]
pub struct IoxInbox<R: Record> {
    service: String,
    subscriber: Subscriber<ipc::Service, [R], FrameHeader>,
    /// Knows the ports of the service.
    factory: Rc<Factory<R>>,
}

/// A service as iceoryx2 has it.
pub(super) type Factory<R> = PortFactory<ipc::Service, [R], FrameHeader>;

impl<R: Record> IoxInbox<R> {
    pub(super) fn new(
        service: String,
        subscriber: Subscriber<ipc::Service, [R], FrameHeader>,
        factory: Rc<Factory<R>>,
    ) -> Self {
        IoxInbox { service, subscriber, factory }
    }
}

impl<R: Record> Inbox<R> for IoxInbox<R> {
    type Frame = IoxFrame<R>;

    fn receive(&mut self) -> Result<Option<IoxFrame<R>>, TransportError> {
        match self.subscriber.receive() {
            Ok(Some(sample)) => {
                trace::begin(Phase::Compute, sample.user_header().step);
                Ok(Some(IoxFrame { sample }))
            }
            Ok(None) => Ok(None),
            // Nothing but frames of senders of whom enough is held already.
            Err(ReceiveError::ExceedsMaxBorrows) => Ok(None),
            Err(error) => {
                Err(TransportError::Failed { service: self.service.clone(), reason: format!("{error:?}") })
            }
        }
    }

    fn process_of(&self, origin: u128) -> Option<u32> {
        let mut process = None;
        self.factory.dynamic_config().list_publishers(|publisher| {
            if publisher.publisher_id.value() != origin {
                return CallbackProgression::Continue;
            }
            process = process_behind(&publisher.node_id);
            CallbackProgression::Stop
        });
        process
    }
}

/// The process a node belongs to.
pub(super) fn process_behind(node: &UniqueNodeId) -> Option<u32> {
    node.pid::<ipc::Service>().ok().map(|pid| pid.value() as u32)
}

/// A frame where it lies in shared memory.
#[derive(Debug)]
pub struct IoxFrame<R: Record> {
    sample: Sample<ipc::Service, [R], FrameHeader>,
}

impl<R: Record> Frame<R> for IoxFrame<R> {
    fn header(&self) -> &FrameHeader {
        self.sample.user_header()
    }

    fn records(&self) -> &[R] {
        self.sample.payload()
    }

    fn origin(&self) -> u128 {
        self.sample.origin().value()
    }
}
