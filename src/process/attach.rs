//! How participants join a run, on both sides.

use super::peers::is_alive;
use super::run_spec::plugin_bytes;
use super::seating::{Judgement, Seating};
use super::{Peer, Peers, ProcessError, StopFlag, WaitMode};
use crate::encoding;
use crate::lockstep::{Handover, Seat};
use crate::own_time::Bound;
use crate::scenario::{Drivers, OnExit, Scenario, decode, scenario_hash};
use crate::transport::TransportError;
use crate::transport::iox::{AttachLine, AttachServer, Bells, RunName, RunSpace, SpaceError};
use ipc_schemas::{self as frames, AttachReply, AttachRequest, Role, schema_hash};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Time between two looks for an answer.
const LOOK: Duration = Duration::from_millis(1);
/// Time after which an unanswered request is repeated.
const REPEAT: Duration = Duration::from_millis(100);

/// What a participant says of itself when it joins.
#[derive(Clone, Copy, Debug)]
pub struct Joining {
    /// Coordinator or controller.
    pub role: Role,
    /// Index wanted among the processes of the role.
    pub index: Option<u16>,
    /// Hash of the scenario it was given, if it was given one.
    pub scenario_hash: Option<u64>,
    /// How long to wait for the world.
    pub timeout: Duration,
}

/// A participant that has been let in, before it is ready.
#[derive(Debug)]
pub struct Attachment {
    /// What the world said.
    pub reply: AttachReply,
    /// The scenario of the run.
    pub scenario: Arc<Scenario>,
    /// The bells of the run.
    pub bells: Bells,
    line: AttachLine,
    request: AttachRequest,
    run: RunName,
    joining: Joining,
}

impl Attachment {
    /// Joins the run whose space this is.
    pub fn join(
        space: &RunSpace,
        run: &RunName,
        joining: Joining,
        stop: &StopFlag,
    ) -> Result<Attachment, ProcessError> {
        let mut bound = Bound::of(joining.timeout);
        let no_world =
            || ProcessError::NoWorld { run: run.to_string(), seconds: joining.timeout.as_secs_f64() };
        let mut instance = [0u8; 8];
        // The instance only tells simultaneous joiners apart; the time will do where there is no entropy.
        if rustix::rand::getrandom(&mut instance, rustix::rand::GetRandomFlags::NONBLOCK).is_err() {
            instance = (std::process::id() as u64).to_le_bytes();
        }
        let request = AttachRequest {
            instance: u64::from_le_bytes(instance),
            schema_hash: schema_hash(),
            scenario_hash: joining.scenario_hash.unwrap_or(frames::ANY_SCENARIO),
            process_id: std::process::id(),
            role: joining.role as u16,
            wanted_index: joining.index.unwrap_or(frames::ANY_INDEX),
            controller: frames::BUILT_IN,
            phase: frames::ATTACH_JOIN,
            index: 0,
        };
        let (line, (reply, bytes)) = loop {
            let world = space.world().filter(|world| is_alive(*world));
            let line = match world.map(|_| space.open_attach_line()) {
                None | Some(Err(SpaceError::NoService { .. })) => {
                    pause(&mut bound, stop, &no_world)?;
                    continue;
                }
                Some(line) => line?,
            };
            // What a dead world has left is let go, so that another one can take its place.
            let still_there = || space.world() == world && world.is_some_and(is_alive);
            if let Some(answer) = exchange(&line, request, &mut bound, stop, &no_world, &still_there)? {
                break (line, answer);
            }
        };
        if reply.status != frames::ATTACH_ACCEPTED {
            let reason = String::from_utf8_lossy(&bytes).into_owned();
            return Err(ProcessError::Refused { run: run.to_string(), role: joining.role, reason });
        }
        let scenario = Arc::new(decode(&bytes)?);
        let bells = space.bells()?;
        Ok(Attachment { reply, scenario, bells, line, request, run: run.clone(), joining })
    }

    /// Tells the world that all ends of the services are open. After this the run may begin; if it has
    /// begun already, what this process needs to go on with it comes back.
    pub fn ready(&self, stop: &StopFlag) -> Result<Option<Handover>, ProcessError> {
        self.ask(frames::ATTACH_READY, stop)
    }

    /// Asks for what is needed to go on, after the run has gone on without this process.
    pub fn catch_up(&self, stop: &StopFlag) -> Result<Option<Handover>, ProcessError> {
        self.ask(frames::ATTACH_RESTORE, stop)
    }

    fn ask(&self, phase: u32, stop: &StopFlag) -> Result<Option<Handover>, ProcessError> {
        let request = AttachRequest { phase, index: self.reply.index, ..self.request };
        let seconds = self.joining.timeout.as_secs_f64();
        let no_world = || ProcessError::NoWorld { run: self.run.to_string(), seconds };
        let mut bound = Bound::of(self.joining.timeout);
        // What earlier requests may still have brought is of the past.
        while self.line.next_reply()?.is_some() {}
        let world = self.world();
        let still_there = || world.first_gone().is_none();
        let Some((reply, bytes)) = exchange(&self.line, request, &mut bound, stop, &no_world, &still_there)?
        else {
            let consequence = "this one was waiting for its answer".to_owned();
            let peer = world.0[0];
            return Err(ProcessError::PeerGone { peer, name: peer.to_string(), consequence });
        };
        if reply.status != frames::ATTACH_ACCEPTED {
            let reason = String::from_utf8_lossy(&bytes).into_owned();
            return Err(ProcessError::Refused { run: self.run.to_string(), role: self.joining.role, reason });
        }
        if bytes.is_empty() { Ok(None) } else { Ok(Some(encoding::decode(&bytes)?)) }
    }

    /// The world as a peer.
    pub fn world(&self) -> Peers {
        Peers(vec![Peer { role: Role::World, index: 0, process_id: self.reply.world_process_id }])
    }
}

/// Repeats a request until its reply comes; nothing does any more when the world is no longer there.
fn exchange(
    line: &AttachLine,
    request: AttachRequest,
    bound: &mut Bound,
    stop: &StopFlag,
    too_late: &dyn Fn() -> ProcessError,
    still_there: &dyn Fn() -> bool,
) -> Result<Option<(AttachReply, Vec<u8>)>, ProcessError> {
    let mut repeat_at = Instant::now();
    let patient_until = Instant::now() + LOOK;
    loop {
        if Instant::now() >= repeat_at {
            if !still_there() {
                return Ok(None);
            }
            line.request(request)?;
            repeat_at = Instant::now() + REPEAT;
        }
        while let Some(frame) = line.next_reply()? {
            if frame.reply().instance == request.instance {
                return Ok(Some((*frame.reply(), frame.scenario().to_vec())));
            }
        }
        if Instant::now() < patient_until {
            // Once the run is under way, the world answers at once.
            std::thread::yield_now();
        } else {
            pause(bound, stop, too_late)?;
        }
    }
}

fn pause(
    bound: &mut Bound,
    stop: &StopFlag,
    too_late: &dyn Fn() -> ProcessError,
) -> Result<(), ProcessError> {
    if stop.is_set() {
        return Err(ProcessError::Interrupted { step: None });
    }
    if bound.is_over() {
        return Err(too_late());
    }
    std::thread::sleep(LOOK);
    Ok(())
}

/// Why a participant is refused, in words that travel behind the reply.
fn refusal(request: &AttachRequest, reply: &AttachReply, plugins: &str) -> String {
    match reply.status {
        frames::ATTACH_OTHER_SCHEMA => format!(
            "its frames have schema {:016x}, the world's have {:016x}; build both from the same version",
            request.schema_hash, reply.schema_hash
        ),
        frames::ATTACH_OTHER_SCENARIO => format!(
            "it was given scenario {:016x}, the world runs {:016x}; give both the same, or this one none",
            request.scenario_hash, reply.scenario_hash
        ),
        frames::ATTACH_NO_ROOM if request.wanted_index != frames::ANY_INDEX => {
            format!("index {} is taken or beyond the number the world expects", request.wanted_index)
        }
        frames::ATTACH_NO_ROOM => {
            let (c, k) = (reply.coordinators, reply.controllers);
            format!("all places are taken; the run has {c} coordinator and {k} controller processes")
        }
        frames::ATTACH_BAD_ROLE => format!("it asked for role {}, which nobody has", request.role),
        frames::ATTACH_BAD_PHASE => format!("it asked in phase {}, which there is not", request.phase),
        frames::ATTACH_UNDER_WAY => "the run is under way and nobody is missing in it".to_owned(),
        frames::ATTACH_NO_CONTROLLER if request.role != Role::Controller as u16 => {
            "it gave a controller's name and asked for another role".to_owned()
        }
        frames::ATTACH_NO_CONTROLLER if plugins.is_empty() => {
            "the scenario declares no controllers; add a [[controllers]] table".to_owned()
        }
        frames::ATTACH_NO_CONTROLLER => {
            format!("the scenario declares no controller of that name, only {plugins}")
        }
        other => format!("status {other}"),
    }
}

/// The world's side: a server at which participants ask for their places.
#[derive(Debug)]
pub(super) struct Reception {
    server: AttachServer,
    run_id: u64,
    scenario: Vec<u8>,
    scenario_hash: u64,
    waiting: u32,
    seating: Seating,
    /// The bytes behind the reply to each plug-in.
    plugins: Vec<Vec<u8>>,
    plugin_names: String,
    /// The step a participant begins with.
    pub(super) first_step: u64,
    /// Requests that cannot be answered yet.
    pending: Vec<AttachRequest>,
    /// Why somebody was refused last.
    pub(super) last_refusal: Option<String>,
}

/// What the world does about a request, as [`Reception::serve`] is told by its caller.
pub(super) enum Readiness {
    /// There is nothing to be handed over: the run has not begun.
    Begin,
    /// Not now; the answer will be asked for again.
    Later,
    /// What the process needs.
    Now(Box<Handover>),
}

impl Reception {
    pub(super) fn open(
        space: &RunSpace,
        scenario: &Scenario,
        run_id: u64,
        (coordinators, controllers): (u32, u32),
        wait: WaitMode,
    ) -> Result<Reception, SpaceError> {
        let bytes = crate::scenario::encode(scenario);
        let drivers = Drivers::new(scenario, controllers);
        let plugins: Vec<_> = (drivers.pool()..)
            .zip(&scenario.plugins)
            .map(|(index, _)| plugin_bytes(scenario, &drivers, index))
            .collect();
        let names = scenario.plugins.iter().map(|plugin| plugin.name_hash()).collect();
        let mut seating =
            Seating::new(scenario_hash(scenario), coordinators as usize, controllers as usize, names);
        for (plugin, _) in
            scenario.plugins.iter().enumerate().filter(|(_, plugin)| plugin.on_exit == OnExit::Builtin)
        {
            seating.let_stand_in(plugin);
        }
        let longest = plugins.iter().map(Vec::len).max().unwrap_or(0).max(bytes.len());
        let hash = scenario_hash(scenario);
        Ok(Reception {
            server: space.create_attach_server((coordinators + controllers) as usize, longest)?,
            seating,
            plugins,
            first_step: 0,
            pending: Vec::new(),
            last_refusal: None,
            plugin_names: scenario.plugins.iter().map(|p| p.name.as_str()).collect::<Vec<_>>().join(", "),
            run_id,
            scenario_hash: hash,
            scenario: bytes,
            waiting: wait.code(),
        })
    }

    /// Answers what has come. `hand_over` is asked, for a process of the run that is ready or has fallen
    /// behind, what it needs.
    pub(super) fn serve(
        &mut self,
        hand_over: &mut dyn FnMut(Role, u32, Seat) -> Readiness,
    ) -> Result<(), TransportError> {
        for request in std::mem::take(&mut self.pending) {
            self.answer(request, hand_over)?;
        }
        while let Some(request) = self.server.next_request()? {
            self.pending.retain(|p| p.instance != request.instance);
            self.answer(request, hand_over)?;
        }
        Ok(())
    }

    fn answer(
        &mut self,
        request: AttachRequest,
        hand_over: &mut dyn FnMut(Role, u32, Seat) -> Readiness,
    ) -> Result<(), TransportError> {
        let judgement = self.seating.judge(&request, is_alive);
        let (status, index, generation) = match judgement {
            Judgement::Seated { index, generation, .. } => (frames::ATTACH_ACCEPTED, index, generation),
            Judgement::Refused(status) => (status, 0, 0),
        };
        let reply = AttachReply {
            instance: request.instance,
            run_id: self.run_id,
            schema_hash: schema_hash(),
            scenario_hash: self.scenario_hash,
            first_step: self.first_step,
            status,
            world_process_id: std::process::id(),
            generation,
            index,
            coordinators: self.seating.places(Role::Coordinator).len() as u32,
            controllers: self.seating.places(Role::Controller).len() as u32,
            waiting: self.waiting,
            reserved: 0,
        };
        let Judgement::Seated { role, plugin, .. } = judgement else {
            let reason = refusal(&request, &reply, &self.plugin_names);
            self.server.reply(reply, reason.as_bytes())?;
            self.last_refusal = Some(reason);
            return Ok(());
        };
        let joins = request.phase == frames::ATTACH_JOIN;
        let stands_in = role == Role::Controller && self.seating.is_stood_in(index as usize);
        let seat = Seat::new(generation, request.process_id).standing_in(stands_in);
        let handed = if joins { Readiness::Begin } else { hand_over(role, index, seat) };
        match handed {
            _ if joins => self.server.reply(reply, plugin.map_or(&self.scenario, |p| &self.plugins[p])),
            Readiness::Begin => self.server.reply(reply, &[]),
            Readiness::Later => {
                self.pending.push(request);
                Ok(())
            }
            Readiness::Now(handover) if plugin.is_some() => {
                let (first_step, assignments) = handover.assignments();
                self.server.reply(AttachReply { first_step, ..reply }, frames::bytes_of(&assignments))
            }
            Readiness::Now(handover) => {
                let mut bytes = Vec::new();
                encoding::encode_onto(&mut bytes, &handover);
                self.server.reply(reply, &bytes)
            }
        }
    }

    /// The run has begun: whoever comes from now on goes on from this step.
    pub(super) fn go_on_from(&mut self, step: u64) {
        self.seating.begin();
        self.first_step = step;
    }

    /// The first participant that is not ready, or died since: its role and index.
    pub(super) fn first_missing(&self) -> Option<(Role, usize)> {
        self.seating.first_missing(is_alive)
    }

    /// What to call a participant.
    pub(super) fn name_of(&self, role: Role, index: usize) -> String {
        let plugin = (role == Role::Controller).then(|| index.checked_sub(self.seating.pool())).flatten();
        match plugin.and_then(|i| self.plugin_names.split(", ").nth(i)) {
            Some(name) => format!("controller {name} (attaching as CZ_CONTROLLER={name})"),
            None => format!("{role} {index}"),
        }
    }

    /// Whether a controller is ready.
    pub(super) fn is_ready(&self, controller: usize) -> bool {
        self.seating.places(Role::Controller)[controller].occupant.is_some_and(|o| o.ready)
    }

    /// The places as they are taken before the run begins.
    pub(super) fn seats(&self) -> impl Iterator<Item = (Role, u32, Seat)> {
        self.peers().0.into_iter().map(|Peer { role, index, process_id }| {
            let stands_in = role == Role::Controller && self.seating.is_stood_in(index as usize);
            (role, index, Seat::new(0, process_id).standing_in(stands_in))
        })
    }

    /// Frees the place of a controller that has been ended.
    pub(super) fn vacate(&mut self, controller: usize) {
        self.seating.vacate(controller);
    }

    /// Whether one of ours has the place of a controller written elsewhere.
    pub(super) fn is_stood_in(&self, controller: usize) -> bool {
        self.seating.is_stood_in(controller)
    }

    /// The generation of a controller.
    pub(super) fn generation(&self, controller: usize) -> u32 {
        self.seating.places(Role::Controller)[controller].generation
    }

    /// All participants.
    pub(super) fn peers(&self) -> Peers {
        let of_role = |role| {
            let places = self.seating.places(role).iter().zip(0..);
            places.filter_map(move |(place, index)| {
                let process_id = place.occupant?.process_id;
                Some(Peer { role, index, process_id })
            })
        };
        Peers(of_role(Role::Coordinator).chain(of_role(Role::Controller)).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_names_both_hashes() {
        let request =
            AttachRequest { schema_hash: 0x0123, scenario_hash: 0x4567, ..AttachRequest::default() };
        let reply = AttachReply { schema_hash: 0x89ab, scenario_hash: 0xcdef, ..AttachReply::default() };
        let said = |status| refusal(&request, &AttachReply { status, ..reply }, "");
        for (status, own, worlds) in [
            (frames::ATTACH_OTHER_SCHEMA, "0000000000000123", "00000000000089ab"),
            (frames::ATTACH_OTHER_SCENARIO, "0000000000004567", "000000000000cdef"),
        ] {
            assert!(said(status).contains(own) && said(status).contains(worlds), "{}", said(status));
        }
    }
}
