//! The network: an acyclic graph of merging zones.

use super::demand::Demand;
use super::params::FlowPolicy;
use serde::{Deserialize, Serialize};

/// Index of a zone in [`Network::zones`]. Zones are in topological order: upstream first.
pub type ZoneId = u32;

/// All zones and entry roads.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Network {
    /// Zones, upstream before downstream, otherwise as declared.
    pub zones: Vec<Zone>,
    /// Entry roads as declared; the order breaks ties between simultaneous arrivals.
    pub roads: Vec<Road>,
}

/// One control zone: approaches that end in a common conflict point, and one exit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Zone {
    /// Unique name.
    pub name: String,
    /// Paths into the conflict point, at least one.
    pub approaches: Vec<Approach>,
    /// Where the zone's exit leads.
    pub exit: Exit,
    /// How the zone's coordinator sets the terminal speed.
    pub flow: FlowPolicy,
}

/// One path through a zone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Approach {
    /// Name, unique within the zone.
    pub name: String,
    /// Distance from the zone's origin on this path to the conflict point, m (paper: L).
    pub length_m: f64,
    /// Where its vehicles come from.
    pub source: Source,
}

/// Where the vehicles of an approach come from.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Source {
    /// An entry road: index in [`Network::roads`].
    Road(u32),
    /// The exit of an upstream zone.
    Zone(ZoneId),
}

/// Where a zone's exit leads.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Exit {
    /// Out of the network.
    Out,
    /// To an approach of a zone further down, over a plain link of the given length (0: directly).
    Zone {
        /// Downstream zone.
        zone: ZoneId,
        /// Approach of that zone.
        path: u32,
        /// Length of the uncontrolled link in between, m.
        link_m: f64,
        /// Speed driven on that link where nobody is in the way, m/s; without meaning when there is none.
        link_speed_mps: f64,
    },
}

/// An entry road.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Road {
    /// Unique name; arrival traces use it.
    pub name: String,
    /// Zone the road leads to.
    pub zone: ZoneId,
    /// Approach of that zone.
    pub path: u32,
    /// Who arrives when.
    pub demand: Demand,
}

impl Network {
    /// The downstream neighbour of a zone, if its exit leads to one.
    pub fn downstream(&self, zone: ZoneId) -> Option<ZoneId> {
        match self.zones[zone as usize].exit {
            Exit::Out => None,
            Exit::Zone { zone, .. } => Some(zone),
        }
    }

    /// The upstream neighbours of a zone, in order of approach.
    pub fn upstream(&self, zone: ZoneId) -> impl Iterator<Item = ZoneId> + '_ {
        self.zones[zone as usize].approaches.iter().filter_map(|a| match a.source {
            Source::Zone(z) => Some(z),
            Source::Road(_) => None,
        })
    }

    /// All neighbours of a zone: upstream ones, then the downstream one.
    pub fn neighbours(&self, zone: ZoneId) -> impl Iterator<Item = ZoneId> + '_ {
        self.upstream(zone).chain(self.downstream(zone))
    }
}
