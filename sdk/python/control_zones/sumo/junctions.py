"""Junctions of somebody's SUMO network as control zones."""

from __future__ import annotations

import os
import sys
import typing
import xml.etree.ElementTree as ElementTree

import libsumo

from .._session import Error
from ..world import GONE, Newcomer, Traffic
from .importing import with_conflicts
from .network import Zone, too_short, word, zone_of
from .scenario import Kind, text
from .simulation import Simulation, is_automated, read_net

if typing.TYPE_CHECKING:
    import argparse
    from collections.abc import Iterable, Sequence


class Place(typing.NamedTuple):
    """A lane of a zone: where it is on which of its paths."""

    zone: int
    #: Paths over the lane, each with the distance of the lane's beginning from the zone's origin, m.
    paths: tuple[tuple[int, float], ...]


class Member:
    """A vehicle in a zone."""

    __slots__ = ("lane", "name", "number", "path", "x_m", "zone")

    def __init__(self, name: str, number: int, zone: int, path: int, x_m: float) -> None:
        self.name, self.number, self.zone, self.path, self.x_m = name, number, zone, path, x_m


class JunctionTraffic(Traffic):
    """SUMO brings vehicles to junctions and moves them; those that are automated are driven there."""

    name = "sumo"
    brings = True

    def __init__(
        self, zones: Sequence[Zone], kinds: dict[str, int], simulation: Simulation, automated: typing.Callable[[str, str], bool]
    ) -> None:
        self.zones, self.kinds, self.simulation, self.automated = zones, kinds, simulation, automated
        self.lanes: dict[str, Place] = {}
        for index, zone in enumerate(zones):
            over: dict[str, list[tuple[int, float]]] = {}
            for number, path in enumerate(zone.paths):
                for lane, at_m in path.lanes[:-1]:
                    over.setdefault(lane, []).append((number, at_m))
            self.lanes.update({lane: Place(index, tuple(paths)) for lane, paths in over.items()})
        #: By name, those in zones; by number, the names of all who are still asked about.
        self.members: dict[str, Member] = {}
        self.names: dict[int, str] = {}
        self.count = 0
        self.is_automated: dict[str, bool] = {}

    def step(self, step: int, tasks: Sequence[tuple[float, int, int]]) -> tuple[Iterable[float], Sequence[Newcomer], bool]:
        """One step of SUMO."""
        simulation, names, members = self.simulation, self.names, self.members
        for u_mps2, number, is_held in tasks:
            name = names.get(number)
            if name is None:
                continue
            member = members.get(name)
            if is_held:
                simulation.hold(name, u_mps2)
            elif member is None or member.number == number:
                simulation.release(name)
        simulation.step()
        moved = {name: simulation.moved(name) for name in {names[number] for _, number, _ in tasks if number in names}}
        asked = {number for _, number, _ in tasks}
        here = self.look()
        did: list[float] = []
        for _, number, _ in tasks:
            name = names.get(number)
            came = moved[name] if name is not None else None
            member = members.get(name) if name is not None else None
            if name is None or came is None:
                did.extend(GONE)
                names.pop(number, None)
                if member is not None and member.number == number:
                    del members[member.name]
                continue
            if member is not None and member.number == number:
                member.x_m += came[0]
                zone = self.zones[member.zone]
                if member.x_m >= zone.paths[member.path].length_m:
                    del members[name]  # It has left the zone, and is followed as long as it matters there.
                elif name not in here or not self.is_where(member, here[name]):
                    del members[name]
                    names.pop(number)
                    did.extend(GONE)
                    continue
            did.extend(came)
        for number in [number for number, name in names.items() if number not in asked and not self.is_member(number, name)]:
            del names[number]
        newcomers = self.newcomers(here)
        return did, newcomers, libsumo.simulation.getMinExpectedNumber() > 0

    def is_member(self, number: int, name: str) -> bool:
        """Whether a number is that of one in a zone now."""
        member = self.members.get(name)
        return member is not None and member.number == number

    def look(self) -> dict[str, str]:
        """Who is on the zones' lanes."""
        found: dict[str, str] = {}
        vehicles_on = libsumo.lane.getLastStepVehicleIDs
        for lane in self.lanes:
            for name in vehicles_on(lane):
                found[name] = lane
        return found

    def is_where(self, member: Member, lane: str) -> bool:
        """Whether one is on a lane of its path still."""
        place = self.lanes[lane]
        return place.zone == member.zone and any(path == member.path for path, _ in place.paths)

    def newcomers(self, here: dict[str, str]) -> list[Newcomer]:
        """Those on a zone's lanes who were not in it."""
        found = []
        for name, lane in here.items():
            if name in self.members:
                continue
            place = self.lanes[lane]
            chosen = self.choose(name, lane, place)
            if chosen is None:
                continue
            (path, begins_m), is_right = chosen
            x_m = begins_m + libsumo.vehicle.getLanePosition(name)
            zone = self.zones[place.zone]
            if not 0.0 <= x_m < zone.paths[path].length_m:
                continue
            kind = libsumo.vehicle.getTypeID(name)
            if name not in self.is_automated:
                self.is_automated[name] = self.automated(name, kind)
            is_commanded = is_right and self.is_automated[name]
            self.simulation.see(name)
            if not is_commanded:
                self.simulation.release(name)
            self.members[name] = Member(name, self.count, place.zone, path, x_m)
            self.names[self.count] = name
            self.count += 1
            v_mps = self.simulation.last[name][1]
            found.append(Newcomer(x_m, v_mps, place.zone, path, kind=self.kind(kind), is_commanded=int(is_commanded)))
        return found

    def kind(self, name: str) -> int:
        """The index of a vehicle type; types that come later are as the first."""
        return self.kinds.get(name.split("@")[0], 0)

    def choose(self, name: str, lane: str, place: Place) -> tuple[tuple[int, float], bool] | None:
        """The path a vehicle takes from a lane, and whether it leads where its route does."""
        if len(place.paths) == 1 and lane.startswith(":"):
            return place.paths[0], True
        route, at = libsumo.vehicle.getRoute(name), libsumo.vehicle.getRouteIndex(name)
        onward = route[at + 1] if at + 1 < len(route) else None
        paths = self.zones[place.zone].paths
        for path, begins_m in place.paths:
            if onward is not None and paths[path].lanes[-1][0].rsplit("_", 1)[0] == onward:
                return (path, begins_m), True
        # It is to change lanes first, or its way ends here.
        return place.paths[0], False


def prepare(args: argparse.Namespace, folder: str) -> tuple[Traffic, Simulation, list[str]]:
    """Starts SUMO with a configuration, and makes a scenario of its junctions."""
    try:
        root = ElementTree.parse(args.config).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise Error(f"{args.config}: cannot be read: {error}") from error
    named = root.find(".//net-file")
    if named is None:
        raise Error(f"{args.config}: has no net-file, expected a SUMO configuration")
    net = read_net(os.path.join(os.path.dirname(os.path.abspath(args.config)), named.get("value") or named.get("v") or ""))
    seed = 1 if args.seed is None else args.seed
    simulation = Simulation(["-c", args.config, *args.sumo], args.step_length, seed)
    ids = suitable(net, args.zone)
    zones = [zone_of(net, junction, args.approach) for junction in ids]
    limits = [
        float(net.getLane(path.lanes[0][0]).getSpeed()) for zone in zones for path in zone.paths
    ]
    kinds, index = fleet()
    unknown = [name for name in args.cav if name not in index]
    if unknown:
        raise Error(f"--cav: there is no vehicle type {unknown[0]}, expected one of {', '.join(sorted(index))}")
    ended = root.find(".//end")
    end_s = args.end or (float(ended.get("value") or ended.get("v") or 0.0) if ended is not None else 0.0)
    if end_s <= 0.0:
        end_s = 3600.0
    written = text(
        "sumo",
        zones,
        kinds,
        seed=seed,
        dt_s=args.step_length,
        end_s=end_s,
        v_max_mps=min(limits),
        about=f"Junctions of {os.path.basename(args.config)}, made by `cz sumo run`: SUMO brings the vehicles, whatever the roads say.",
    )
    path = args.scenario_out or os.path.join(folder, "sumo.toml")
    with open(path, "w") as file:
        file.write(written)

    def automated(name: str, kind: str) -> bool:
        return (not args.cav or kind in args.cav) and is_automated(seed, name, args.penetration)

    traffic = JunctionTraffic(zones, index, simulation, automated)
    return traffic, simulation, ["run", path, "--in-process", *(f"--set={one}" for one in args.set)]


def suitable(net: typing.Any, named: list[str]) -> list[str]:
    """The junctions that become zones: those that are named, or all that can.

    Raises `Error` when one that is named cannot, or none can.
    """
    reasons = {junction: too_short(net, junction) for junction in named or with_conflicts(net) if net.hasNode(junction)}
    bad = [reason for reason in reasons.values() if reason]
    if bad and (named or len(bad) == len(reasons)):
        raise Error(f"--zone: {bad[0]}: vehicles could not stop between junctions")
    for reason in bad:
        print(f"cz sumo: left to SUMO: {reason}", file=sys.stderr)
    return [junction for junction in named or reasons if reasons.get(junction) is None]


def fleet() -> tuple[list[Kind], dict[str, int]]:
    """Kinds for the vehicle types that SUMO knows; types alike in what matters here are one kind."""
    kinds: list[Kind] = []
    index: dict[str, int] = {}
    types = libsumo.vehicletype
    for name in sorted(types.getIDList(), key=lambda name: (name != "DEFAULT_VEHTYPE", name)):
        kind = Kind(word(name), types.getLength(name), -types.getDecel(name), types.getAccel(name))
        if types.getVehicleClass(name) not in ("passenger", "truck", "bus", "delivery", "trailer", "private", "taxi"):
            continue
        same = next((at for at, known in enumerate(kinds) if known[1:] == kind[1:]), None)
        if same is None:
            same = len(kinds)
            kinds.append(kind)
        index[name] = same
    return kinds, index


__all__ = ["JunctionTraffic", "prepare"]
