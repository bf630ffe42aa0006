//! The life of a supervised run, as a state machine without clock, processes or pipes.
//!
//! A run goes on until its results are in or something has gone wrong. Results that are in are never lost again:
//! whatever its processes do afterwards is a note. Time is what the supervisor has lived through (see
//! [`OwnTime`](crate::own_time::OwnTime)).

mod member;
#[cfg(test)]
mod tests;

use crate::scenario::OnExit;
pub(super) use member::{End, Kind};
use member::{Member, Process};
use std::time::Duration;

/// Time since the run was started, as far as the supervisor ran.
pub(super) type Now = Duration;

/// How long the others may take to end by themselves once one has failed, and once asked to.
pub(super) const GRACE: Duration = Duration::from_secs(2);
/// A plug-in is ended by its keeper, which takes as long over it, and then by us.
const KEEPER_GRACE: Duration = GRACE.saturating_mul(2);
/// A part that dies this often, each time soon after it was started, is given up.
const MAX_RESTARTS: u32 = 8;
/// A plug-in that is started again when its program changes waits for that, rather, if it dies this often.
const MAX_RELOADS: u32 = 1;
/// A part that has lived this long has proved itself.
const PROBATION: Duration = Duration::from_secs(5);
/// The second restart in a row waits this long, each further one twice as long as the one before.
const BACK_OFF: Duration = Duration::from_millis(10);
/// Parts that gave up one after the other while the world made no step: then it is the world that hangs.
const MAX_FRUITLESS: u32 = 3;
/// A world that steps says so many times in this time.
const SILENCE: Duration = Duration::from_secs(1);

/// What the shell is to do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Act {
    Start(usize),
    /// Start one of ours in its place from now on.
    StandIn(usize),
    /// Have it end: SIGTERM.
    Ask(usize),
    /// End it: SIGKILL.
    Insist(usize),
    Say(String),
}

/// How far a run is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stage {
    /// It goes on, or ends badly.
    Going,
    /// Its results are complete; processes may linger.
    Results,
    /// All processes have ended.
    Done,
}

/// Why a run has no results.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Failure {
    Failed(String),
    Interrupted(String),
}

#[derive(Debug)]
enum Phase {
    Running,
    Over { since: Now },
    Failed { since: Now, failure: Failure },
}

/// The life of a run.
#[derive(Debug)]
pub(super) struct Life {
    members: Vec<Member>,
    phase: Phase,
    /// Whether parts that die are started again.
    replaces: bool,
    /// How long a plug-in may take to end once the run is over.
    linger: Duration,
    /// When the world has said last that it makes steps.
    stepped: Option<Now>,
    /// Parts that have given up since.
    fruitless: u32,
    interrupts: u32,
}

impl Life {
    /// A run that nobody is in yet.
    pub fn new(replaces: bool, linger: Duration) -> Life {
        Life {
            members: Vec::new(),
            phase: Phase::Running,
            replaces,
            linger,
            stepped: None,
            fruitless: 0,
            interrupts: 0,
        }
    }

    /// Adds a process that is to be started at once; returns its number.
    pub fn add(&mut self, name: String, kind: Kind) -> usize {
        self.members.push(Member::new(name, kind));
        self.members.len() - 1
    }

    /// What becomes of the vehicles of a plug-in that ends in the middle of the run.
    pub fn on_exit(&mut self, member: usize, choice: OnExit) {
        self.members[member].on_exit = choice;
    }

    /// A plug-in is started again when its program changes; one that dies soon after it was started waits for that.
    pub fn reloads(&mut self, member: usize) {
        let member = &mut self.members[member];
        (member.reloads, member.restarts) = (true, MAX_RELOADS);
    }

    /// It runs as this process.
    pub fn started(&mut self, member: usize, id: u32, now: Now) {
        let member = &mut self.members[member];
        member.starts += 1;
        member.process = Process::Runs { id, since: now, asked: None, insisted: false };
        member.settled = false;
        member.last_words = None;
    }

    /// It could not be started.
    pub fn did_not_start(&mut self, member: usize, why: &str, now: Now) {
        let member = &mut self.members[member];
        member.process = Process::Ended;
        let text = format!(
            "cannot start {}: {why}; memory or processes may be limited, see `ulimit -a`",
            member.name
        );
        self.fail(Failure::Failed(text), now);
    }

    /// Its process is another one than was started: the plug-in behind its keeper.
    pub fn is_process(&mut self, member: usize, plugin: u32) {
        if let Process::Runs { id, .. } = &mut self.members[member].process {
            *id = plugin;
        }
    }

    /// It has been let into the run.
    pub fn settled(&mut self, member: usize) {
        self.members[member].settled = true;
    }

    /// It has said something on stderr.
    pub fn said(&mut self, member: usize, line: String) {
        self.members[member].last_words = Some(line);
    }

    /// The world has made steps.
    pub fn stepped(&mut self, now: Now) {
        self.stepped = Some(now);
        self.fruitless = 0;
    }

    /// What to call it.
    pub fn name(&self, member: usize) -> &str {
        &self.members[member].name
    }

    /// A plug-in that the run can do without has not answered for too long.
    pub fn silent(&mut self, member: usize, now: Now, acts: &mut Vec<Act>) {
        let it = &mut self.members[member];
        if let (Phase::Running, Kind::Plugin, Process::Runs { id, asked: asked @ None, .. }) =
            (&self.phase, it.kind, &mut it.process)
        {
            *asked = Some(now);
            acts.push(Act::Say(format!("cz: {} (process {id}) does not answer and is ended", it.name)));
            acts.push(Act::Ask(member));
        }
    }

    /// A file of a plug-in's program has changed.
    pub fn changed(&mut self, member: usize, file: &str, now: Now, acts: &mut Vec<Act>) {
        let it = &mut self.members[member];
        if !matches!(self.phase, Phase::Running) || !it.reloads {
            return;
        }
        match &mut it.process {
            Process::Runs { id, asked: asked @ None, .. } => {
                *asked = Some(now);
                it.is_renewed = true;
                let text = format!("cz: {file} has changed: {} (process {id}) is started again", it.name);
                acts.extend([Act::Say(text), Act::Ask(member)]);
            }
            Process::Awaits => {
                acts.push(Act::Say(format!("cz: {file} has changed: {} is started again", it.name)));
                it.process = Process::Due { at: now };
            }
            // Otherwise it is about to be started anyway, or to end.
            _ => {}
        }
    }

    /// A plug-in had this generation when all was over; one that was started more often than that was on its way.
    pub fn came_to(&mut self, name: &str, generation: u32) {
        let plugins = self.members.iter_mut().filter(|m| m.kind == Kind::Plugin && m.name == name);
        plugins.for_each(|member| member.is_late = member.starts > generation + 1);
    }

    /// The world has said what the run has come to: nothing can spoil it any more.
    pub fn results_are_in(&mut self, now: Now, acts: &mut Vec<Act>) {
        let before = std::mem::replace(&mut self.phase, Phase::Over { since: now });
        match before {
            Phase::Over { since } => self.phase = Phase::Over { since },
            Phase::Failed { failure: Failure::Failed(text), .. } => {
                acts.extend(
                    text.split("\n  ").map(|line| Act::Say(format!("cz: {line}; the run was complete"))),
                );
            }
            Phase::Failed { .. } | Phase::Running => {}
        }
        for member in &mut self.members {
            if matches!(member.process, Process::Due { .. } | Process::Left { .. } | Process::Awaits) {
                member.process = Process::Ended;
            }
        }
    }

    /// A signal has come; a second one makes short work.
    pub fn interrupted(&mut self, signal: &str, now: Now) {
        self.interrupts += 1;
        if let Phase::Over { .. } = self.phase {
            return;
        }
        let text = format!("interrupted by {signal}; the run was ended");
        self.phase = Phase::Failed { since: now, failure: Failure::Interrupted(text) };
    }

    /// A process has ended. `world_is_stopped` is asked when somebody has waited for the world in vain.
    pub fn ended(
        &mut self,
        member: usize,
        end: &End,
        now: Now,
        world_is_stopped: impl Fn(u32) -> bool,
        acts: &mut Vec<Act>,
    ) {
        let it = &mut self.members[member];
        let (id, since, asked, insisted) = match it.process {
            Process::Runs { id, since, asked, insisted } => (id, since, asked, insisted),
            _ => (0, now, None, false),
        };
        it.process = Process::Ended;
        let told = it.describe(id, end);
        match &self.phase {
            Phase::Over { since: over } => {
                let lingered = (now - *over).as_secs_f64();
                match asked {
                    // Whoever came to replace somebody when all was over had not been let in.
                    Some(_) if it.is_unknown() => {}
                    Some(_) => {
                        let how = if insisted { "killed" } else { "ended" };
                        acts.push(Act::Say(format!(
                            "cz: {} (process {id}) was still there when the run was over; it was {how} after {lingered:.1} s",
                            it.name
                        )));
                    }
                    None if *end != End::Code(0) => {
                        acts.push(Act::Say(format!("cz: {told}; the run was complete")));
                    }
                    None => {}
                }
            }
            Phase::Failed { .. } => {
                // Who was asked to end and does has nothing to say of it.
                let is_news = *end != End::Code(0) && asked.is_none();
                if insisted {
                    acts.push(Act::Say(format!(
                        "cz: {} (process {id}) did not end when asked and was killed",
                        it.name
                    )));
                } else if is_news {
                    self.add_words(&told);
                }
            }
            Phase::Running if it.is_renewed => {
                (it.is_renewed, it.restarts) = (false, MAX_RELOADS);
                it.process = Process::Due { at: now };
            }
            Phase::Running if *end == End::Code(0) && it.kind != Kind::World => {
                it.process = Process::Left { id, at: now };
            }
            // If the run has begun, the world will say so.
            Phase::Running if it.on_exit == OnExit::ShieldFallback && self.stepped.is_none() => {
                it.process = Process::Lost { at: now, end: end.clone(), told };
            }
            Phase::Running => {
                if it.kind == Kind::World && *end == End::Code(0) {
                    let text = format!("the world (process {id}) ended without results");
                    return self.fail(Failure::Failed(text), now);
                }
                let hangs = self.hangs(member, end, now, world_is_stopped);
                self.lose(member, end, &told, hangs, since, now, acts);
            }
        }
    }

    /// Whether a part that has given up has done so because the world hangs; then in which words.
    fn hangs(
        &mut self,
        member: usize,
        end: &End,
        now: Now,
        world_is_stopped: impl Fn(u32) -> bool,
    ) -> Option<String> {
        let gave_up = matches!(end, End::Code(_)) && self.members[member].kind == Kind::Part;
        let silent_for = now.saturating_sub(self.stepped.unwrap_or_default());
        let world = self.members.iter().find(|m| m.kind == Kind::World)?;
        let Process::Runs { id, .. } = world.process else { return None };
        if !gave_up || silent_for < SILENCE {
            return None;
        }
        self.fruitless += 1;
        let is_stopped = world_is_stopped(id);
        let and_is = if is_stopped { "is stopped and " } else { "" };
        let words = format!(
            "the world (process {id}) {and_is}has made no step for {:.0} s",
            silent_for.as_secs_f64()
        );
        (is_stopped || self.fruitless > MAX_FRUITLESS).then_some(words)
    }

    /// A process is lost in the middle of the run: somebody takes its place, or the run fails.
    #[expect(clippy::too_many_arguments, reason = "what is known of a death")]
    fn lose(
        &mut self,
        member: usize,
        end: &End,
        told: &str,
        hangs: Option<String>,
        since: Now,
        now: Now,
        acts: &mut Vec<Act>,
    ) {
        let steps = self.stepped.is_some();
        let it = &mut self.members[member];
        let deliberate = *end == End::Code(130) && it.kind == Kind::Part;
        let starts_again = match it.kind {
            Kind::World => false,
            Kind::Part => self.replaces,
            Kind::Plugin => it.on_exit == OnExit::Restart,
        };
        let most = if it.reloads { MAX_RELOADS } else { MAX_RESTARTS };
        let in_a_row = if now.saturating_sub(since) >= PROBATION { 0 } else { it.restarts };
        if let Some(hangs) = hangs {
            self.fail(Failure::Failed(format!("{hangs}\n  {told}")), now);
        } else if it.kind == Kind::Plugin && it.on_exit == OnExit::Builtin {
            // From here on it is one of ours.
            acts.push(Act::Say(format!("cz: {told}; the built-in law drives its vehicles from now on")));
            it.kind = Kind::Part;
            it.name.push_str(" (built-in)");
            it.process = Process::Starting;
            acts.push(Act::StandIn(member));
        } else if it.kind == Kind::Plugin && it.on_exit == OnExit::ShieldFallback && steps {
            acts.push(Act::Say(format!("cz: {told}; the shield drives its vehicles from now on")));
        } else if it.reloads && in_a_row >= most {
            it.process = Process::Awaits;
            let text = format!("cz: {told}; it is started again when its program changes");
            acts.push(Act::Say(text));
        } else if starts_again && !deliberate && in_a_row < most {
            let pause = if in_a_row == 0 { Duration::ZERO } else { BACK_OFF * (1 << (in_a_row - 1)) };
            it.restarts = in_a_row + 1;
            it.process = Process::Due { at: now + pause };
            acts.push(Act::Say(format!("cz: {told}; it is started again")));
        } else {
            self.fail(Failure::Failed(told.to_owned()), now);
        }
    }

    fn fail(&mut self, failure: Failure, now: Now) {
        match (&self.phase, failure) {
            (Phase::Running, failure) => self.phase = Phase::Failed { since: now, failure },
            (_, Failure::Failed(text)) => self.add_words(&text),
            _ => {}
        }
    }

    fn add_words(&mut self, words: &str) {
        if let Phase::Failed { failure: Failure::Failed(text), .. } = &mut self.phase {
            text.push_str("\n  ");
            text.push_str(words);
        }
    }

    /// Does what is due.
    pub fn tick(&mut self, now: Now, acts: &mut Vec<Act>) {
        self.judge_those_who_left(now, acts);
        self.judge_those_who_were_lost(now, acts);
        for i in 0..self.members.len() {
            let leave_by = self.leave_by(i);
            let member = &mut self.members[i];
            let grace = if member.kind == Kind::Plugin { KEEPER_GRACE } else { GRACE };
            match &mut member.process {
                Process::Due { at } if *at <= now && matches!(self.phase, Phase::Running) => {
                    member.process = Process::Starting;
                    acts.push(Act::Start(i));
                }
                Process::Runs { asked: asked @ None, .. } if leave_by.is_some_and(|by| by <= now) => {
                    *asked = Some(now);
                    acts.push(Act::Ask(i));
                }
                Process::Runs { asked: Some(at), insisted: insisted @ false, .. }
                    if *at + grace <= now || self.interrupts > 1 =>
                {
                    *insisted = true;
                    acts.push(Act::Insist(i));
                }
                _ => {}
            }
        }
    }

    /// Whoever was lost when nobody knew yet whether the run had begun.
    fn judge_those_who_were_lost(&mut self, now: Now, acts: &mut Vec<Act>) {
        for i in 0..self.members.len() {
            let Process::Lost { at, end, told } = &self.members[i].process else { continue };
            if matches!(self.phase, Phase::Running) && self.stepped.is_none() && *at + GRACE > now {
                continue;
            }
            let (at, end, told) = (*at, end.clone(), told.clone());
            self.members[i].process = Process::Ended;
            match self.phase {
                Phase::Running => self.lose(i, &end, &told, None, at, now, acts),
                Phase::Failed { .. } => self.add_words(&told),
                Phase::Over { .. } => acts.push(Act::Say(format!("cz: {told}; the run was complete"))),
            }
        }
    }

    /// Whoever left with code 0 a while ago, without the world having ended the run, has left in its middle.
    fn judge_those_who_left(&mut self, now: Now, acts: &mut Vec<Act>) {
        let world_runs =
            self.members.iter().any(|m| m.kind == Kind::World && matches!(m.process, Process::Runs { .. }));
        for i in 0..self.members.len() {
            let Process::Left { id, at } = self.members[i].process else { continue };
            match self.phase {
                // The results may be on their way, as long as there is somebody to send them.
                Phase::Running | Phase::Failed { .. } if at + GRACE > now && world_runs => continue,
                Phase::Over { .. } => {}
                Phase::Running | Phase::Failed { .. } => {
                    let told = format!(
                        "{} (process {id}) left with code 0 in the middle of the run",
                        self.members[i].name
                    );
                    self.members[i].process = Process::Ended;
                    if matches!(self.phase, Phase::Running) {
                        self.lose(i, &End::Code(0), &told, None, at, now, acts);
                    } else {
                        self.add_words(&told);
                    }
                    continue;
                }
            }
            self.members[i].process = Process::Ended;
        }
    }

    /// When a process is to have ended by itself.
    fn leave_by(&self, member: usize) -> Option<Now> {
        let member = &self.members[member];
        match &self.phase {
            Phase::Running => None,
            Phase::Over { since } if self.interrupts > 0 => Some(*since),
            Phase::Over { since } => Some(match member.kind {
                _ if member.is_unknown() => *since,
                Kind::Plugin => *since + self.linger,
                Kind::World | Kind::Part => *since + GRACE,
            }),
            Phase::Failed { since, failure: Failure::Interrupted(_) } => Some(*since),
            // The others notice within moments; what they say on the way out is worth having.
            Phase::Failed { since, .. } => Some(*since + GRACE),
        }
    }

    /// When [`tick`](Life::tick) has something to do next.
    pub fn next_due(&self) -> Option<Now> {
        let due = |(i, member): (usize, &Member)| match &member.process {
            Process::Due { at } => matches!(self.phase, Phase::Running).then_some(*at),
            Process::Runs { asked: None, .. } => self.leave_by(i),
            Process::Runs { asked: Some(at), insisted: false, .. } => {
                Some(if member.kind == Kind::Plugin { *at + KEEPER_GRACE } else { *at + GRACE })
            }
            Process::Left { at, .. } | Process::Lost { at, .. } => Some(*at + GRACE),
            _ => None,
        };
        self.members.iter().enumerate().filter_map(due).min()
    }

    /// How far the run is.
    pub fn stage(&self) -> Stage {
        let runs = |member: &&Member| matches!(member.process, Process::Runs { .. } | Process::Starting);
        let waits = |m: &Member| {
            m.kind != Kind::Plugin
                && matches!(m.process, Process::Runs { asked: None, .. } | Process::Starting)
        };
        match self.phase {
            Phase::Running => Stage::Going,
            _ if self.members.iter().find(runs).is_none() => Stage::Done,
            // Parts have something to tell when they end, which they do at once.
            Phase::Over { .. } if !self.members.iter().any(waits) => Stage::Results,
            _ => Stage::Going,
        }
    }

    /// Why there are no results, if there are none.
    pub fn failure(&self) -> Option<&Failure> {
        match &self.phase {
            Phase::Failed { failure, .. } => Some(failure),
            Phase::Running | Phase::Over { .. } => None,
        }
    }
}
