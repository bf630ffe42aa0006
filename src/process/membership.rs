//! Who is in a run, and who comes and goes; what the world does while it waits for them.

use super::attach::{Readiness, Reception};
use super::outcome::Events;
use super::pace::Pacer;
use super::plugin_log::PluginLog;
use super::services::{Driver, MembersOutbox};
use super::viewing::Viewing;
use super::{OnMiss, Peer, Peers, ProcessError, Replacement, StopFlag, Waiter};
use crate::lockstep::Awaited;
use crate::record::RunEventKind;
use crate::scenario::OnExit;
use crate::trace::{self, Phase};
use ipc_schemas::Role;
use std::time::Duration;

/// Longest sleep between two looks at signals and newcomers while a step is not due.
const LONGEST_SLEEP: Duration = Duration::from_millis(5);
/// A participant that has sent a bad frame may take this long to send a good one.
const SECOND_CHANCE: Duration = Duration::from_secs(1);
/// Coordinators are woken by the controllers that wait for them; by the world too when that takes longer.
const WAKE_AFTER: Duration = Duration::from_micros(20);
/// Newcomers are seen to when a wait takes longer than this.
const ATTEND_AFTER: Duration = Duration::from_millis(1);

/// Who is in the run, and who comes and goes.
#[derive(Debug)]
pub(super) struct Membership {
    pub reception: Reception,
    pub members: MembersOutbox,
    pub replace: bool,
    pub pacer: Pacer,
    /// There is one when the run may be looked at.
    pub viewing: Option<Viewing>,
    /// The step's deadline has passed, and this is the verdict of what is put in for whoever is missing.
    pub overdue: Option<u16>,
    /// What has happened to the run so far.
    pub events: Events,
    /// Who has died last and was not replaced yet.
    pub gone: Option<Peer>,
    /// Who has been given a place and not what it needs to begin.
    pub coming: Vec<(Role, u32)>,
    /// Who has come since the last step ended.
    pub arrived: Vec<(Peer, u32)>,
    /// How controllers written elsewhere have fared.
    pub plugins: PluginLog,
    /// Told of one that has not answered for too long.
    pub silent: fn(u32),
    /// How long that is.
    pub silence: Duration,
    /// The step at which it was.
    pub told_of_silence: Option<u64>,
}

impl Membership {
    /// Waits until the present step is due.
    pub(super) fn begin_step(
        &mut self,
        driver: &mut Driver,
        waiter: &mut Waiter,
        stop: &StopFlag,
    ) -> Result<(), ProcessError> {
        let step = driver.world().step();
        while let Some(left) = self.pacer.until(step) {
            if stop.is_set() {
                return Err(ProcessError::Interrupted { step: Some(step) });
            }
            trace::enter(Phase::Idle);
            self.viewing.as_mut().map_or(Ok(()), |viewing| viewing.idle(driver, left))?;
            if left.is_zero() {
                std::hint::spin_loop();
            } else {
                std::thread::sleep(left.min(LONGEST_SLEEP));
                self.attend(driver, waiter)?;
                self.attend_views(driver)?;
            }
        }
        trace::enter(Phase::Compute);
        self.pacer.begin(step);
        Ok(())
    }

    /// Waits a little; sees to newcomers when it takes long.
    pub(super) fn wait(
        &mut self,
        driver: &mut Driver,
        waiter: &mut Waiter,
        awaited: Awaited,
    ) -> Result<(), ProcessError> {
        if self.pacer.has_missed(&awaited) {
            let names = driver.names();
            trace::note(|| format!("deadline missed: {}", awaited.named(&names)));
            self.events.missed(&awaited, &names);
            match self.pacer.on_miss() {
                OnMiss::Abort => {
                    let (step, awaited) = (awaited.step, awaited.named(&driver.names()));
                    return Err(ProcessError::DeadlineMissed { step, awaited });
                }
                policy => self.overdue = policy.verdict(),
            }
            // Waits that are this short end before anybody looks after the others.
            if let Some(peer) = self.reception.peers().first_gone().filter(|peer| self.is_survived(*peer)) {
                self.lose(driver, waiter, peer);
            }
        }
        // While a coordinator is missing too, there is nothing the vehicles could go by.
        if let Some(verdict) = self.overdue
            && driver.put_in(verdict)?
        {
            self.overdue = None;
            self.plugins.gave_up();
            return Ok(());
        }
        if driver.expects_requests() {
            self.attend(driver, waiter)?;
        }
        if waiter.waited() >= WAKE_AFTER {
            waiter.wake(driver.coordinators_acting());
        }
        if waiter.waited() >= ATTEND_AFTER {
            self.attend(driver, waiter)?;
            if waiter.waited() >= SECOND_CHANCE
                && let Some((who, fault)) = driver.suspect()
            {
                return Err(ProcessError::Faulty { who, fault: fault.clone() });
            }
        }
        if waiter.waited() >= self.silence {
            self.report_silence(awaited);
        }
        match (waiter.wait(awaited, self.pacer.time_left()), self.gone) {
            (Err(ProcessError::PeerGone { peer, .. }), _) if self.is_survived(peer) => {
                self.lose(driver, waiter, peer);
                Ok(())
            }
            (Err(ProcessError::Timeout { awaited, seconds }), Some(peer)) => {
                let consequence =
                    format!("nobody took its place within {seconds} s of waiting for {awaited}");
                Err(ProcessError::PeerGone { peer, name: peer.name(&driver.names()), consequence })
            }
            (result, _) => result,
        }
    }

    /// What is to become of the vehicles of a controller written elsewhere, as long as it drives them itself.
    fn on_exit(&self, peer: Peer) -> Option<OnExit> {
        let drives = peer.role == Role::Controller && !self.reception.is_stood_in(peer.index as usize);
        self.plugins.on_exit(peer.index).filter(|_| drives)
    }

    /// Whether the run goes on without this process, or waits for another in its place.
    fn is_survived(&self, peer: Peer) -> bool {
        self.on_exit(peer).map_or(self.replace, |choice| choice != OnExit::End)
    }

    /// Says, once a step, which controllers do not answer that the run can do without; that such a one is ended is
    /// noticed as any other end is.
    fn report_silence(&mut self, awaited: Awaited) {
        if awaited.role != Role::Controller || self.told_of_silence == Some(awaited.step) {
            return;
        }
        self.told_of_silence = Some(awaited.step);
        for index in (0..64).filter(|index| awaited.missing >> index & 1 == 1) {
            let peer = Peer { role: Role::Controller, index, process_id: 0 };
            if self.on_exit(peer).is_some_and(|choice| choice != OnExit::End) {
                (self.silent)(index);
            }
        }
    }

    /// A process is no longer there, which the run survives.
    fn lose(&mut self, driver: &mut Driver, waiter: &mut Waiter, peer: Peer) {
        if let Some(choice) = self.on_exit(peer) {
            let Peer { index, process_id, .. } = peer;
            let what = match choice {
                OnExit::ShieldFallback => "the shield drives its vehicles from this step on",
                OnExit::Builtin => "the built-in law is to drive its vehicles",
                OnExit::End | OnExit::Restart => "the run waits for it to be started again",
            };
            let text = format!("{} (process {process_id}) is gone: {what}", peer.name(&driver.names()));
            self.events.say(driver.world().step(), RunEventKind::Exited, text, 1 << index);
            self.plugins.exited(index);
            // Whoever comes has as long as anybody.
            waiter.reset();
            self.reception.vacate(index as usize);
            if choice == OnExit::ShieldFallback {
                driver.abandon(index);
            } else {
                self.gone = Some(peer);
            }
        } else {
            self.gone = Some(peer);
        }
        let others = self.reception.peers().0.into_iter().filter(|p| *p != peer);
        waiter.set_peers(Peers(others.collect()));
    }

    /// Shows steps to whoever looks, while others work on the one that has just been published.
    pub(super) fn overlap_views(&mut self, driver: &mut Driver) -> Result<(), ProcessError> {
        // Whoever asks for single steps wants to see each.
        let is_asked_for = self.pacer.is_paused();
        self.viewing.as_mut().map_or(Ok(()), |viewing| viewing.overlap(driver, is_asked_for))
    }

    /// Sees to whoever looks; between two steps.
    pub(super) fn attend_views(&mut self, driver: &mut Driver) -> Result<(), ProcessError> {
        let Membership { viewing, pacer, events, .. } = self;
        viewing.as_mut().map_or(Ok(()), |viewing| viewing.attend(driver, pacer, events))
    }

    /// Sees to whoever has come.
    pub(super) fn attend(&mut self, driver: &mut Driver, waiter: &mut Waiter) -> Result<(), ProcessError> {
        let Membership { reception, members, coming, arrived, gone, plugins, events, .. } = self;
        reception.go_on_from(driver.world().step());
        let before = arrived.len();
        let step = driver.world().step();
        let mut told = Ok(());
        let mut was_not_there = false;
        reception.serve(&mut |role, index, seat| {
            if driver.seat(role, index, seat) {
                // Before it is answered, and so before it can send anything.
                told = members.tell(step, driver.members());
                // Another may have had the place for a moment, and have died before it could begin.
                coming.retain(|place| *place != (role, index));
                coming.push((role, index));
            }
            let Some(handover) = driver.handover(role, index) else { return Readiness::Later };
            // Others ask for what they have missed.
            let comes = coming.iter().position(|place| *place == (role, index));
            if let (Some(at), Some(process_id)) = (comes, seat.process_id) {
                coming.swap_remove(at);
                let peer = Peer { role, index, process_id };
                let name = peer.name(&driver.names());
                trace::note(|| format!("{name} has been replaced, generation {}", seat.generation));
                arrived.push((peer, seat.generation));
                if role == Role::Controller && plugins.on_exit(index).is_some() {
                    for _ in 0..plugins.taken(index, seat.generation, seat.stands_in) {
                        let text = format!("{name} is gone: another has taken its place");
                        events.say(step, RunEventKind::Exited, text, 1 << index);
                    }
                    was_not_there |= !seat.stands_in;
                }
            }
            Readiness::Now(Box::new(handover))
        })?;
        told?;
        if arrived.len() > before {
            *gone = None;
            waiter.set_peers(reception.peers());
        }
        if was_not_there {
            // It keeps its memory to itself, and has no state to begin with.
            driver.send_state_again()?;
        }
        Ok(())
    }

    /// The replacements of a step that took so long.
    pub(super) fn step_done(
        &mut self,
        driver: &Driver,
        ns: u64,
    ) -> impl Iterator<Item = Replacement> + use<'_> {
        let step = self.reception.first_step;
        let step_ms = ns as f64 / 1e6;
        self.events.refused(step, driver.refused_senders(), || driver.refused());
        let names = driver.names();
        for (peer, generation) in self.arrived.iter().filter(|(_, generation)| *generation > 0) {
            let by = match peer.role == Role::Controller && self.reception.is_stood_in(peer.index as usize) {
                true => " by the built-in law",
                false => "",
            };
            let text = format!("{} was replaced{by}: generation {generation}", peer.name(&names));
            let controllers = if peer.role == Role::Controller { 1 << peer.index } else { 0 };
            self.events.say(step, RunEventKind::Replaced, text, controllers);
        }
        self.arrived.drain(..).filter(|(_, generation)| *generation > 0).map(move |(peer, generation)| {
            Replacement { participant: peer.name(&names), generation, step, step_ms }
        })
    }
}
