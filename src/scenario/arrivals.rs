//! The arrivals of a road, one by one.
//!
//! Each road draws from a random stream of its own, so that what happens on one road, or whether there is
//! another, never changes the vehicles of a third: policies are compared on common random numbers.

use super::demand::{Arrival, Demand, Poisson, RatePeriod, SpeedDistribution};
use super::network::Road;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Exp1, StandardNormal};

/// Arrivals of one road in order of time.
#[derive(Clone, Debug)]
pub struct ArrivalStream(Kind);

#[derive(Clone, Debug)]
enum Kind {
    Trace(std::vec::IntoIter<Arrival>),
    Poisson(Box<PoissonStream>),
}

impl ArrivalStream {
    /// The arrivals of a road of [`super::Network::roads`]; `index` is its index there, `seed` the scenario's.
    pub fn new(road: &Road, index: u32, seed: u64) -> Self {
        match &road.demand {
            Demand::Trace(arrivals) => Self(Kind::Trace(arrivals.clone().into_iter())),
            Demand::Poisson(process) => {
                Self(Kind::Poisson(Box::new(PoissonStream::new(process.clone(), index, seed))))
            }
        }
    }
}

impl Iterator for ArrivalStream {
    type Item = Arrival;

    fn next(&mut self) -> Option<Arrival> {
        match &mut self.0 {
            Kind::Trace(arrivals) => arrivals.next(),
            Kind::Poisson(stream) => stream.next(),
        }
    }
}

#[derive(Clone, Debug)]
struct PoissonStream {
    process: Poisson,
    random: ChaCha8Rng,
    /// Instant from which the next arrival is free to come, s.
    free_from_s: f64,
}

impl PoissonStream {
    fn new(process: Poisson, index: u32, seed: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(index.into());
        // As if the vehicle before the first had come one least headway before the start.
        Self { process, random, free_from_s: 0.0 }
    }

    fn next(&mut self) -> Option<Arrival> {
        // Both draws belong to the vehicle, whether or not it still comes.
        let exposure = Exp1.sample(&mut self.random);
        let time_s = round(self.instant(exposure)?, 1e6);
        let speed_mps = draw_speed(&self.process.speed, &mut self.random);
        self.free_from_s = time_s + self.process.min_headway_s;
        Some(Arrival { time_s, speed_mps, route: None })
    }

    /// The instant at which the hazard accumulated since the road became free reaches `exposure`.
    ///
    /// Under one rate this is an exponential headway with mean `1/rate - min_headway` on top of the least
    /// one; a headway that spans a change of rate uses up its hazard at each rate for as long as it lasts.
    fn instant(&self, mut exposure: f64) -> Option<f64> {
        let mut from_s = self.free_from_s;
        for RatePeriod { until_s, vehicles_per_hour } in &self.process.rates {
            if *until_s <= from_s {
                continue;
            }
            if *vehicles_per_hour > 0.0 {
                let mean_s = 3600.0 / vehicles_per_hour - self.process.min_headway_s;
                let at_s = from_s + exposure * mean_s;
                if at_s < *until_s {
                    return Some(at_s);
                }
                exposure -= (until_s - from_s) / mean_s;
            }
            from_s = *until_s;
        }
        None
    }
}

fn draw_speed(speed: &SpeedDistribution, random: &mut ChaCha8Rng) -> f64 {
    loop {
        let normal: f64 = StandardNormal.sample(random);
        let drawn = speed.mean_mps + speed.sd_mps * normal;
        if (speed.min_mps..=speed.max_mps).contains(&drawn) {
            // Rounding may step over a bound that has more digits.
            return round(drawn, 1e3).clamp(speed.min_mps, speed.max_mps);
        }
    }
}

/// Rounds to multiples of `1/per_unit`, so that arrivals do not depend on the last bit of the platform's
/// logarithm.
fn round(value: f64, per_unit: f64) -> f64 {
    (value * per_unit).round() / per_unit
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::EntryRule;

    fn poisson(rates: &[(f64, f64)], min_headway_s: f64) -> Road {
        let rates = rates
            .iter()
            .map(|&(until_s, vehicles_per_hour)| RatePeriod { until_s, vehicles_per_hour })
            .collect();
        let speed = SpeedDistribution { mean_mps: 16.0, sd_mps: 1.2, min_mps: 14.0, max_mps: 17.5 };
        let demand = Demand::Poisson(Poisson { rates, min_headway_s, speed });
        Road {
            name: "r".into(),
            zone: 0,
            segment: 0,
            demand,
            routes: Vec::new(),
            entry: EntryRule::Free,
            automated: None,
            rank: 0,
        }
    }

    fn arrivals(road: &Road, index: u32, seed: u64) -> Vec<Arrival> {
        ArrivalStream::new(road, index, seed).collect()
    }

    #[test]
    fn the_seed_and_the_road_decide_and_nothing_else() {
        let road = poisson(&[(2000.0, 400.0)], 1.2);
        let first = arrivals(&road, 0, 1);
        assert_eq!(first, arrivals(&road, 0, 1));
        assert_ne!(first, arrivals(&road, 0, 2));
        assert_ne!(first, arrivals(&road, 1, 1));
        // A stream shares nothing with another: interleaving draws changes neither.
        let mut a = ArrivalStream::new(&road, 0, 1);
        let mut b = ArrivalStream::new(&road, 1, 1);
        for expected in &first {
            b.next();
            assert_eq!(a.next().as_ref(), Some(expected));
        }
    }

    #[test]
    fn headways_and_speeds_keep_their_bounds() {
        let road = poisson(&[(20_000.0, 1500.0)], 1.2);
        let all = arrivals(&road, 3, 7);
        assert!(all.iter().all(|a| (14.0..=17.5).contains(&a.speed_mps)));
        assert!(all.windows(2).all(|w| w[1].time_s - w[0].time_s >= 1.2 - 1e-9));
        // The cut-off normal's mean: 16 + 1.2 (pdf(-5/3) - pdf(1.25)) / (cdf(1.25) - cdf(-5/3)).
        let mean = all.iter().map(|a| a.speed_mps).sum::<f64>() / all.len() as f64;
        assert!((mean - 15.893).abs() < 0.04, "{mean}");
    }

    #[test]
    fn each_period_has_its_rate() {
        // Long periods, so that the transient at their start does not matter.
        let h = 3.6e5;
        let road = poisson(&[(h, 300.0), (2.0 * h, 0.0), (3.0 * h, 1200.0)], 1.2);
        let all = arrivals(&road, 0, 5);
        let count =
            |from: f64, to: f64| all.iter().filter(|a| a.time_s >= from && a.time_s < to).count() as f64;
        assert_eq!(count(h, 2.0 * h), 0.0);
        // A renewal process with headway mean m and deviation m - 1.2 has variance n ((m - 1.2) / m)^2.
        for (from, n, mean_s) in [(0.0, 30_000.0_f64, 12.0), (2.0 * h, 120_000.0, 3.0)] {
            let deviation = n.sqrt() * (mean_s - 1.2) / mean_s;
            let got = count(from, from + h);
            assert!((got - n).abs() < 4.0 * deviation, "{got} of {n}, deviation {deviation}");
        }
        assert!(all.last().is_some_and(|a| a.time_s < 3.0 * h + 1e-6));
    }

    #[test]
    fn a_headway_across_a_change_of_rate_uses_up_its_hazard() {
        let road = poisson(&[(100.0, 360.0), (200.0, 0.0), (400.0, 720.0)], 0.0);
        let Demand::Poisson(process) = road.demand else { unreachable!("built above") };
        let mut stream = PoissonStream::new(process, 0, 1);
        stream.free_from_s = 95.0;
        // 0.5 of the hazard in 5 s at mean 10 s, none for 100 s, the other 0.5 at mean 5 s.
        assert_eq!(stream.instant(1.0), Some(202.5));
        assert_eq!(stream.instant(0.4), Some(99.0));
        assert_eq!(stream.instant(41.0), None);
    }

    #[test]
    fn a_constant_speed_needs_no_spread() {
        let speed = SpeedDistribution { mean_mps: 15.0, sd_mps: 0.0, min_mps: 15.0, max_mps: 15.0 };
        assert_eq!(draw_speed(&speed, &mut ChaCha8Rng::seed_from_u64(1)), 15.0);
    }

    /// The draws of seed 1 themselves: an update of a random library that changes them is noticed here.
    #[test]
    fn known_draws() {
        let all = arrivals(&poisson(&[(2000.0, 400.0)], 1.2), 0, 1);
        let first: Vec<_> = all.iter().take(3).map(|a| (a.time_s, a.speed_mps)).collect();
        assert_eq!(first, [(3.485845, 14.307), (14.161271, 14.648), (16.543824, 16.921)]);
    }
}
