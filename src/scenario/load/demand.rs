//! The demand of a road: an arrival trace or a seeded random process.

use super::error::{Place, ScenarioError, nearest};
use super::table::{Field, Table};
use crate::scenario::keys;
use crate::scenario::ranges::{MAX_RATE_PER_HOUR, MAX_TIME_S};
use crate::scenario::{
    Arrival, Demand, Poisson, RatePeriod, Route, SpeedDistribution, VehicleParams, ranges,
};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::rc::Rc;

const HEADER: &str = "time_s,road,speed_mps";
/// A trace may say which of its road's routes a vehicle takes.
const HEADER_WITH_ROUTES: &str = "time_s,road,speed_mps,route";

/// Where the traces a scenario names are found.
pub(super) enum TraceBase {
    /// Relative to this directory.
    Directory(PathBuf),
    /// Among the embedded ones; other paths are relative to the current directory.
    Embedded,
    /// Among these, by path.
    Given(Vec<(String, Vec<u8>)>),
}

/// Reads the demand of all roads; traces that several roads share are read once.
pub(super) struct DemandReader<'a> {
    pub(super) base: TraceBase,
    pub(super) seed: u64,
    pub(super) roads: Vec<&'a str>,
    /// The routes of each road.
    pub(super) routes: Vec<Vec<Route>>,
    pub(super) vehicle: VehicleParams,
    pub(super) traces: BTreeMap<String, Rc<Vec<(u32, Arrival)>>>,
}

impl DemandReader<'_> {
    /// `roads.*.demand`.
    pub(super) fn read(&mut self, road: u32, table: &Table<'_>) -> Result<Demand, ScenarioError> {
        const EXPECTED: &str =
            "a table with trace = \"FILE.csv\", or with rates and the other keys of random arrivals";
        const OTHER_SEEDS: &str = "trace and rates, where trace_seeds lists the seeds that have a trace";
        let random = keys::names(keys::RANDOM);
        let mut t = table.need("demand", EXPECTED)?.table(EXPECTED)?;
        t.only(&[&keys::names(keys::TRACE)[..], &random].concat())?;
        if let Some(seeds) = t.get("trace_seeds") {
            let (trace, rates) = (t.need("trace", OTHER_SEEDS)?, t.need("rates", OTHER_SEEDS)?);
            let random_is_set = random.iter().any(|key| t.get(key).is_some_and(|field| field.is_set()));
            // Whoever sets one of the two by hand means that one, whatever the seed.
            let takes_trace = match (trace.is_set(), random_is_set) {
                (true, false) if !seeds.is_set() => true,
                (false, true) if !seeds.is_set() => false,
                _ => lists(&seeds, self.seed)?,
            };
            if takes_trace {
                return self.trace(road, &trace);
            }
            t.blame(&rates);
            return self.poisson(&t, &rates);
        }
        match t.either("trace", "rates") {
            (None, None) => Err(t.missing("trace", "trace = \"FILE.csv\", or rates = [...]")),
            (Some(_), Some(rates)) => {
                Err(rates.bad_because(Some("trace is given as well".into()), "either trace or rates"))
            }
            (Some(trace), None) => {
                t.only_or_stale(&["trace"], if trace.is_set() { &random[..] } else { &[] })?;
                self.trace(road, &trace)
            }
            (None, Some(rates)) => {
                t.only_or_stale(&random, &["trace"])?;
                t.blame(&rates);
                self.poisson(&t, &rates)
            }
        }
    }

    fn poisson(&self, t: &Table<'_>, rates: &Field<'_>) -> Result<Demand, ScenarioError> {
        let min_headway_s = t.within("min_headway_s", &ranges::HEADWAY)?;
        const RATES: &str = "a list of {until_s = TIME, vehicles_per_hour = RATE}";
        let mut periods: Vec<RatePeriod> = Vec::new();
        for item in rates.items(RATES)? {
            let period = item.table(RATES)?;
            period.only(&["until_s", "vehicles_per_hour"])?;
            let start = periods.last().map_or(0.0, |p| p.until_s);
            let until_s = period.f64(
                "until_s",
                |end| end > start && end <= MAX_TIME_S,
                &format!("an instant > {start} s, the end of the period before, and <= {MAX_TIME_S:e} s"),
            )?;
            let expected = format!("a rate with 0 <= rate <= {MAX_RATE_PER_HOUR} veh/h");
            let rate = period.need("vehicles_per_hour", &expected)?;
            let vehicles_per_hour = rate.f64(|r| (0.0..=MAX_RATE_PER_HOUR).contains(&r), &expected)?;
            if vehicles_per_hour * min_headway_s >= 3600.0 {
                let problem = format!(
                    "the mean headway would be {:.3} s, within min_headway_s = {min_headway_s}",
                    3600.0 / vehicles_per_hour
                );
                let expected = format!("a rate < {:.1} veh/h", 3600.0 / min_headway_s);
                return Err(rate.bad_because(Some(problem), &expected));
            }
            periods.push(RatePeriod { until_s, vehicles_per_hour });
        }
        let VehicleParams { v_min_mps, v_max_mps, .. } = self.vehicle;
        let min_mps = t.f64(
            "speed_min_mps",
            |v| v >= v_min_mps && v <= v_max_mps,
            &format!("a speed within the vehicles' {v_min_mps} to {v_max_mps} m/s"),
        )?;
        let max_mps = t.f64(
            "speed_max_mps",
            |v| v >= min_mps && v <= v_max_mps,
            &format!("a speed from speed_min_mps = {min_mps} to v_max_mps = {v_max_mps} m/s"),
        )?;
        // With the mean inside and the spread no wider than the interval, at least a third of all draws are
        // accepted: redrawing always ends soon.
        let mean_mps = t.f64(
            "speed_mean_mps",
            |v| v >= min_mps && v <= max_mps,
            &format!("a speed from speed_min_mps = {min_mps} to speed_max_mps = {max_mps} m/s"),
        )?;
        let width = max_mps - min_mps;
        let sd_mps = t.f64(
            "speed_sd_mps",
            |sd| sd >= 0.0 && sd <= width,
            &format!("a speed from 0 to speed_max_mps - speed_min_mps = {width} m/s"),
        )?;
        let speed = SpeedDistribution { mean_mps, sd_mps, min_mps, max_mps };
        Ok(Demand::Poisson(Poisson { rates: periods, min_headway_s, speed }))
    }

    fn trace(&mut self, road: u32, field: &Field<'_>) -> Result<Demand, ScenarioError> {
        const EXPECTED: &str = "the path of a CSV file of arrivals";
        let path = field.str(EXPECTED)?.replace("{seed}", &self.seed.to_string());
        let rows = match self.traces.get(&path) {
            Some(rows) => Rc::clone(rows),
            None => {
                let (file, text) = self.open(&path, field)?;
                let rows = Rc::new(self.parse(&file, &text)?);
                self.traces.insert(path, Rc::clone(&rows));
                rows
            }
        };
        Ok(Demand::Trace(rows.iter().filter(|(r, _)| *r == road).map(|(_, arrival)| *arrival).collect()))
    }

    /// Name for messages and contents of a trace.
    fn open(&self, path: &str, field: &Field<'_>) -> Result<(String, Vec<u8>), ScenarioError> {
        if let Some(text) = crate::scenario::embedded::trace(path) {
            return Ok((format!("<embedded>/{path}"), text.as_bytes().to_vec()));
        }
        let file = match &self.base {
            TraceBase::Directory(directory) => directory.join(path),
            TraceBase::Embedded => PathBuf::from(path),
            TraceBase::Given(traces) => {
                let given = traces.iter().find(|(name, _)| name == path);
                let missing =
                    || field.bad_because(Some("not given".into()), "an arrival trace that is given");
                return given.map(|(name, bytes)| (name.clone(), bytes.clone())).ok_or_else(missing);
            }
        };
        match std::fs::read(&file) {
            Ok(bytes) => Ok((file.display().to_string(), bytes)),
            Err(error) => {
                let problem = format!("cannot read {}: {error}", file.display());
                let mut expected = "an arrival trace".to_owned();
                if field.found().contains("{seed}") {
                    expected += &format!(" for seed {}", self.seed);
                }
                if matches!(self.base, TraceBase::Embedded) {
                    expected += ": a file, or one of the embedded ";
                    expected += crate::scenario::embedded::trace_names!();
                }
                Err(field.bad_because(Some(problem), &expected))
            }
        }
    }

    /// The rows of a trace with the index of their road.
    fn parse(&self, file: &str, bytes: &[u8]) -> Result<Vec<(u32, Arrival)>, ScenarioError> {
        let place = |line| Place::Line { file: file.to_owned(), line };
        let bad = |place, found: String, expected: &str| ScenarioError::Trace {
            place,
            found: found.into(),
            expected: expected.into(),
        };
        let mut reader = csv::ReaderBuilder::new().has_headers(false).flexible(true).from_reader(bytes);
        let mut record = csv::StringRecord::new();
        let mut rows: Vec<(u32, Arrival)> = Vec::new();
        let mut columns = 0;
        loop {
            let more = reader.read_record(&mut record).map_err(|error| {
                let line = line_of(bytes, error.position());
                bad(place(line), error.to_string(), &format!("text in UTF-8 with the columns {HEADER}"))
            })?;
            if !more {
                break;
            }
            let place = place(line_of(bytes, record.position()));
            let found = record.iter().collect::<Vec<_>>().join(",");
            if columns == 0 {
                columns = match found.as_str() {
                    HEADER => 3,
                    HEADER_WITH_ROUTES => 4,
                    _ => return Err(bad(place, format!("{found:?}"), &format!("the header {HEADER}"))),
                };
                continue;
            }
            if record.len() != columns {
                let expected = match columns {
                    3 => format!("three columns, {HEADER}"),
                    _ => format!("four columns, {HEADER_WITH_ROUTES}"),
                };
                return Err(bad(place, format!("{found:?}"), &expected));
            }
            let fields = [0, 1, 2, 3].map(|i| record.get(i).unwrap_or(""));
            rows.push(self.row(place, fields, rows.last().map(|(_, a)| a.time_s))?);
        }
        if columns > 0 {
            Ok(rows)
        } else {
            Err(bad(place(1), "an empty file".to_owned(), &format!("the header {HEADER}")))
        }
    }

    fn row(
        &self,
        place: Place,
        [time, road, speed, route]: [&str; 4],
        previous_s: Option<f64>,
    ) -> Result<(u32, Arrival), ScenarioError> {
        let bad = |key: &str, found: &str, problem: Option<&str>, expected: String| {
            Err(ScenarioError::BadValue {
                place: place.clone(),
                key: key.into(),
                found: format!("{found:?}").into(),
                problem: problem.map(Into::into),
                expected: expected.into(),
            })
        };
        let time_s = match time.trim().parse::<f64>() {
            Ok(t) if (0.0..=MAX_TIME_S).contains(&t) => t,
            _ => return bad("time_s", time, None, format!("an instant from 0 to {MAX_TIME_S:e} s")),
        };
        if let Some(previous) = previous_s.filter(|p| time_s < *p) {
            let expected = format!("an instant >= {previous} s, that of the row before");
            return bad("time_s", time, Some("out of order"), expected);
        }
        let Some(index) = self.roads.iter().position(|name| *name == road.trim()) else {
            let hint = nearest(road, self.roads.iter().copied());
            let hint = hint.map(|h| format!("; did you mean {h}?")).unwrap_or_default();
            let expected = format!("one of {}{hint}", self.roads.join(", "));
            return bad("road", road, Some("unknown road"), expected);
        };
        let routes = &self.routes[index];
        let route = match route.trim() {
            "" => None,
            name => match routes.iter().position(|route| route.name == name) {
                Some(at) => Some(at as u32),
                None => {
                    let known: Vec<&str> = routes.iter().map(|route| route.name.as_str()).collect();
                    let expected = format!("nothing, or a route of the road: {}", known.join(", "));
                    return bad("route", name, Some("unknown route"), expected);
                }
            },
        };
        let VehicleParams { v_min_mps, v_max_mps, .. } = self.vehicle;
        match speed.trim().parse::<f64>() {
            Ok(speed_mps) if (v_min_mps..=v_max_mps).contains(&speed_mps) => {
                Ok((index as u32, Arrival { time_s, speed_mps, route }))
            }
            _ => {
                let expected = format!("a speed within the vehicles' {v_min_mps} to {v_max_mps} m/s");
                bad("speed_mps", speed, None, expected)
            }
        }
    }
}

/// Whether a list of seeds has this one.
fn lists(seeds: &Field<'_>, seed: u64) -> Result<bool, ScenarioError> {
    const SEEDS: &str = "a list of seeds, integers from 0 to 2^64 - 1";
    let mut is_listed = false;
    for item in seeds.items(SEEDS)? {
        is_listed |= item.integer::<u64>(0, SEEDS)? == seed;
    }
    Ok(is_listed)
}

/// Line, from 1, of the record at a position. The csv crate's position is before the blank lines it skips.
fn line_of(bytes: &[u8], position: Option<&csv::Position>) -> u64 {
    let Some(position) = position else { return 1 };
    let rest = usize::try_from(position.byte()).ok().and_then(|start| bytes.get(start..)).unwrap_or_default();
    let blank = rest.iter().take_while(|b| matches!(b, b'\r' | b'\n'));
    position.line() + blank.filter(|b| **b == b'\n').count() as u64
}
