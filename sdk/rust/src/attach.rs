//! Joining: ask, read the run's numbers, open the services, say ready.

use crate::space::Space;
use crate::space::failed;
use crate::view::{Approach, Run};
use crate::{Error, Options, space};
use iceoryx2::node::Node;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::ServiceName;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError as Open;
use iceoryx2::service::ipc;
use ipc_schemas::{self as frames, ApproachSpec, AttachReply, AttachRequest, Record, RunSpec};
use std::time::{Duration, Instant};

const LOOK: Duration = Duration::from_millis(2);
const REPEAT: Duration = Duration::from_millis(100);

/// The way to the world's reception.
pub(crate) struct Line {
    requests: Publisher<ipc::Service, AttachRequest, ()>,
    replies: Subscriber<ipc::Service, [u8], AttachReply>,
    request: AttachRequest,
    deadline: Instant,
    options: Options,
}

pub(crate) fn name(text: &str) -> Result<ServiceName, Error> {
    ServiceName::new(text).map_err(|e| failed("form a service name", &e))
}

/// Joins; the space, the line, the reply, and the run.
pub(crate) fn join(options: &Options) -> Result<(Space, Line, AttachReply, Run), Error> {
    let deadline = Instant::now() + options.attach_timeout;
    let no_world =
        || Error::NoWorld { run: options.run.clone(), seconds: options.attach_timeout.as_secs_f64() };
    // A node in a space nobody has begun would leave a directory behind.
    while !space::exists(&options.run) {
        if Instant::now() >= deadline {
            return Err(no_world());
        }
        std::thread::sleep(LOOK);
    }
    let space = space::enter(&options.run)?;
    let (requests, replies) = loop {
        match services(space.node())? {
            Some(pair) => break pair,
            None if Instant::now() >= deadline => return Err(no_world()),
            None => std::thread::sleep(LOOK),
        }
    };
    let mut instance = [0u8; 8];
    // The instance only tells simultaneous joiners apart; the process id will do where there is no entropy.
    if rustix::rand::getrandom(&mut instance, rustix::rand::GetRandomFlags::NONBLOCK).is_err() {
        instance = u64::from(std::process::id()).to_le_bytes();
    }
    let request = AttachRequest {
        instance: u64::from_le_bytes(instance),
        schema_hash: options.schema_hash,
        scenario_hash: frames::ANY_SCENARIO,
        controller: frames::name_hash(&options.controller),
        process_id: std::process::id(),
        role: frames::ROLE_CONTROLLER,
        wanted_index: frames::ANY_INDEX,
        phase: frames::ATTACH_JOIN,
        index: 0,
    };
    let line = Line { requests, replies, request, deadline, options: options.clone() };
    let (reply, bytes) = line.exchange(request)?;
    if reply.status != frames::ATTACH_ACCEPTED {
        let reason = String::from_utf8_lossy(&bytes).into_owned();
        return Err(Error::Refused { controller: options.controller.clone(), reason });
    }
    let run = read_run(&bytes, reply.index)?;
    Ok((space, line, reply, run))
}

type Pair = (Publisher<ipc::Service, AttachRequest, ()>, Subscriber<ipc::Service, [u8], AttachReply>);

/// Both ends of the reception; `None` while the world has not opened it.
fn services(node: &Node<ipc::Service>) -> Result<Option<Pair>, Error> {
    let missing =
        |e: &Open| matches!(e, Open::DoesNotExist | Open::IsMarkedForDestruction | Open::HangsInCreation);
    let requests = match node
        .service_builder(&name(frames::SERVICE_ATTACH)?)
        .publish_subscribe::<AttachRequest>()
        .open()
    {
        Ok(service) => service,
        Err(e) if missing(&e) => return Ok(None),
        Err(e) => return Err(failed("open the attach service", &e)),
    };
    let replies = match node
        .service_builder(&name(frames::SERVICE_ATTACH_REPLY)?)
        .publish_subscribe::<[u8]>()
        .user_header::<AttachReply>()
        .open()
    {
        Ok(service) => service,
        Err(e) if missing(&e) => return Ok(None),
        Err(e) => return Err(failed("open the attach-reply service", &e)),
    };
    let subscriber = replies.subscriber_builder().create().map_err(|e| failed("subscribe to replies", &e))?;
    let publisher = requests.publisher_builder().create().map_err(|e| failed("publish requests", &e))?;
    Ok(Some((publisher, subscriber)))
}

impl Line {
    /// Tells the world that all services are open.
    pub(crate) fn ready(&self, index: u32) -> Result<(), Error> {
        let request = AttachRequest { phase: frames::ATTACH_READY, index, ..self.request };
        self.exchange(request).map(|_| ())
    }

    /// Repeats a request until its reply comes.
    fn exchange(&self, request: AttachRequest) -> Result<(AttachReply, Vec<u8>), Error> {
        let mut repeat_at = Instant::now();
        loop {
            let now = Instant::now();
            if now >= repeat_at {
                self.requests.send_copy(request).map_err(|e| failed("send an attach request", &e))?;
                repeat_at = now + REPEAT;
            }
            while let Some(sample) = self.replies.receive().map_err(|e| failed("receive a reply", &e))? {
                if sample.user_header().instance == request.instance {
                    return Ok((*sample.user_header(), sample.payload().to_vec()));
                }
            }
            if now >= self.deadline {
                let seconds = self.options.attach_timeout.as_secs_f64();
                return Err(Error::NoWorld { run: self.options.run.clone(), seconds });
            }
            std::thread::sleep(LOOK);
        }
    }
}

/// Reads records off the front of a reply.
fn read<R: Record>(bytes: &mut &[u8]) -> Option<R> {
    let (front, rest) = bytes.split_at_checked(R::LAYOUT.size)?;
    *bytes = rest;
    let mut record = R::default();
    // SAFETY: a record is plain scalars without padding (`record!` proves it), so any bytes make a valid
    // one; `front` has exactly its size and cannot overlap a local.
    unsafe {
        std::ptr::copy_nonoverlapping(front.as_ptr(), (&raw mut record).cast::<u8>(), front.len());
    }
    Some(record)
}

fn read_run(all: &[u8], index: u32) -> Result<Run, Error> {
    let bad = || Error::BadReply(all.len());
    let mut bytes = all;
    let spec: RunSpec = read(&mut bytes).ok_or_else(bad)?;
    let mut specs = Vec::new();
    for _ in 0..spec.approaches {
        specs.push(read::<ApproachSpec>(&mut bytes).ok_or_else(bad)?);
    }
    let text = std::str::from_utf8(bytes).map_err(|_| bad())?;
    let approaches: Vec<Approach> = specs
        .into_iter()
        .zip(text.lines())
        .map(|(spec, name)| Approach { spec, name: name.to_owned() })
        .collect();
    // Whoever has an approach is looked up by zone.
    let zones_exist = approaches.iter().all(|a| a.spec.zone < spec.zones) && spec.zones <= spec.approaches;
    if approaches.len() != spec.approaches as usize || !zones_exist {
        return Err(bad());
    }
    Ok(Run { spec, approaches, index })
}
