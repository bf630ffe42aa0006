//! SUMO's floating car data: every vehicle at every step.

use crate::out::OutError;
use crate::walk::Moment;
use crate::xml::{Document, number, seconds};
use control_zones::scenario::Scenario;
use control_zones::scenario::layout::{Lane, Layout, Pose};
use ipc_schemas::VehicleState;
use std::path::Path;

/// A file of floating car data being written.
pub struct Fcd<'a> {
    document: Document,
    places: Places<'a>,
}

/// Where vehicles are, in SUMO's terms.
#[derive(Debug)]
pub(crate) struct Places<'a> {
    pub scenario: &'a Scenario,
    pub layout: Layout,
    /// By link.
    links: Vec<String>,
}

impl<'a> Places<'a> {
    pub fn of(scenario: &'a Scenario) -> Places<'a> {
        let links = scenario.network.zones.iter().flat_map(|zone| {
            let exits = zone.exits.iter().filter(|exit| exit.to.is_some_and(|to| to.link_m > 0.0));
            exits.map(|exit| format!("{}.{}_link", zone.name, exit.name))
        });
        Places { scenario, layout: Layout::of(&scenario.network), links: links.collect() }
    }

    /// A lane's name, of which the part before the last `_` is SUMO's edge: zone and segment, or zone, exit and `link`.
    pub fn lane_name(&self, lane: Lane) -> String {
        match lane {
            Lane::Link(link) => self.links[link as usize].clone(),
            Lane::Segment { zone, segment } => {
                let zone = &self.scenario.network.zones[zone as usize];
                format!("{}_{}", zone.name, zone.segments[segment as usize].name)
            }
        }
    }

    /// The name of a vehicle's kind; a recording may hold one that the scenario does not have.
    pub fn kind_name(&self, kind: u16) -> String {
        let kinds = &self.scenario.fleet;
        kinds.get(usize::from(kind)).map_or_else(|| format!("kind {kind}"), |kind| kind.name.clone())
    }
}

/// SUMO's direction: degrees clockwise from north.
pub(crate) fn angle_deg(pose: &Pose) -> f64 {
    (90.0 - pose.heading_rad.to_degrees()).rem_euclid(360.0)
}

/// Whether a record is of a vehicle where it is, not where it has left.
pub(crate) fn is_present(state: &VehicleState) -> bool {
    !state.has_left()
}

impl<'a> Fcd<'a> {
    /// Begins a file.
    pub fn begin(path: &Path, scenario: &'a Scenario) -> Result<Fcd<'a>, OutError> {
        let document = Document::begin(path, "fcd-export", "fcd_file.xsd")?;
        Ok(Fcd { document, places: Places::of(scenario) })
    }

    /// Writes a step.
    pub fn step(&mut self, moment: &Moment<'_>) -> Result<(), OutError> {
        self.document.start("timestep", &[("time", &seconds(moment.step.header.time_ns))])?;
        for state in moment.step.state.iter().filter(|state| is_present(state)) {
            let Some(on) = self.places.layout.lane_of(state) else { continue };
            let pose = self.places.layout.pose(on);
            self.document.empty(
                "vehicle",
                &[
                    ("id", &state.vehicle.to_string()),
                    ("x", &number(pose.place.0)),
                    ("y", &number(pose.place.1)),
                    ("angle", &number(angle_deg(&pose))),
                    ("type", &self.places.kind_name(state.kind)),
                    ("speed", &number(state.v_mps)),
                    ("pos", &number(on.at_m)),
                    ("lane", &self.places.lane_name(on.lane)),
                    ("acceleration", &number(state.u_mps2)),
                ],
            )?;
        }
        self.document.end("timestep")
    }

    /// Ends the file.
    pub fn finish(self) -> Result<(), OutError> {
        self.document.finish()
    }
}
