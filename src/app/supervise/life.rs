//! The life of a supervised run, as a state machine without clock, processes or pipes.
//!
//! A run goes on until its results are in or something has gone wrong. Results that are in are never lost again:
//! whatever its processes do afterwards is a note. Time is what the supervisor has lived through (see
//! [`OwnTime`](crate::own_time::OwnTime)).

use std::time::Duration;

/// Time since the run was started, as far as the supervisor ran.
pub(super) type Now = Duration;

/// How long the others may take to end by themselves once one has failed, and once asked to.
pub(super) const GRACE: Duration = Duration::from_secs(2);
/// A plug-in is ended by its keeper, which takes as long over it, and then by us.
const KEEPER_GRACE: Duration = GRACE.saturating_mul(2);
/// A part that dies this often, each time soon after it was started, is given up.
const MAX_RESTARTS: u32 = 8;
/// A part that has lived this long has proved itself.
const PROBATION: Duration = Duration::from_secs(5);
/// The second restart in a row waits this long, each further one twice as long as the one before.
const BACK_OFF: Duration = Duration::from_millis(10);
/// Parts that gave up one after the other while the world made no step: then it is the world that hangs.
const MAX_FRUITLESS: u32 = 3;
/// A world that steps says so many times in this time.
const SILENCE: Duration = Duration::from_secs(1);

/// What a process is in the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    World,
    /// A coordinator or controller of ours.
    Part,
    /// A controller written elsewhere, under its keeper.
    Plugin,
}

/// How a process ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum End {
    Code(i32),
    /// Signal number and name.
    Signal(i32, &'static str),
    /// It could not be waited for.
    Unknown(String),
}

/// What the shell is to do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Act {
    Start(usize),
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

#[derive(Clone, Debug)]
enum Process {
    /// It is to be started.
    Due {
        at: Now,
    },
    /// The shell has been told to start it.
    Starting,
    Runs {
        id: u32,
        since: Now,
        asked: Option<Now>,
        insisted: bool,
    },
    /// It has left with code 0, which it may when the run is over; the world will say whether it is.
    Left {
        id: u32,
        at: Now,
    },
    Ended,
}

#[derive(Debug)]
struct Member {
    name: String,
    kind: Kind,
    process: Process,
    /// Restarts in a row.
    restarts: u32,
    /// Whether it has been let into the run.
    settled: bool,
    /// The last thing it said on stderr.
    last_words: Option<String>,
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
        let process = Process::Due { at: Now::ZERO };
        self.members.push(Member { name, kind, process, restarts: 0, settled: false, last_words: None });
        self.members.len() - 1
    }

    /// It runs as this process.
    pub fn started(&mut self, member: usize, id: u32, now: Now) {
        let member = &mut self.members[member];
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
            if matches!(member.process, Process::Due { .. } | Process::Left { .. }) {
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
        let told = describe(it, id, end);
        match &self.phase {
            Phase::Over { since: over } => {
                let lingered = (now - *over).as_secs_f64();
                match (asked, it.kind) {
                    // Whoever came to replace somebody when all was over had not been let in.
                    (Some(_), Kind::Part) if !it.settled => {}
                    (Some(_), _) => {
                        let how = if insisted { "killed" } else { "ended" };
                        acts.push(Act::Say(format!(
                            "cz: {} (process {id}) was still there when the run was over; it was {how} after {lingered:.1} s",
                            it.name
                        )));
                    }
                    (None, _) if *end != End::Code(0) => {
                        acts.push(Act::Say(format!("cz: {told}; the run was complete")));
                    }
                    (None, _) => {}
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
            Phase::Running if *end == End::Code(0) && it.kind != Kind::World => {
                it.process = Process::Left { id, at: now };
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
        let it = &mut self.members[member];
        let deliberate = *end == End::Code(130);
        let in_a_row = if now.saturating_sub(since) >= PROBATION { 0 } else { it.restarts };
        if let Some(hangs) = hangs {
            self.fail(Failure::Failed(format!("{hangs}\n  {told}")), now);
        } else if self.replaces && it.kind == Kind::Part && !deliberate && in_a_row < MAX_RESTARTS {
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
                Kind::Plugin => *since + self.linger,
                Kind::Part if !member.settled => *since,
                Kind::World | Kind::Part => *since + GRACE,
            }),
            Phase::Failed { since, failure: Failure::Interrupted(_) } => Some(*since),
            // The others notice within moments; what they say on the way out is worth having.
            Phase::Failed { since, .. } => Some(*since + GRACE),
        }
    }

    /// When [`tick`](Life::tick) has something to do next.
    pub fn next_due(&self) -> Option<Now> {
        let due = |(i, member): (usize, &Member)| match member.process {
            Process::Due { at } => matches!(self.phase, Phase::Running).then_some(at),
            Process::Runs { asked: None, .. } => self.leave_by(i),
            Process::Runs { asked: Some(at), insisted: false, .. } => {
                Some(if member.kind == Kind::Plugin { at + KEEPER_GRACE } else { at + GRACE })
            }
            Process::Left { at, .. } => Some(at + GRACE),
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

fn describe(member: &Member, id: u32, end: &End) -> String {
    let how = match end {
        End::Code(0) => "left with code 0".to_owned(),
        End::Code(code) => format!("ended with code {code}"),
        End::Signal(signal, name) => {
            let why = match *name {
                "SIGBUS" => "; /dev/shm is full, or another process has cut files in it short",
                _ => "",
            };
            format!("was killed by signal {signal} ({name}){why}")
        }
        End::Unknown(why) => format!("could not be waited for: {why}"),
    };
    let name = &member.name;
    match &member.last_words {
        Some(words) => format!("{name} (process {id}) {how}: {}", words.trim_start_matches("cz: ")),
        None => format!("{name} (process {id}) {how}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KILLED: End = End::Signal(9, "SIGKILL");

    fn s(seconds: f64) -> Now {
        Duration::from_secs_f64(seconds)
    }

    /// A run of a world, a coordinator, a controller and a plug-in, numbered so, with these numbers for processes.
    struct Scene {
        life: Life,
        acts: Vec<Act>,
    }

    impl Scene {
        fn new() -> Scene {
            let mut life = Life::new(true, s(10.0));
            for (name, kind) in [
                ("world", Kind::World),
                ("coordinator 0", Kind::Part),
                ("controller 0", Kind::Part),
                ("controller mine", Kind::Plugin),
            ] {
                life.add(name.to_owned(), kind);
            }
            let mut scene = Scene { life, acts: Vec::new() };
            assert_eq!(scene.at(0.0), (0..4).map(Act::Start).collect::<Vec<_>>());
            for member in 0..4 {
                scene.life.started(member, 100 + member as u32, s(0.0));
                scene.life.settled(member);
            }
            scene
        }

        /// What is to be done at that time.
        fn at(&mut self, seconds: f64) -> Vec<Act> {
            self.life.tick(s(seconds), &mut self.acts);
            std::mem::take(&mut self.acts)
        }

        fn ends(&mut self, member: usize, end: End, seconds: f64) {
            self.life.ended(member, &end, s(seconds), |_| false, &mut self.acts);
        }

        fn finishes(&mut self, seconds: f64) {
            self.life.results_are_in(s(seconds), &mut self.acts);
        }

        fn said(&mut self, seconds: f64) -> String {
            let said = self.at(seconds).into_iter().filter_map(|act| match act {
                Act::Say(line) => Some(line),
                _ => None,
            });
            said.collect::<Vec<_>>().join("\n")
        }

        fn failure(&self) -> &str {
            match self.life.failure() {
                Some(Failure::Failed(text) | Failure::Interrupted(text)) => text,
                None => "",
            }
        }
    }

    #[test]
    fn a_run_whose_processes_leave_in_any_order_is_done() {
        for order in [[0, 1, 2, 3], [3, 2, 1, 0], [1, 3, 0, 2]] {
            let mut run = Scene::new();
            for (i, member) in order.into_iter().enumerate() {
                if member == 0 {
                    run.finishes(5.0);
                }
                run.ends(member, End::Code(0), 5.0 + i as f64 / 10.0);
            }
            assert_eq!((run.at(6.0), run.life.stage()), (vec![], Stage::Done), "{order:?}");
            assert_eq!(run.life.failure(), None);
        }
    }

    #[test]
    fn a_part_that_dies_in_the_last_moments_spoils_nothing() {
        let mut run = Scene::new();
        run.ends(2, KILLED, 5.0);
        let acts = run.at(5.0);
        assert!(
            matches!(&acts[..], [Act::Say(line), Act::Start(2)] if line.contains("started again")),
            "{acts:?}"
        );
        run.life.started(2, 200, s(5.01));
        // Before its successor has been let in, the run is over.
        run.finishes(5.02);
        run.ends(0, End::Code(0), 5.03);
        run.ends(1, End::Code(0), 5.03);
        run.ends(3, End::Code(0), 5.03);
        assert_eq!(run.at(5.03), [Act::Ask(2)]);
        assert_eq!(run.life.stage(), Stage::Results);
        run.ends(2, End::Code(130), 5.04);
        assert_eq!((run.at(5.04), run.life.stage()), (vec![], Stage::Done));
    }

    #[test]
    fn a_part_whose_death_was_a_failure_is_a_note_once_results_are_in() {
        let mut run = Scene::new();
        run.life.replaces = false;
        run.ends(2, KILLED, 5.0);
        assert_eq!(run.failure(), "controller 0 (process 102) was killed by signal 9 (SIGKILL)");
        run.ends(1, End::Code(0), 5.1);
        run.at(5.1);
        run.finishes(5.1);
        assert_eq!(run.life.failure(), None);
        let said = run.said(5.1);
        assert!(said.lines().count() == 1 && said.ends_with("(SIGKILL); the run was complete"), "{said}");
    }

    #[test]
    fn results_do_not_wait_for_a_plug_in_which_is_ended_in_the_end() {
        let mut run = Scene::new();
        run.finishes(5.0);
        for member in 0..3 {
            run.ends(member, End::Code(0), 5.1);
        }
        assert_eq!((run.at(5.1), run.life.stage()), (vec![], Stage::Results));
        assert_eq!(run.life.next_due(), Some(s(15.0)));
        assert_eq!(run.at(15.0), [Act::Ask(3)]);
        assert_eq!(run.at(19.0), [Act::Insist(3)]);
        run.ends(3, KILLED, 19.1);
        let said = run.said(19.1);
        assert_eq!(
            said,
            "cz: controller mine (process 103) was still there when the run was over; it was killed after 14.1 s"
        );
        assert_eq!(run.life.stage(), Stage::Done);
    }

    #[test]
    fn a_plug_in_that_fails_afterwards_is_a_note() {
        let mut run = Scene::new();
        run.finishes(5.0);
        run.ends(3, End::Code(7), 5.1);
        assert_eq!(
            run.said(5.1),
            "cz: controller mine (process 103) ended with code 7; the run was complete"
        );
        assert_eq!(run.life.failure(), None);
    }

    #[test]
    fn a_plug_in_that_leaves_with_code_0_in_the_middle_is_called_that() {
        let mut run = Scene::new();
        run.ends(3, End::Code(0), 5.0);
        assert_eq!((run.at(5.1), run.life.stage(), run.failure()), (vec![], Stage::Going, ""));
        assert_eq!(run.life.next_due(), Some(s(7.0)));
        run.at(7.0);
        assert_eq!(run.failure(), "controller mine (process 103) left with code 0 in the middle of the run");
        // Or the world says what it lacks first.
        let mut run = Scene::new();
        run.ends(3, End::Code(0), 5.0);
        run.life.said(0, "controller 1 is gone".to_owned());
        run.ends(0, End::Code(1), 5.1);
        run.at(5.2);
        let told = run.failure();
        assert!(
            told.contains("controller 1 is gone\n  controller mine (process 103) left with code 0"),
            "{told}"
        );
    }

    #[test]
    fn parts_of_a_failed_run_are_asked_and_then_killed() {
        let mut run = Scene::new();
        run.ends(0, KILLED, 1.0);
        assert_eq!(run.at(1.0), []);
        run.ends(1, End::Code(1), 1.1);
        assert_eq!(run.at(3.0), [Act::Ask(2), Act::Ask(3)]);
        run.ends(3, End::Code(0), 3.1);
        assert_eq!(run.at(5.0), [Act::Insist(2)]);
        run.ends(2, KILLED, 5.1);
        assert!(run.said(5.1).contains("did not end when asked and was killed"));
        assert_eq!(run.life.stage(), Stage::Done);
        assert_eq!(
            run.failure(),
            "world (process 100) was killed by signal 9 (SIGKILL)\n  coordinator 0 (process 101) ended with code 1"
        );
    }

    #[test]
    fn a_signal_ends_the_run_at_once_and_a_second_one_for_good() {
        let mut run = Scene::new();
        run.life.interrupted("SIGINT", s(1.0));
        assert_eq!(run.at(1.0), (0..4).map(Act::Ask).collect::<Vec<_>>());
        run.ends(0, End::Code(130), 1.1);
        run.life.interrupted("SIGINT", s(1.2));
        assert_eq!(run.at(1.2), (1..4).map(Act::Insist).collect::<Vec<_>>());
        assert_eq!(run.failure(), "interrupted by SIGINT; the run was ended");
    }

    #[test]
    fn a_part_that_keeps_dying_is_given_up() {
        let mut run = Scene::new();
        let mut now = 0.0;
        for restart in 0..MAX_RESTARTS {
            run.ends(1, KILLED, now);
            now += 1.0;
            assert!(run.at(now).contains(&Act::Start(1)), "{restart}");
            run.life.started(1, 200, s(now));
        }
        run.ends(1, KILLED, now);
        assert_eq!(run.failure(), "coordinator 0 (process 200) was killed by signal 9 (SIGKILL)");
    }

    #[test]
    fn nobody_is_started_again_for_a_world_that_is_stopped() {
        let mut run = Scene::new();
        run.life.stepped(s(1.0));
        run.life.said(2, "waited 10 s for state of step 5 from the world".to_owned());
        run.life.ended(2, &End::Code(1), s(11.0), |id| id == 100, &mut run.acts);
        assert_eq!(
            run.failure(),
            "the world (process 100) is stopped and has made no step for 10 s\n  controller 0 (process 102) \
             ended with code 1: waited 10 s for state of step 5 from the world"
        );
        // One that hangs is believed for a while: it may have much to do.
        let mut run = Scene::new();
        for i in 1..=MAX_FRUITLESS {
            let now = 30.0 * f64::from(i);
            run.ends(2, End::Code(1), now);
            assert!(run.at(now).contains(&Act::Start(2)));
            run.life.started(2, 200, s(now));
        }
        run.ends(2, End::Code(1), 120.0);
        assert!(run.failure().starts_with("the world (process 100) has made no step for 120 s"));
    }
}
