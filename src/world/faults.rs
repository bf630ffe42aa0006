//! Faults on purpose: what sensors say in place of the truth, and which commands reach their vehicles.
//!
//! Every draw is a hash of seed, step, vehicle and purpose, so it does not matter who asks, in which order,
//! or how often. What has to be remembered (what a frozen sensor said, commands that are on their way) is
//! worked out once per step, from the state and the commands of all.
//!
//! The world integrates, shields and judges by the truth; what is wrong is what it tells others, and what it
//! hears of them. `docs/faults.md` says what each fault does.

use super::car::Car;
use super::metrics::FaultCounts;
use crate::lists::Lists;
use crate::scenario::{CommandFaults, Faults as Plan, Noise, Scenario, Scope, SensorKind, Span, ZoneId};
use ipc_schemas::{VERDICT_FALLBACK, VERDICT_HELD, VehicleState};
use std::collections::{BTreeMap, VecDeque};
use xxhash_rust::xxh3::xxh3_64;

/// The faults of a run and what came of them so far.
#[derive(Debug)]
pub(super) struct Faults {
    plan: Plan,
    draws: Draws,
    zones: usize,
    counts: FaultCounts,
    /// What sensors say of the present state, in the order of the frame.
    said: Vec<Sample>,
    /// Where each zone's part of it begins; that of the links comes last.
    starts: Vec<usize>,
    /// What frozen sensors repeat: by fault, zone and vehicle, with the step in which they last did.
    frozen: BTreeMap<(usize, ZoneId, u32), (Sample, u64)>,
    /// The ways from controllers to vehicles, by zone and vehicle.
    channels: BTreeMap<(ZoneId, u32), Channel>,
}

/// What a sensor says of a vehicle.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Sample {
    x_m: f64,
    v_mps: f64,
    u_mps2: f64,
}

/// What there is to know of one vehicle's commands.
#[derive(Debug, Default)]
struct Channel {
    /// The step in which it was last used.
    used: u64,
    /// Planned exit, instant and speed, of the last command that arrived.
    intent: (f64, f64),
    /// Commands that are late, by the step in which they arrive, ascending.
    late: VecDeque<(u64, Sent)>,
}

/// A command as its controller sent it.
#[derive(Clone, Copy, Debug)]
struct Sent {
    u_mps2: f64,
    intent: (f64, f64),
    verdict: u16,
}

/// What becomes of a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fate {
    Arrives,
    Late,
    Silent,
    Lost,
}

/// What bounds a vehicle that does what nobody has commanded for its present state.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limits {
    u_min_mps2: f64,
    v_max_mps: f64,
    dt_s: f64,
}

impl Faults {
    /// The faults of a scenario, if it has any.
    pub(super) fn of(scenario: &Scenario) -> Option<Box<Faults>> {
        let plan = scenario.faults.clone()?;
        let zones = scenario.network.zones.len();
        Some(Box::new(Faults {
            plan,
            draws: Draws { seed: scenario.seed },
            zones,
            counts: FaultCounts::default(),
            said: Vec::new(),
            starts: vec![0; zones + 1],
            frozen: BTreeMap::new(),
            channels: BTreeMap::new(),
        }))
    }

    pub(super) fn counts(&self) -> FaultCounts {
        self.counts
    }

    /// Whether sensors may say anything but the truth.
    pub(super) fn has_sensors(&self) -> bool {
        self.plan.noise.is_some() || !self.plan.sensors.is_empty()
    }

    /// Works out what sensors say of a new state, given its true records in the order of the frame.
    pub(super) fn sense(&mut self, step: u64, time_s: f64, truth: impl Iterator<Item = VehicleState>) {
        self.said.clear();
        self.starts.clear();
        for record in truth {
            let place = (record.zone as usize).min(self.zones);
            if self.starts.len() <= place {
                self.starts.resize(place + 1, self.said.len());
            }
            let sample = self.sample(step, time_s, &record);
            self.said.push(sample);
        }
        self.starts.resize(self.zones + 1, self.said.len());
        self.frozen.retain(|_, (_, last)| *last == step);
    }

    fn sample(&mut self, step: u64, time_s: f64, record: &VehicleState) -> Sample {
        let (zone, vehicle) = (record.zone, record.vehicle);
        let mut sample = Sample { x_m: record.x_m, v_mps: record.v_mps, u_mps2: record.u_mps2 };
        if let Some(noise) = self.plan.noise.filter(|noise| noise.span.contains(time_s)) {
            let Noise { position_sd_m, speed_sd_mps, .. } = noise;
            sample.x_m += position_sd_m * self.draws.normal(step, vehicle, Purpose::Position);
            sample.speed(sample.v_mps + speed_sd_mps * self.draws.normal(step, vehicle, Purpose::Speed));
            self.counts.records_noisy += 1;
        }
        let (mut is_biased, mut is_frozen) = (false, false);
        for (index, fault) in self.plan.sensors.iter().enumerate() {
            let purpose = Purpose::Sensor(index as u32);
            if !self.draws.concerns(time_s, &fault.span, &fault.scope, (zone, record.path), vehicle, purpose)
            {
                continue;
            }
            match fault.kind {
                SensorKind::Bias { position_m, speed_mps } => {
                    sample.x_m += position_m;
                    sample.speed(sample.v_mps + speed_mps);
                    is_biased = true;
                }
                SensorKind::Frozen => {
                    let entry = self.frozen.entry((index, zone, vehicle));
                    let (said, last) = entry.or_insert((sample, step));
                    (*last, sample) = (step, *said);
                    is_frozen = true;
                }
            }
        }
        self.counts.records_biased += u64::from(is_biased);
        self.counts.records_frozen += u64::from(is_frozen);
        sample
    }

    /// The records of the present frame as sensors have them, from the true ones.
    pub(super) fn measured(
        &self,
        truth: impl Iterator<Item = VehicleState>,
    ) -> impl Iterator<Item = VehicleState> {
        truth.zip(&self.said).map(as_said)
    }

    /// The same for the records of one zone.
    pub(super) fn measured_in(
        &self,
        zone: ZoneId,
        truth: impl Iterator<Item = VehicleState>,
    ) -> impl Iterator<Item = VehicleState> {
        truth.zip(&self.said[self.starts[zone as usize]..]).map(as_said)
    }

    /// Whether anything may happen to commands.
    pub(super) fn has_channels(&self) -> bool {
        self.plan.commands.is_some() || !self.plan.stalls.is_empty()
    }

    /// Decides which of the commands taken for a step reach their vehicles, and what those vehicles do that
    /// none reaches: `first` is where each zone's members begin.
    pub(super) fn deliver(
        &mut self,
        step: u64,
        time_s: f64,
        limits: Limits,
        cars: &mut Lists<Car>,
        first: impl Fn(usize) -> usize,
    ) {
        for zone in 0..self.zones {
            for car in cars[zone][first(zone)..].iter_mut().filter(|car| car.is_commanded) {
                let fate = self.fate(step, time_s, zone as ZoneId, car);
                self.counts.commands_lost += u64::from(fate == Fate::Lost);
                self.counts.commands_delayed += u64::from(fate == Fate::Late);
                self.counts.commands_stalled += u64::from(fate == Fate::Silent);
                let channel = self.channels.entry((zone as ZoneId, car.vehicle)).or_default();
                let delay = self.plan.commands.map_or(0, |c| u64::from(c.delay_steps));
                channel.deliver(step, fate, delay, limits, car);
            }
        }
        self.channels.retain(|_, channel| channel.used == step);
    }

    fn fate(&self, step: u64, time_s: f64, zone: ZoneId, car: &Car) -> Fate {
        // What the world puts in itself has no way to go.
        if matches!(car.visit.verdict, VERDICT_HELD | VERDICT_FALLBACK) {
            return Fate::Arrives;
        }
        let vehicle = car.vehicle;
        for (stall, index) in self.plan.stalls.iter().zip(0..) {
            let (purpose, place) = (Purpose::Stall(index), (zone, car.path));
            if self.draws.concerns(time_s, &stall.span, &stall.scope, place, vehicle, purpose) {
                return Fate::Silent;
            }
        }
        let commands = self.plan.commands.filter(|commands| commands.span.contains(time_s));
        let Some(CommandFaults { loss, delay_probability, .. }) = commands else { return Fate::Arrives };
        if self.draws.uniform(step, vehicle, Purpose::Loss) < loss {
            Fate::Lost
        } else if self.draws.uniform(step, vehicle, Purpose::Delay) < delay_probability {
            Fate::Late
        } else {
            Fate::Arrives
        }
    }
}

impl Limits {
    pub(super) fn of(scenario: &Scenario) -> Limits {
        let vehicle = &scenario.vehicle;
        Limits { u_min_mps2: vehicle.u_min_mps2, v_max_mps: vehicle.v_max_mps, dt_s: scenario.dt_s() }
    }

    /// The acceleration, or what takes the vehicle to the greatest speed within the step.
    fn bound(&self, u_mps2: f64, v_mps: f64) -> f64 {
        u_mps2.min((self.v_max_mps - v_mps) / self.dt_s).max(self.u_min_mps2)
    }
}

impl Channel {
    /// Turns the command in the car as it was sent into the one it obeys.
    fn deliver(&mut self, step: u64, fate: Fate, delay_steps: u64, limits: Limits, car: &mut Car) {
        self.used = step;
        let intent = (car.planned_exit_time_s, car.planned_exit_speed_mps);
        let sent = Sent { u_mps2: car.command_mps2, intent, verdict: car.visit.verdict };
        // A controller that has missed its deadline has sent nothing newer than what is late.
        let is_put_in = sent.verdict == VERDICT_HELD;
        if fate == Fate::Arrives && !is_put_in {
            // Nothing older may undo what has arrived.
            self.late.clear();
            self.intent = intent;
            return;
        }
        if fate == Fate::Late {
            self.late.push_back((step + delay_steps, sent));
        }
        let is_due = self.late.front().is_some_and(|(due, _)| *due == step);
        let arrived = if is_due { self.late.pop_front() } else { None };
        // Otherwise the vehicle keeps the acceleration it had.
        let u_mps2 = if is_put_in { sent.u_mps2 } else { car.u_mps2 };
        let held = Sent { u_mps2, intent: self.intent, verdict: VERDICT_HELD };
        let obeyed = arrived.map_or(held, |(_, sent)| sent);
        self.intent = obeyed.intent;
        car.command_mps2 = limits.bound(obeyed.u_mps2, car.v_mps);
        (car.planned_exit_time_s, car.planned_exit_speed_mps) = obeyed.intent;
        car.visit.verdict = obeyed.verdict;
    }
}

impl Sample {
    /// A speed that is measured is not negative, and 0 has one sign.
    fn speed(&mut self, v_mps: f64) {
        self.v_mps = if v_mps > 0.0 { v_mps } else { 0.0 };
    }
}

fn as_said((truth, said): (VehicleState, &Sample)) -> VehicleState {
    VehicleState { x_m: said.x_m, v_mps: said.v_mps, u_mps2: said.u_mps2, ..truth }
}

/// What a draw is for: draws of different purposes are independent.
#[derive(Clone, Copy, Debug)]
pub(super) enum Purpose {
    Position,
    Speed,
    Loss,
    Delay,
    /// Whether a vehicle belongs to the scope of the sensor fault of this index.
    Sensor(u32),
    /// The same for a stall.
    Stall(u32),
    /// What a human driver's desired speed differs from the mean.
    Desired,
    /// Error of a human driver's acceleration.
    Wavering,
    /// Whether a human driver brakes for no reason.
    Scare,
}

impl Purpose {
    fn code(self) -> (u32, u32) {
        match self {
            Purpose::Position => (1, 0),
            Purpose::Speed => (2, 0),
            Purpose::Loss => (3, 0),
            Purpose::Delay => (4, 0),
            Purpose::Sensor(index) => (5, index),
            Purpose::Stall(index) => (6, index),
            Purpose::Desired => (7, 0),
            Purpose::Wavering => (8, 0),
            Purpose::Scare => (9, 0),
        }
    }
}

/// The run's random numbers, each a function of what it is for.
#[derive(Clone, Copy, Debug)]
pub(super) struct Draws {
    seed: u64,
}

impl Draws {
    pub(super) fn of(seed: u64) -> Draws {
        Draws { seed }
    }

    /// 64 random bits, the `word`th of a draw.
    fn bits(self, step: u64, vehicle: u32, purpose: Purpose, word: u32) -> u64 {
        let (kind, index) = purpose.code();
        let mut key = [0; 32];
        key[..8].copy_from_slice(&self.seed.to_le_bytes());
        key[8..16].copy_from_slice(&step.to_le_bytes());
        for (place, part) in key[16..].chunks_exact_mut(4).zip([vehicle, kind, index, word]) {
            place.copy_from_slice(&part.to_le_bytes());
        }
        xxh3_64(&key)
    }

    /// Uniform in [0, 1).
    pub(super) fn uniform(self, step: u64, vehicle: u32, purpose: Purpose) -> f64 {
        const STEP: f64 = 1.0 / (1u64 << 53) as f64;
        (self.bits(step, vehicle, purpose, 0) >> 11) as f64 * STEP
    }

    /// Nearly normal with mean 0 and variance 1, within 6 of 0: the sum of twelve uniform numbers of 16 bits
    /// each, less its mean. Exact, where a logarithm or a cosine would depend on the machine.
    pub(super) fn normal(self, step: u64, vehicle: u32, purpose: Purpose) -> f64 {
        let words = (0..3).map(|word| self.bits(step, vehicle, purpose, word));
        let sum: u64 = words.map(|w| (0..4).map(|i| w >> (16 * i) & 0xffff).sum::<u64>()).sum();
        // Each stands for the middle of its interval of 2^-16.
        (sum as f64 + 6.0) * (1.0 / 65_536.0) - 6.0
    }

    /// Whether a fault concerns a vehicle at a place and an instant.
    fn concerns(
        self,
        time_s: f64,
        span: &Span,
        scope: &Scope,
        (zone, path): (ZoneId, u32),
        vehicle: u32,
        purpose: Purpose,
    ) -> bool {
        span.contains(time_s)
            && scope.reaches(zone, path)
            && (scope.fraction >= 1.0 || self.uniform(0, vehicle, purpose) < scope.fraction)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DRAWS: Draws = Draws { seed: 7 };

    #[test]
    fn noise_has_mean_0_and_variance_1_and_is_not_correlated() {
        let n = 200_000;
        let draw = |i: u32, purpose| DRAWS.normal(u64::from(i / 100), i % 100, purpose);
        let (mut sum, mut squares, mut fourth, mut products, mut beyond) = (0.0, 0.0, 0.0, 0.0, 0);
        for i in 0..n {
            let (x, v) = (draw(i, Purpose::Position), draw(i, Purpose::Speed));
            assert!(x.abs() < 6.0);
            sum += x;
            squares += x * x;
            fourth += x * x * x * x;
            products += x * v + x * draw(i + 1, Purpose::Position) + x * draw(i + 100, Purpose::Position);
            beyond += u32::from(x.abs() > 1.96);
        }
        let n = f64::from(n);
        // About five standard errors each.
        assert!((sum / n).abs() < 0.012, "mean {}", sum / n);
        assert!((squares / n - 1.0).abs() < 0.016, "variance {}", squares / n);
        assert!((fourth / n - 2.9).abs() < 0.1, "fourth moment {}", fourth / n);
        assert!((products / n).abs() < 0.02, "covariances {}", products / n);
        assert!((f64::from(beyond) / n - 0.05).abs() < 0.003, "{beyond} beyond 1.96");
    }

    #[test]
    fn uniform_numbers_fall_below_a_probability_that_often() {
        for p in [0.0, 0.05, 0.5, 1.0] {
            let below = (0..100_000).filter(|&i| DRAWS.uniform(i, 3, Purpose::Loss) < p).count();
            let five_errors = 5.0 * (p * (1.0 - p) / 1e5).sqrt();
            assert!((below as f64 / 1e5 - p).abs() <= five_errors, "{below} below {p}");
        }
    }

    #[test]
    fn every_part_of_the_key_counts() {
        let mut seen = std::collections::BTreeSet::new();
        for (seed, step, vehicle, word) in
            [(0, 0, 0, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1), (1 << 40, 1 << 40, 0, 0)]
        {
            for purpose in
                [Purpose::Position, Purpose::Speed, Purpose::Loss, Purpose::Delay, Purpose::Sensor(0)]
                    .into_iter()
                    .chain([Purpose::Sensor(1), Purpose::Stall(0), Purpose::Stall(1)])
            {
                assert!(seen.insert(Draws { seed }.bits(step, vehicle, purpose, word)), "{purpose:?}");
            }
        }
    }
}
