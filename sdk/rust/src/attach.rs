//! Joining: ask, read the run's numbers, open the services, say ready.

use crate::space::Space;
use crate::space::failed;
use crate::view::{Path, Run};
use crate::{Error, Options, space};
use iceoryx2::node::Node;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::ServiceName;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError as Open;
use iceoryx2::service::ipc;
use ipc_schemas::{
    self as frames, Assignment, AttachReply, AttachRequest, KindSpec, PathSpec, Record, RunSpec,
};
use std::time::{Duration, Instant};

const LOOK: Duration = Duration::from_millis(2);
const REPEAT: Duration = Duration::from_millis(100);

/// The way to the world's reception.
pub(crate) struct Line {
    requests: Publisher<ipc::Service, AttachRequest, ()>,
    replies: Subscriber<ipc::Service, [u8], AttachReply>,
    request: AttachRequest,
    /// What came behind the reply to the first request; whoever had to repeat that gets it again, sooner or later.
    joined: Vec<u8>,
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
    let joined = Vec::new();
    let mut line = Line { requests, replies, request, joined, deadline, options: options.clone() };
    let (reply, bytes) = line.exchange(request)?;
    if reply.status != frames::ATTACH_ACCEPTED {
        return Err(line.refused(&bytes));
    }
    let run = read_run(&bytes, reply.index)?;
    line.joined = bytes;
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

/// From which step on coordination is still to come, and the assignments in force until then.
pub(crate) type InForce = (u64, Vec<Assignment>);

impl Line {
    /// Tells the world that all services are open.
    pub(crate) fn ready(&self, index: u32) -> Result<InForce, Error> {
        let request = AttachRequest { phase: frames::ATTACH_READY, index, ..self.request };
        let (reply, bytes) = self.exchange(request)?;
        self.in_force(&reply, &bytes)
    }

    /// Asks for what was missed while the run went on without this controller; [`caught_up`](Self::caught_up)
    /// has the answer.
    pub(crate) fn catch_up(&self, index: u32) -> Result<(), Error> {
        let request = AttachRequest { phase: frames::ATTACH_RESTORE, index, ..self.request };
        self.requests.send_copy(request).map_err(|e| failed("send an attach request", &e))?;
        Ok(())
    }

    /// The next answer to that, if one has come.
    pub(crate) fn caught_up(&self) -> Result<Option<InForce>, Error> {
        let reply = self.reply()?;
        reply.map(|(reply, bytes)| self.in_force(&reply, &bytes)).transpose()
    }

    /// The next reply to this controller, if one has come, that is not the first one again.
    pub(crate) fn reply(&self) -> Result<Option<(AttachReply, Vec<u8>)>, Error> {
        while let Some(sample) = self.replies.receive().map_err(|e| failed("receive a reply", &e))? {
            let is_own = sample.user_header().instance == self.request.instance;
            if is_own && (self.joined.is_empty() || self.joined != sample.payload()) {
                return Ok(Some((*sample.user_header(), sample.payload().to_vec())));
            }
        }
        Ok(None)
    }

    fn in_force(&self, reply: &AttachReply, bytes: &[u8]) -> Result<InForce, Error> {
        if reply.status != frames::ATTACH_ACCEPTED {
            return Err(self.refused(bytes));
        }
        let assignments = frames::records_from(bytes).ok_or(Error::BadReply(bytes.len()))?;
        Ok((reply.first_step, assignments))
    }

    fn refused(&self, reason: &[u8]) -> Error {
        let controller = self.options.controller.clone();
        Error::Refused { controller, reason: String::from_utf8_lossy(reason).into_owned() }
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
            if let Some(reply) = self.reply()? {
                return Ok(reply);
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
    frames::records_from(front)?.first().copied()
}

fn read_run(all: &[u8], index: u32) -> Result<Run, Error> {
    let bad = || Error::BadReply(all.len());
    let mut bytes = all;
    let spec: RunSpec = read(&mut bytes).ok_or_else(bad)?;
    let mut specs = Vec::new();
    for _ in 0..spec.paths {
        specs.push(read::<PathSpec>(&mut bytes).ok_or_else(bad)?);
    }
    let mut kinds = Vec::new();
    for _ in 0..spec.kinds {
        kinds.push(read::<KindSpec>(&mut bytes).ok_or_else(bad)?);
    }
    let text = std::str::from_utf8(bytes).map_err(|_| bad())?;
    let paths: Vec<Path> = specs
        .into_iter()
        .zip(text.lines())
        .map(|(spec, name)| Path { spec, name: name.to_owned() })
        .collect();
    if paths.len() != spec.paths as usize {
        return Err(bad());
    }
    Run::new(spec, paths, kinds, index).ok_or_else(bad)
}
