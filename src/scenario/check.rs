//! Is this scenario one that the loader would have made? For scenarios that come as bytes from elsewhere.
//!
//! The loader refuses with places and keys; here there are none, and whoever meets a fault holds a file that
//! no version of this program wrote.

use super::fault::{Check, ScenarioFault, inside, number, require, within};
use super::keys;
use super::network::entrance_without_way_out;
use super::ranges::{self, MAX_COUNT, MAX_DELAY, MAX_ERROR, MAX_KINDS, MAX_RATE_PER_HOUR, MAX_TIME_S};
use super::{
    Demand, Faults, HumanParams, Network, Path, Poisson, Road, Scenario, Scope, SensorKind, Source, Span,
    VehicleParams, Zone, flow,
};

impl Scenario {
    /// Checks every value and index as the loader does.
    pub fn check(&self) -> Result<(), ScenarioFault> {
        let dt_s = self.dt_s();
        within(&keys::DT, dt_s)?;
        let longest_s = MAX_TIME_S.min(dt_s * ranges::MAX_STEPS);
        number("max_time_s", self.max_time_s, |t| t >= dt_s && t <= longest_s)?;
        require(self.max_vehicles != Some(0), || "max_vehicles = 0".to_owned())?;
        within(&keys::BETA, self.beta)?;
        vehicle(&self.vehicle)?;
        require(!self.fleet.is_empty() && self.fleet.len() <= MAX_KINDS, || "the fleet".to_owned())?;
        for kind in &self.fleet {
            vehicle(&kind.vehicle)?;
            within(&keys::SHARE, kind.share)?;
            // Steps and paths are sized for the fastest.
            number("v_max_mps", kind.vehicle.v_max_mps, |v| v <= self.vehicle.v_max_mps)?;
            kind.human.as_ref().map_or(Ok(()), |driver| human(driver, &kind.vehicle))?;
        }
        let control = &self.control;
        for (key, value) in [
            (&keys::K_REAR_END, control.k_rear_end_per_s),
            (&keys::K_MERGE, control.k_merge_per_s),
            (&keys::K_SPEED, control.k_speed_per_s),
            (&keys::CLF_RATE, control.clf_rate_per_s),
            (&keys::SLACK_WEIGHT, control.slack_weight),
        ] {
            within(key, value)?;
        }
        within(&keys::PRICE_OF_TIME, self.coordination.price_of_time)?;
        within(&keys::TANDEM_WEIGHT, self.coordination.tandem_weight)?;
        let viable = &control.viable;
        for (key, value) in [
            (&keys::K_COMFORT, viable.k_comfort_per_s),
            (&keys::PRICE_OF_EXPOSURE, viable.price_of_exposure_mps4),
            (&keys::CLEARANCE, viable.clearance_m),
            (&keys::BUFFER, viable.buffer_m),
            (&keys::BUFFER_TIME, viable.buffer_s),
            (&keys::PASSAGE_WEIGHT, viable.passage_weight),
        ] {
            within(key, value)?;
        }
        number("fe_fraction", control.fe_fraction, |f| f > 0.0 && f <= 1.0)?;
        network(&self.network, self.vehicle.v_max_mps * dt_s, self.vehicle.v_max_mps)?;
        for exit in self.network.zones.iter().flat_map(|zone| &zone.exits) {
            flow::check(exit, &self.network, self.vehicle.v_max_mps)?;
        }
        for road in &self.network.roads {
            self.check_mixture(road)?;
            demand(&road.demand, &self.vehicle, road.routes.len())
                .map_err(|fault| ScenarioFault::of(format!("road {}: {fault}", road.name)))?;
        }
        self.check_plugins()?;
        self.faults.as_ref().map_or(Ok(()), |faults| self.check_faults(faults))
    }

    fn check_faults(&self, faults: &Faults) -> Check {
        require(*faults != Faults::default(), || "faults without a fault".to_owned())?;
        let probability = |what, p| number(what, p, |p| (0.0..=1.0).contains(&p));
        let error = |what, size: f64| number(what, size, |size| size.abs() <= MAX_ERROR);
        if let Some(noise) = &faults.noise {
            error("position_sd_m", noise.position_sd_m)?;
            error("speed_sd_mps", noise.speed_sd_mps)?;
            require(noise.position_sd_m >= 0.0 && noise.speed_sd_mps >= 0.0, || "noise < 0".to_owned())?;
            span(&noise.span)?;
        }
        for sensor in &faults.sensors {
            if let SensorKind::Bias { position_m, speed_mps } = sensor.kind {
                error("position_m", position_m)?;
                error("speed_mps", speed_mps)?;
            }
            self.check_scope(&sensor.scope)?;
            span(&sensor.span)?;
        }
        if let Some(commands) = &faults.commands {
            probability("loss", commands.loss)?;
            probability("delay_probability", commands.delay_probability)?;
            let is_sound = commands.delay_steps <= MAX_DELAY
                && (commands.delay_steps > 0 || commands.delay_probability == 0.0);
            require(is_sound, || format!("delay_steps = {}", commands.delay_steps))?;
            span(&commands.span)?;
        }
        for stall in &faults.stalls {
            self.check_scope(&stall.scope)?;
            span(&stall.span)?;
        }
        Ok(())
    }

    fn check_mixture(&self, road: &Road) -> Check {
        require(road.rank <= 1000, || format!("rank = {}", road.rank))?;
        let Some(share) = road.automated else { return Ok(()) };
        within(&keys::AUTOMATED, share)?;
        let has = |human: bool| self.fleet.iter().any(|k| k.human.is_some() == human && k.share > 0.0);
        require((share == 1.0 || has(true)) && (share == 0.0 || has(false)), || "automated".to_owned())
    }

    fn check_scope(&self, scope: &Scope) -> Check {
        number("fraction", scope.fraction, |f| f > 0.0 && f <= 1.0)?;
        let Some(paths) = &scope.paths else { return Ok(()) };
        let there = |&(zone, path): &(u32, u32)| {
            self.network.zones.get(zone as usize).is_some_and(|z| (path as usize) < z.paths.len())
        };
        let ascend = paths.windows(2).all(|w| w[0] < w[1]);
        let is_sound = !paths.is_empty() && ascend && paths.iter().all(there);
        require(is_sound, || "a fault's paths".to_owned())
    }

    fn check_plugins(&self) -> Check {
        let mut names = std::collections::BTreeSet::new();
        let mut driven = std::collections::BTreeSet::new();
        for plugin in &self.plugins {
            let bad = || format!("controller {}", plugin.name);
            require(names.insert(&plugin.name) && !plugin.paths.is_empty(), bad)?;
            require(plugin.paths.is_sorted(), bad)?;
            for &(zone, path) in &plugin.paths {
                let there = self.network.zones.get(zone as usize);
                let there = there.is_some_and(|z| (path as usize) < z.paths.len());
                require(there && driven.insert((zone, path)), bad)?;
            }
        }
        Ok(())
    }
}

fn span(span: &Span) -> Check {
    number("from_s", span.from_s, |f| (0.0..MAX_TIME_S).contains(&f))?;
    number("until_s", span.until_s, |u| u > span.from_s && u <= MAX_TIME_S)
}

fn vehicle(v: &VehicleParams) -> Check {
    within(&keys::U_MIN, v.u_min_mps2)?;
    within(&keys::U_MAX, v.u_max_mps2)?;
    within(&keys::V_MIN, v.v_min_mps)?;
    within(&keys::V_MAX, v.v_max_mps)?;
    number("v_max_mps", v.v_max_mps, |s| s > v.v_min_mps)?;
    within(&keys::LENGTH, v.length_m)?;
    within(&keys::REACTION_TIME, v.reaction_time_s)?;
    within(&keys::STANDSTILL_GAP, v.standstill_gap_m)
}

fn human(h: &HumanParams, v: &VehicleParams) -> Check {
    number("desired_mps", h.desired_mps, |s| keys::DESIRED.range.contains(s) && s <= v.v_max_mps)?;
    for (key, value) in [
        (&keys::DESIRED_SD, h.desired_sd_mps),
        (&keys::TIME_HEADWAY, h.headway_s),
        (&keys::JAM_GAP, h.jam_gap_m),
        (&keys::IDM_ACCELERATION, h.acceleration_mps2),
        (&keys::COMFORTABLE, h.comfortable_mps2),
        (&keys::DELAY, h.delay_s),
        (&keys::NOISE, h.noise_mps2),
        (&keys::CRITICAL_GAP, h.critical_gap_s),
        (&keys::PATIENCE, h.patience_s),
        (&keys::HARDEST, h.hardest_mps2),
        (&keys::SCARES, h.scares_per_h),
    ] {
        within(key, value)?;
    }
    Ok(())
}

/// Indices point at something, both ends of a connection know of each other, and every zone has a way out.
fn network(network: &Network, step_m: f64, v_max_mps: f64) -> Check {
    let (zones, roads) = (&network.zones, &network.roads);
    require(!zones.is_empty() && zones.len() <= MAX_COUNT, || format!("{} zones", zones.len()))?;
    require(!roads.is_empty() && roads.len() <= MAX_COUNT, || format!("{} roads", roads.len()))?;
    let mut roads_used = 0;
    for (index, zone) in (0..).zip(zones) {
        let bad = || format!("zone {}: the network does not hang together", zone.name);
        lanes(zone, step_m)?;
        for (at, segment) in (0..).zip(&zone.segments) {
            match segment.source {
                None => {}
                Some(Source::Road(road)) => {
                    let road = roads.get(road as usize);
                    require(road.is_some_and(|r| (r.zone, r.segment) == (index, at)), bad)?;
                    roads_used += 1;
                }
                Some(Source::Zone { zone: up, exit }) => {
                    let exit = zones.get(up as usize).and_then(|z| z.exits.get(exit as usize));
                    let to = exit.and_then(|exit| exit.to);
                    require(to.is_some_and(|to| (to.zone, to.segment) == (index, at)), bad)?;
                }
            }
        }
        for (at, exit) in (0..).zip(&zone.exits) {
            let Some(to) = exit.to else { continue };
            let there = zones.get(to.zone as usize).and_then(|z| z.segments.get(to.segment as usize));
            let source = Source::Zone { zone: index, exit: at };
            require(there.is_some_and(|segment| segment.source == Some(source)), bad)?;
            inside("link_m", to.link_m, &ranges::LINK_LENGTH)?;
            number("link_m", to.link_m, |l| l == 0.0 || l >= step_m)?;
            let is_speed = |v| ranges::LINK_SPEED.contains(v) && v <= v_max_mps;
            number("link_speed_mps", to.link_speed_mps, is_speed)?;
        }
    }
    let has_way_out = entrance_without_way_out(zones).is_none();
    require(has_way_out, || "an entrance from which nobody comes out".to_owned())?;
    for road in roads {
        for route in &road.routes {
            within(&keys::SHARE, route.share)?;
            let (mut at, mut segment) = (Some(road.zone), road.segment);
            for &path in &route.paths {
                let zone = at.map(|zone| &zones[zone as usize]);
                let leads = zone.is_some_and(|zone| zone.paths_from(segment).any(|p| p == path));
                require(leads, || format!("road {}: a route that leads nowhere", road.name))?;
                let to = zone.and_then(|zone| zone.exit_of(path).to);
                (at, segment) = (to.map(|to| to.zone), to.map_or(0, |to| to.segment));
            }
        }
    }
    require(roads_used == roads.len(), || "a road that leads nowhere".to_owned())
}

/// What a zone has inside.
fn lanes(zone: &Zone, step_m: f64) -> Check {
    let bad = || format!("zone {}: its paths do not hang together", zone.name);
    for count in [zone.segments.len(), zone.paths.len(), zone.exits.len()] {
        require((1..=MAX_COUNT).contains(&count), bad)?;
    }
    let mut is_used = vec![false; zone.segments.len()];
    let mut is_left_by = vec![false; zone.exits.len()];
    for segment in &zone.segments {
        inside("length_m", segment.length_m, &ranges::SEGMENT_LENGTH)?;
        require(segment.shape.iter().flatten().all(|m| m.abs() <= 1e7), bad)?;
        require(segment.shape.len() != 1, bad)?;
    }
    for path in &zone.paths {
        let mut length_m = 0.0;
        require(!path.segments.is_empty() && path.segments.len() <= zone.segments.len(), bad)?;
        for (place, &at) in path.segments.iter().enumerate() {
            let segment = zone.segments.get(at as usize);
            require(segment.is_some_and(|s| s.source.is_some() == (place == 0)), bad)?;
            require(!path.segments[..place].contains(&at), bad)?;
            is_used[at as usize] = true;
            length_m += segment.map_or(0.0, |s| s.length_m);
        }
        require(path.length_m == length_m, bad)?;
        inside("length_m", length_m, &ranges::PATH_LENGTH)?;
        number("length_m", length_m, |l| l >= step_m)?;
        within(&keys::SHARE, path.share)?;
        require((path.exit as usize) < zone.exits.len(), bad)?;
        is_left_by[path.exit as usize] = true;
    }
    require(is_used.iter().chain(&is_left_by).all(|used| *used), bad)?;
    for crossing in &zone.crossings {
        require(crossing.places.len() >= 2, bad)?;
        for area in &crossing.places {
            inside("length_m", area.length_m, &ranges::CROSSING_LENGTH)?;
            let segment = zone.segments.get(area.segment as usize);
            require(segment.is_some_and(|s| (0.0..=s.length_m).contains(&area.from_m)), bad)?;
        }
        let passed =
            |path: &Path| crossing.places.iter().filter(|area| path.segments.contains(&area.segment)).count();
        require(zone.paths.iter().all(|path| passed(path) <= 1), bad)?;
    }
    Ok(())
}

fn demand(demand: &Demand, vehicle: &VehicleParams, routes: usize) -> Check {
    let VehicleParams { v_min_mps, v_max_mps, .. } = *vehicle;
    let Poisson { rates, min_headway_s, speed } = match demand {
        Demand::Poisson(process) => process,
        Demand::Trace(arrivals) => {
            let mut last_s = 0.0;
            for arrival in arrivals {
                number("time_s", arrival.time_s, |t| t >= last_s && t <= MAX_TIME_S)?;
                number("speed_mps", arrival.speed_mps, |v| v >= v_min_mps && v <= v_max_mps)?;
                let is_known = arrival.route.is_none_or(|route| (route as usize) < routes);
                require(is_known, || format!("route = {:?}", arrival.route))?;
                last_s = arrival.time_s;
            }
            return Ok(());
        }
    };
    inside("min_headway_s", *min_headway_s, &ranges::HEADWAY)?;
    let mut last_s = 0.0;
    for period in rates {
        number("until_s", period.until_s, |t| t > last_s && t <= MAX_TIME_S)?;
        let rate = period.vehicles_per_hour;
        number("vehicles_per_hour", rate, |r| (0.0..=MAX_RATE_PER_HOUR).contains(&r))?;
        number("min_headway_s", *min_headway_s, |h| rate * h < 3600.0)?;
        last_s = period.until_s;
    }
    number("speed_min_mps", speed.min_mps, |v| v >= v_min_mps && v <= v_max_mps)?;
    number("speed_max_mps", speed.max_mps, |v| v >= speed.min_mps && v <= v_max_mps)?;
    number("speed_mean_mps", speed.mean_mps, |v| v >= speed.min_mps && v <= speed.max_mps)?;
    number("speed_sd_mps", speed.sd_mps, |sd| sd >= 0.0 && sd <= speed.max_mps - speed.min_mps)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use crate::scenario::{
        Faults, OnExit, Override, Plugin, Scenario, SensorKind, decode, embedded_names, encode, load,
        load_embedded,
    };

    #[test]
    fn what_the_loader_makes_is_sound() {
        for name in embedded_names() {
            for seed in [1, 2, 3] {
                assert_eq!(load_embedded(name, &[], Some(seed)).unwrap().check(), Ok(()), "{name}");
            }
        }
        let sets = ["controllers=[{name=\"a\",zones=[\"merge-1\"]},{name=\"b\",paths=[\"merge-2.main\"]}]"];
        let sets: Vec<Override> = sets.iter().map(|s| s.parse().unwrap()).collect();
        assert_eq!(load(None, &sets, None).unwrap().check(), Ok(()));
        for family in [crate::bench::Family::Corridors, crate::bench::Family::Grids] {
            assert_eq!(crate::bench::side_by_side(family, 500, 60.0).unwrap().check(), Ok(()));
        }
    }

    fn faults(scenario: &mut Scenario) -> &mut Faults {
        scenario.faults.as_mut().unwrap()
    }

    #[test]
    fn what_it_would_refuse_is_not() {
        let sound = load_embedded("two-merges", &[], None).unwrap();
        let spoil: [fn(&mut Scenario); 22] = [
            |s| s.dt_ns = 0,
            |s| s.max_time_s = f64::NAN,
            |s| s.beta = 0.0,
            |s| s.vehicle.v_max_mps = f64::INFINITY,
            |s| s.vehicle.u_min_mps2 = 1.0,
            |s| s.control.fe_fraction = 2.0,
            |s| s.network.zones.clear(),
            |s| s.network.zones[0].paths.clear(),
            |s| s.network.zones[1].paths[0].length_m = 0.0,
            |s| s.network.zones.swap(0, 1),
            |s| s.network.roads[0].zone = 99,
            |s| {
                s.network.roads.pop();
            },
            |s| {
                s.network.roads[0].demand = crate::scenario::Demand::Trace(vec![crate::scenario::Arrival {
                    time_s: -1.0,
                    speed_mps: 9.0,
                    route: None,
                }])
            },
            |s| {
                let paths = vec![(7, 0)];
                s.plugins = vec![Plugin { name: "p".into(), paths, command: None, on_exit: OnExit::End }];
            },
            |s| s.faults = Some(Faults::default()),
            |s| faults(s).noise.as_mut().unwrap().position_sd_m = -1.0,
            |s| faults(s).noise.as_mut().unwrap().span.until_s = 0.0,
            |s| faults(s).sensors[0].kind = SensorKind::Bias { position_m: f64::NAN, speed_mps: 0.0 },
            |s| faults(s).sensors[0].scope.fraction = 0.0,
            |s| faults(s).commands.as_mut().unwrap().loss = 1.1,
            |s| faults(s).commands.as_mut().unwrap().delay_steps = 0,
            |s| faults(s).stalls[0].scope.paths = Some(vec![(1, 0), (0, 7)]),
        ];
        let sound = Scenario { faults: load_embedded("faulty-sensors", &[], None).unwrap().faults, ..sound };
        assert_eq!(sound.check(), Ok(()));
        for (i, spoil) in spoil.into_iter().enumerate() {
            let mut scenario = sound.clone();
            spoil(&mut scenario);
            assert!(scenario.check().is_err(), "number {i} passed");
        }
    }

    #[test]
    fn a_scenario_with_any_wrong_byte_is_refused_or_can_be_run() {
        use crate::lockstep::in_process::InProcess;
        use std::sync::Arc;
        let bytes = encode(&load_embedded("tree", &[], None).unwrap());
        let mut run = 0;
        for i in 0..bytes.len() {
            for flip in [0x01, 0x80, 0xff] {
                let mut wrong = bytes.clone();
                wrong[i] ^= flip;
                let Ok(scenario) = decode(&wrong) else { continue };
                if scenario.check().is_err() {
                    continue;
                }
                let mut process = InProcess::new(&Arc::new(scenario), 1, 1);
                for _ in 0..3 {
                    // What goes wrong must be an error, not a panic.
                    if !matches!(process.step(), Ok(true)) {
                        break;
                    }
                }
                run += 1;
            }
        }
        assert!(run > 100, "only {run} scenarios were run");
    }
}
