//! Who has which place in a run, and what becomes of whoever asks for one.
//!
//! A state machine over requests: it knows neither shared memory nor processes, and believes nothing a request
//! says but what it asks for. Whether a process lives is asked of the caller.

use ipc_schemas::{self as frames, AttachRequest, Role, schema_hash};

/// The places of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Seating {
    scenario_hash: u64,
    coordinators: Vec<Place>,
    controllers: Vec<Place>,
    /// Number of controllers of the built-in pool, which come first.
    pool: usize,
    /// Name hash of each plug-in; they have the places behind the pool, in this order.
    plugins: Vec<u64>,
    /// Whose place a controller of ours may take, of the plug-ins.
    may_stand_in: Vec<bool>,
    /// Whether the run has begun.
    under_way: bool,
}

/// A place among the processes of a role.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Place {
    /// Who has it.
    pub occupant: Option<Occupant>,
    /// How often it has been taken anew since the run began.
    pub generation: u32,
}

/// Who has a place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Occupant {
    /// The number it gave itself.
    pub instance: u64,
    /// Its process id.
    pub process_id: u32,
    /// Whether it has said that it is ready.
    pub ready: bool,
    /// Whether it is a controller of ours in the place of a plug-in.
    pub stands_in: bool,
}

/// What becomes of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Judgement {
    /// Its sender has a place.
    Seated {
        /// Coordinator or controller.
        role: Role,
        /// Index among the processes of the role.
        index: u32,
        /// Generation of the place.
        generation: u32,
        /// Index among the plug-ins, if it is one.
        plugin: Option<usize>,
    },
    /// It has none, for this reason: a status of [`AttachReply`](ipc_schemas::AttachReply).
    Refused(u32),
}

impl Place {
    fn is_free(&self, is_alive: &impl Fn(u32) -> bool) -> bool {
        self.occupant.is_none_or(|o| !is_alive(o.process_id))
    }

    /// Whether the request is from whoever has the place. The process counts as well: an instance is only a
    /// number that anybody may name.
    fn is_of(&self, request: &AttachRequest) -> bool {
        self.occupant.is_some_and(|o| (o.instance, o.process_id) == (request.instance, request.process_id))
    }
}

impl Seating {
    /// Empty places for so many coordinators, and controllers in all; the last ones are the plug-ins'.
    ///
    /// # Panics
    /// When there are more plug-ins than controllers.
    pub fn new(scenario_hash: u64, coordinators: usize, controllers: usize, plugins: Vec<u64>) -> Seating {
        let pool = controllers.checked_sub(plugins.len()).expect("plug-ins are controllers");
        Seating {
            scenario_hash,
            coordinators: vec![Place::default(); coordinators],
            controllers: vec![Place::default(); controllers],
            pool,
            may_stand_in: vec![false; plugins.len()],
            plugins,
            under_way: false,
        }
    }

    /// A controller of ours may take the place of this plug-in, once nobody has it; it asks for it by its index.
    pub fn let_stand_in(&mut self, plugin: usize) {
        self.may_stand_in[plugin] = true;
    }

    /// Whether the place of a controller is taken by one of ours in the place of a plug-in.
    pub fn is_stood_in(&self, controller: usize) -> bool {
        self.controllers[controller].occupant.is_some_and(|o| o.stands_in)
    }

    /// The run has begun: from now on whoever comes takes somebody's place.
    pub fn begin(&mut self) {
        self.under_way = true;
    }

    /// The places of coordinators or controllers.
    pub fn places(&self, role: Role) -> &[Place] {
        match role {
            Role::Coordinator => &self.coordinators,
            Role::Controller => &self.controllers,
            Role::World => &[],
        }
    }

    /// Number of controllers of the built-in pool.
    pub fn pool(&self) -> usize {
        self.pool
    }

    /// Frees the place of a controller that has been ended.
    pub fn vacate(&mut self, controller: usize) {
        self.controllers[controller].occupant = None;
    }

    /// The first place whose process is not ready, or has died since.
    pub fn first_missing(&self, is_alive: impl Fn(u32) -> bool) -> Option<(Role, usize)> {
        let there = |place: &Place| place.occupant.is_some_and(|o| o.ready && is_alive(o.process_id));
        let missing = |role| self.places(role).iter().position(|p| !there(p)).map(|index| (role, index));
        missing(Role::Coordinator).or_else(|| missing(Role::Controller))
    }

    /// Seats whoever asks, notes that it is ready, or refuses it; a refusal changes nothing.
    pub fn judge(&mut self, request: &AttachRequest, is_alive: impl Fn(u32) -> bool) -> Judgement {
        self.seat(request, is_alive).unwrap_or_else(Judgement::Refused)
    }

    fn seat(&mut self, request: &AttachRequest, is_alive: impl Fn(u32) -> bool) -> Result<Judgement, u32> {
        if request.schema_hash != schema_hash() {
            return Err(frames::ATTACH_OTHER_SCHEMA);
        }
        if request.scenario_hash != frames::ANY_SCENARIO && request.scenario_hash != self.scenario_hash {
            return Err(frames::ATTACH_OTHER_SCENARIO);
        }
        let joins = match request.phase {
            frames::ATTACH_JOIN => true,
            frames::ATTACH_READY | frames::ATTACH_RESTORE => false,
            _ => return Err(frames::ATTACH_BAD_PHASE),
        };
        let role = Role::from_code(request.role).filter(|role| *role != Role::World);
        let role = role.ok_or(frames::ATTACH_BAD_ROLE)?;
        let plugin = match request.controller {
            frames::BUILT_IN => None,
            // Coordinators have no names.
            _ if role != Role::Controller => return Err(frames::ATTACH_NO_CONTROLLER),
            name => {
                let known = self.plugins.iter().position(|hash| *hash == name);
                Some(known.ok_or(frames::ATTACH_NO_CONTROLLER)?)
            }
        };
        let pool = self.pool;
        let stands_in =
            (role == Role::Controller && plugin.is_none() && request.wanted_index != frames::ANY_INDEX)
                .then(|| usize::from(request.wanted_index).checked_sub(pool))
                .flatten()
                .filter(|plugin| self.may_stand_in.get(*plugin).is_some_and(|may| *may));
        let (first, places) = match (role, plugin.or(stands_in)) {
            (Role::Coordinator, _) => (0, &mut self.coordinators[..]),
            (_, None) => (0, &mut self.controllers[..self.pool]),
            (_, Some(plugin)) => {
                let first = self.pool + plugin;
                (first, &mut self.controllers[first..=first])
            }
        };
        let own = places.iter().position(|p| p.is_of(request));
        let is_newcomer = own.is_none() && joins;
        let free = |place: &Place| place.is_free(&is_alive);
        let place = own.or_else(|| match request.wanted_index {
            _ if !is_newcomer => None,
            frames::ANY_INDEX => places.iter().position(free),
            wanted => {
                let wanted = usize::from(wanted).checked_sub(first)?;
                places.get(wanted).is_some_and(free).then_some(wanted)
            }
        });
        let no_place = if self.under_way { frames::ATTACH_UNDER_WAY } else { frames::ATTACH_NO_ROOM };
        let at = place.ok_or(no_place)?;
        let place = &mut places[at];
        if is_newcomer {
            let AttachRequest { instance, process_id, .. } = *request;
            let stands_in = stands_in.is_some();
            place.occupant = Some(Occupant { instance, process_id, ready: false, stands_in });
            place.generation += u32::from(self.under_way);
        }
        if let Some(occupant) = place.occupant.as_mut().filter(|_| !joins) {
            occupant.ready = true;
        }
        let (index, generation) = ((first + at) as u32, place.generation);
        Ok(Judgement::Seated { role, index, generation, plugin })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL_LIVE: fn(u32) -> bool = |_| true;

    fn request(role: Role, phase: u32) -> AttachRequest {
        AttachRequest {
            instance: 5,
            schema_hash: schema_hash(),
            process_id: 100,
            role: role as u16,
            wanted_index: frames::ANY_INDEX,
            phase,
            ..AttachRequest::default()
        }
    }

    #[test]
    fn a_coordinator_with_a_controllers_name_is_refused() {
        let mut seating = Seating::new(1, 2, 2, vec![77]);
        let named = AttachRequest { controller: 77, ..request(Role::Coordinator, frames::ATTACH_JOIN) };
        let before = seating.clone();
        assert_eq!(seating.judge(&named, ALL_LIVE), Judgement::Refused(frames::ATTACH_NO_CONTROLLER));
        assert_eq!(seating, before);
    }

    #[test]
    fn nobody_speaks_for_another_process() {
        let mut seating = Seating::new(1, 1, 1, Vec::new());
        let join = request(Role::Controller, frames::ATTACH_JOIN);
        let seated = Judgement::Seated { role: Role::Controller, index: 0, generation: 0, plugin: None };
        assert_eq!(seating.judge(&join, ALL_LIVE), seated);
        let ready = request(Role::Controller, frames::ATTACH_READY);
        let other = AttachRequest { process_id: 101, ..ready };
        assert_eq!(seating.judge(&other, ALL_LIVE), Judgement::Refused(frames::ATTACH_NO_ROOM));
        assert_eq!(seating.first_missing(ALL_LIVE), Some((Role::Coordinator, 0)));
        assert!(!seating.places(Role::Controller)[0].occupant.is_some_and(|o| o.ready));
        assert_eq!(seating.judge(&ready, ALL_LIVE), seated);
        assert!(seating.places(Role::Controller)[0].occupant.is_some_and(|o| o.ready));
    }

    #[test]
    fn a_phase_there_is_not_is_refused() {
        let mut seating = Seating::new(1, 1, 1, Vec::new());
        assert!(matches!(
            seating.judge(&request(Role::Controller, frames::ATTACH_JOIN), ALL_LIVE),
            Judgement::Seated { .. }
        ));
        for phase in [0, 4, u32::MAX] {
            let judged = seating.judge(&request(Role::Controller, phase), ALL_LIVE);
            assert_eq!(judged, Judgement::Refused(frames::ATTACH_BAD_PHASE));
        }
        assert!(!seating.places(Role::Controller)[0].occupant.is_some_and(|o| o.ready));
    }

    #[test]
    fn one_of_ours_takes_the_place_of_a_plug_in_only_where_it_may_and_once_that_has_died() {
        let mut seating = Seating::new(1, 1, 3, vec![77, 78]);
        let named = AttachRequest { controller: 78, ..request(Role::Controller, frames::ATTACH_JOIN) };
        let at = |index, plugin| Judgement::Seated { role: Role::Controller, index, generation: 0, plugin };
        assert_eq!(seating.judge(&named, ALL_LIVE), at(2, Some(1)));
        let ours = |wanted_index| AttachRequest {
            instance: 6,
            process_id: 200,
            wanted_index,
            ..request(Role::Controller, frames::ATTACH_JOIN)
        };
        let no_room = Judgement::Refused(frames::ATTACH_NO_ROOM);
        assert_eq!(seating.judge(&ours(2), |id| id != 100), no_room, "nobody has said that it may");
        seating.let_stand_in(1);
        assert_eq!(seating.judge(&ours(2), ALL_LIVE), no_room, "it is taken");
        assert_eq!(seating.judge(&ours(1), ALL_LIVE), no_room, "another's");
        seating.begin();
        let taken = Judgement::Seated { role: Role::Controller, index: 2, generation: 1, plugin: None };
        assert_eq!(seating.judge(&ours(2), |id| id != 100), taken);
        assert!(seating.is_stood_in(2));
        // Whoever has no wish gets a place of the pool's.
        assert_eq!(
            seating.judge(&AttachRequest { instance: 7, ..ours(frames::ANY_INDEX) }, |id| id != 200),
            { Judgement::Seated { role: Role::Controller, index: 0, generation: 1, plugin: None } }
        );
    }

    #[test]
    fn a_place_is_taken_anew_only_once_its_process_has_died() {
        let mut seating = Seating::new(1, 1, 1, Vec::new());
        let join = request(Role::Coordinator, frames::ATTACH_JOIN);
        seating.judge(&join, ALL_LIVE);
        seating.begin();
        let next = AttachRequest { instance: 6, process_id: 200, ..join };
        assert_eq!(seating.judge(&next, ALL_LIVE), Judgement::Refused(frames::ATTACH_UNDER_WAY));
        let judged = seating.judge(&next, |id| id != 100);
        let seated = Judgement::Seated { role: Role::Coordinator, index: 0, generation: 1, plugin: None };
        assert_eq!(judged, seated);
    }
}
