//! Lives of a run of four, told in a few lines each.

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
    assert_eq!(run.said(5.1), "cz: controller mine (process 103) ended with code 7; the run was complete");
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

#[test]
fn a_plug_in_that_dies_is_started_again_stood_in_for_or_left_as_chosen() {
    let dies = |choice: OnExit, stepped: bool| {
        let mut run = Scene::new();
        run.life.on_exit(3, choice);
        if stepped {
            run.life.stepped(s(1.0));
        }
        run.ends(3, KILLED, 20.0);
        run
    };
    let said = |text: &str| {
        Act::Say(format!("cz: controller mine (process 103) was killed by signal 9 (SIGKILL); {text}"))
    };
    assert!(
        dies(OnExit::End, true).failure().contains("controller mine (process 103) was killed by signal 9")
    );

    let mut restarted = dies(OnExit::Restart, true);
    assert_eq!(restarted.at(20.0), [said("it is started again"), Act::Start(3)]);

    let mut stood_in = dies(OnExit::Builtin, true);
    let from_now_on = "the built-in law drives its vehicles from now on";
    assert_eq!(stood_in.at(20.0), [said(from_now_on), Act::StandIn(3)]);
    // From then on it is one of ours.
    stood_in.life.started(3, 203, s(20.0));
    stood_in.ends(3, KILLED, 30.0);
    assert_eq!(stood_in.at(30.0)[1], Act::Start(3));

    let mut left = dies(OnExit::ShieldFallback, true);
    let from_now_on = "the shield drives its vehicles from now on";
    assert_eq!((left.at(20.0), left.life.stage()), (vec![said(from_now_on)], Stage::Going));
    // Before the run has begun there is nobody to drive; that it has may take a moment to be heard of.
    let mut unknown = dies(OnExit::ShieldFallback, false);
    assert_eq!((unknown.at(20.0), unknown.life.stage()), (vec![], Stage::Going));
    unknown.at(23.0);
    assert!(unknown.failure().contains("controller mine"));
    let mut heard = dies(OnExit::ShieldFallback, false);
    heard.life.stepped(s(20.5));
    assert_eq!(heard.at(20.5), [said(from_now_on)]);
}

#[test]
fn a_plug_in_on_its_way_when_all_was_over_is_ended_without_a_word() {
    let mut run = Scene::new();
    run.life.on_exit(3, OnExit::Restart);
    run.life.stepped(s(1.0));
    run.ends(3, KILLED, 20.0);
    run.at(20.0);
    run.life.started(3, 203, s(20.0));
    // It had not been let in: its generation is that of the one before.
    run.life.came_to("controller mine", 0);
    run.finishes(21.0);
    assert!(run.at(21.0).contains(&Act::Ask(3)));
    run.ends(3, End::Signal(15, "SIGTERM"), 21.0);
    assert_eq!(run.said(21.0), "");
}

#[test]
fn a_plug_in_whose_program_changes_is_started_again_and_one_that_dies_soon_waits_for_that() {
    let mut run = Scene::new();
    run.life.on_exit(3, OnExit::Restart);
    run.life.reloads(3);
    run.life.stepped(s(1.0));
    let changed = |run: &mut Scene, at: f64| {
        let mut acts = Vec::new();
        run.life.changed(3, "law.py", s(at), &mut acts);
        acts
    };
    let says = |text: &str| Act::Say(format!("cz: {text}"));
    let renewed = says("law.py has changed: controller mine (process 103) is started again");
    assert_eq!(changed(&mut run, 2.0), [renewed, Act::Ask(3)]);
    // Whoever changes it twice has it started once.
    assert_eq!(changed(&mut run, 2.1), []);
    run.ends(3, End::Code(0), 2.2);
    assert_eq!(run.at(2.2), [Act::Start(3)]);
    // The new one is of no use: nobody starts it over and over.
    run.life.started(3, 203, s(2.2));
    run.ends(3, End::Code(1), 2.5);
    let waits =
        "controller mine (process 203) ended with code 1; it is started again when its program changes";
    assert_eq!((run.at(60.0), run.life.stage()), (vec![says(waits)], Stage::Going));
    assert_eq!(changed(&mut run, 60.0), [says("law.py has changed: controller mine is started again")]);
    assert_eq!(run.at(60.0), [Act::Start(3)]);
    // One that has lived for a while is started again as ever.
    run.life.started(3, 303, s(60.0));
    run.ends(3, KILLED, 80.0);
    assert_eq!(run.at(80.0)[1], Act::Start(3));
    // Nobody waits for a change when all is over.
    run.life.started(3, 403, s(80.0));
    run.ends(3, End::Code(1), 80.1);
    run.finishes(81.0);
    assert_eq!(changed(&mut run, 81.1), []);
}
