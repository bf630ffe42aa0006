//! A recording step by step, with the world brought on beside it.

use control_zones::record::{Damage, InForce, Reader, Source, Step, WorldReplay};
use control_zones::world::{CompletedVisit, WorldSummary};

/// One recorded step.
#[derive(Clone, Copy, Debug)]
pub struct Moment<'a> {
    /// Its frames.
    pub step: &'a Step,
    /// The assignments in force, those of the step included.
    pub in_force: &'a InForce,
    /// Visits that ended between this step and the next.
    pub visits: &'a [CompletedVisit],
}

/// What is known once the last step has been seen.
#[derive(Debug, Default)]
pub struct Ended {
    /// Number of steps.
    pub steps: u64,
    /// Where the file is damaged.
    pub damage: Vec<Damage>,
    /// From which step on visits are not known, and why.
    pub lost: Option<(u64, String)>,
    /// The run's results as far as the world was brought on.
    pub summary: Option<WorldSummary>,
}

/// Shows every step in order.
///
/// Visits and results come from the world, replayed from the recorded commands and compared with every recorded
/// state. Behind a gap, a damaged place or a difference there are none any more.
pub fn walk<S: Source, E>(
    reader: &Reader<S>,
    mut each: impl FnMut(&Moment<'_>) -> Result<(), E>,
) -> Result<Ended, E> {
    let mut ended = Ended::default();
    let mut world = WorldReplay::new(reader);
    world.record_visits();
    let mut in_force = InForce::default();
    let mut seen = 0;
    for step in reader.steps() {
        let step = match step {
            Ok(step) => step,
            Err(damage) => {
                ended.damage.push(damage);
                continue;
            }
        };
        in_force.take(&step);
        let number = step.header.step;
        if ended.lost.is_none() {
            if number != world.world().step() {
                ended.lost = Some((world.world().step(), "a step before it is missing".to_owned()));
            } else if let Err(error) = world.take(&step) {
                ended.lost = Some((number, error.to_string()));
            }
        }
        let visits = world.world().visits();
        each(&Moment { step: &step, in_force: &in_force, visits: &visits[seen..] })?;
        seen = visits.len();
        ended.steps += 1;
    }
    ended.summary = Some(world.world().summary());
    Ok(ended)
}
