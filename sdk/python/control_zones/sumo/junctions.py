"""Junctions of somebody's SUMO network as control zones."""

from __future__ import annotations

import math
import os
import sys
import typing
import xml.etree.ElementTree as ElementTree

import libsumo

from .._session import Error
from ..world import GONE, Newcomer, Traffic
from .importing import limit, slow, with_conflicts
from .network import Zone, members, stopping_m, too_short, word, zone_of
from .scenario import Kind, text
from .simulation import Car, Simulation, is_automated, read_net

if typing.TYPE_CHECKING:
    import argparse
    from collections.abc import Iterable, Sequence


#: SUMO's vehicle classes that drive as cars do, and those that are no traffic of roads.
CARS = ("passenger", "private", "taxi", "hov", "evehicle", "delivery", "truck", "trailer", "bus", "coach", "emergency", "authority", "army", "vip", "custom1", "custom2")
NOT_ON_ROADS = ("pedestrian", "rail", "rail_electric", "rail_fast", "subway", "ship", "container", "cable_car", "aircraft")


class Place(typing.NamedTuple):
    """A lane of a zone: where it is on which of its paths."""

    zone: int
    #: Paths over the lane, each with the distance of the lane's beginning from the zone's origin, m, and the roads that
    #: follow on it.
    paths: tuple[tuple[int, float, tuple[str, ...]], ...]


class Exit(typing.NamedTuple):
    """A lane out of a zone, and one of the paths that lead to it."""

    zone: int
    path: int


class JunctionTraffic(Traffic):
    """SUMO brings vehicles to junctions and moves them; those that are automated are driven there."""

    name = "sumo"
    brings = True

    def __init__(
        self,
        zones: Sequence[Zone],
        kinds: dict[str, int],
        simulation: Simulation,
        automated: typing.Callable[[str, str], bool],
        v_max_mps: float,
    ) -> None:
        self.zones, self.kinds, self.simulation, self.automated = zones, kinds, simulation, automated
        self.lanes: dict[str, Place] = {}
        self.exits: dict[str, list[Exit]] = {}
        #: For so many metres behind an exit those that leave must see who is there.
        self.near_m = stopping_m(v_max_mps)
        for index, zone in enumerate(zones):
            out = {path.lanes[-1][0]: number for number, path in enumerate(zone.paths)}
            for lane, number in out.items():
                self.exits.setdefault(lane, []).append(Exit(index, number))
            over: dict[str, list[tuple[int, float, tuple[str, ...]]]] = {}
            for number, path in enumerate(zone.paths):
                for at, (lane, at_m) in enumerate(path.lanes[:-1]):
                    onward = tuple(name.rsplit("_", 1)[0] for name, _ in path.lanes[at + 1 :] if not name.startswith(":"))
                    over.setdefault(lane, []).append((number, at_m, onward))
            self.lanes.update({lane: Place(index, tuple(paths)) for lane, paths in over.items()})
        self.rank = {lane: rank for rank, lane in enumerate(self.lanes)}
        #: By number, those who are asked about; in those of `left`, who are in that zone no more.
        self.cars: dict[int, Car] = {}
        self.left: set[int] = set()
        #: By name, those who are in the network and in no zone.
        self.outside: dict[str, Car] = {}
        #: Lanes out of zones on which somebody else may be the next to those that leave by them.
        self.unsure: set[str] = set()
        self.count = 0
        self.is_automated: dict[str, bool] = {}

    def step(self, step: int, tasks: Sequence[tuple[float, int, int]]) -> tuple[Iterable[float], Sequence[Newcomer], bool]:
        """One step of SUMO."""
        simulation, cars, outside = self.simulation, self.cars, self.outside
        hold, moves = simulation.hold, simulation.moves
        for u_mps2, number, is_held in tasks:
            car = cars.get(number)
            if car is None:
                continue
            if is_held:
                hold(car, u_mps2)
            elif car.number in (number, -1):
                simulation.release(car)
        simulation.step()
        for name in simulation.gone:
            outside.pop(name, None)
        for name in simulation.came:
            outside[name] = Car(name)
        if self.left:
            asked = {number for _, number, _ in tasks}
            for number in [number for number in self.left if number not in asked]:
                self.left.discard(number)
                if (car := cars.pop(number, None)) is not None:
                    car.beyond = ""
        did: list[float] = []
        for _, number, is_held in tasks:
            car = cars.get(number)
            if car is None or not moves(car):
                did.extend(GONE)
                if car is not None:
                    car.number = -1
                    del cars[number]
                    self.unsure.add(car.lane)
                continue
            if car.number == number:
                car.x_m += car.advanced_m
                if car.x_m >= car.length_m:
                    car.lane = car.beyond = self.zones[car.zone].paths[car.path].lanes[-1][0]
                    self.leave(car)  # It is followed as long as it matters there.
                elif not is_held and not self.is_where(car):
                    # One that is held changes no lanes.
                    self.leave(car)
                    del cars[number]
                    did.extend(GONE)
                    continue
            did += (car.advanced_m, car.v_mps)
        return did, self.newcomers(), libsumo.simulation.getMinExpectedNumber() > 0

    def leave(self, car: Car) -> None:
        """Counts one among those outside."""
        self.left.add(car.number)
        car.number = -1
        self.outside[car.name] = car

    def is_where(self, car: Car) -> bool:
        """Whether one is on a lane of its path still, and not parked beside it."""
        if car.v_mps == 0.0 and libsumo.vehicle.isStoppedParking(car.name):
            return False
        place = self.lanes.get(libsumo.vehicle.getLaneID(car.name))
        return place is not None and place.zone == car.zone and any(path == car.path for path, *_ in place.paths)

    def newcomers(self) -> list[Newcomer]:
        """Those outside who are on a zone's lanes now: lane by lane, and from the back on each; and those who have come behind
        a zone's exit otherwise than through it."""
        found = []
        lane_of, position_of = libsumo.vehicle.getLaneID, libsumo.vehicle.getLanePosition
        for name, car in self.outside.items():
            lane = lane_of(name)
            if lane != car.lane:
                # One that has left a lane hides nobody there any more.
                self.unsure.update((car.lane, lane))
                car.lane, car.beyond = lane, ""
            place = self.lanes.get(lane)
            if place is None:
                continue
            at_m = position_of(name)
            # All ways over a lane begin it at the same place, or it is one within the junction.
            if place.paths[0][1] + at_m >= 0.0:
                found.append((self.rank[lane], at_m, lane, car))
        found.sort(key=lambda one: one[:2])
        behind = self.behind_exits() if self.unsure else []
        return behind + [newcomer for _, at_m, lane, car in found if (newcomer := self.let_in(car, lane, at_m)) is not None]

    def behind_exits(self) -> list[Newcomer]:
        """Of lanes out of zones on which somebody may have come without having been in the zone, or was hidden by one that is
        gone: who is the next there."""
        known = {car.name: car for car in (*self.cars.values(), *self.outside.values())}
        found = []
        position_of = libsumo.vehicle.getLanePosition
        for lane in sorted(self.unsure & self.exits.keys()):
            on_it = libsumo.lane.getLastStepVehicleIDs(lane)
            if not on_it:
                continue
            name = min(on_it, key=position_of)
            car, at_m = known.get(name), position_of(name)
            if car is None:
                # It was there before the first step.
                car = self.outside[name] = Car(name)
            if car.beyond == lane or (car.number >= 0 and self.zones[car.zone].paths[car.path].lanes[-1][0] == lane):
                continue
            car.lane = car.beyond = lane
            self.simulation.see(car)
            if at_m >= self.near_m:
                continue
            kind = self.kind(libsumo.vehicle.getTypeID(name))
            for zone, path in self.exits[lane]:
                self.left.add(self.count)
                self.cars[self.count] = car
                self.count += 1
                x_m = self.zones[zone].paths[path].length_m + at_m
                found.append(Newcomer(x_m, car.v_mps, zone, path, kind=kind, is_commanded=0))
        self.unsure.clear()
        return found

    def let_in(self, car: Car, lane: str, at_m: float) -> Newcomer | None:
        """Makes one a member of the zone whose lane it is on, unless it has as good as left that."""
        name, place = car.name, self.lanes[lane]
        path, begins_m, is_right = self.choose(name, place)
        x_m, length_m = begins_m + at_m, self.zones[place.zone].paths[path].length_m
        if not 0.0 <= x_m < length_m or libsumo.vehicle.isStoppedParking(name):
            return None
        kind = libsumo.vehicle.getTypeID(name)
        if name not in self.is_automated:
            self.is_automated[name] = self.automated(name, kind)
        is_commanded = is_right and self.is_automated[name] and not self.stops(name, place.zone, path)
        self.simulation.see(car)
        if not is_commanded:
            self.simulation.release(car)
        car.number, car.zone, car.path, car.length_m, car.x_m = self.count, place.zone, path, length_m, x_m
        self.cars[self.count] = car
        del self.outside[name]
        self.count += 1
        return Newcomer(x_m, car.v_mps, place.zone, path, kind=self.kind(kind), is_commanded=int(is_commanded))

    def stops(self, name: str, zone: int, path: int) -> bool:
        """Whether one is to stop on its way through a zone: then it drives by itself."""
        stop = libsumo.vehicle.getStops(name, 1)
        return bool(stop) and any(stop[0].lane == lane for lane, _ in self.zones[zone].paths[path].lanes)

    def kind(self, name: str) -> int:
        """The index of a vehicle type; types that come later are as the first."""
        return self.kinds.get(name.split("@")[0], 0)

    def choose(self, name: str, place: Place) -> tuple[int, float, bool]:
        """The path a vehicle takes from a lane, where that begins on it, and whether it leads where its route does."""
        ahead = libsumo.vehicle.getRoute(name)[libsumo.vehicle.getRouteIndex(name) + 1 :]
        for path, begins_m, onward in place.paths:
            if ahead[: len(onward)] == onward:
                return path, begins_m, True
        # It is to change lanes first, or its way ends here.
        path, begins_m, _ = place.paths[0]
        return path, begins_m, False


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
    if args.end is not None and not 0.0 < args.end < math.inf:
        raise Error(f"--end is {args.end}, expected seconds above 0")
    simulation = Simulation(["-c", args.config, *args.sumo], args.step_length, seed)
    if float(libsumo.simulation.getOption("lateral-resolution") or 0.0) > 0.0:
        raise Error(f"{args.config}: lateral-resolution is set, expected vehicles in the middle of their lanes")
    ids = suitable(net, args.zone)
    zones = [zone_of(net, junction, args.approach) for junction in ids]
    v_max_mps = limit(net, zones)
    if not stopping_m(v_max_mps) <= args.approach < math.inf:
        raise Error(f"--approach is {args.approach}, expected at least {stopping_m(v_max_mps):.1f} m, on which vehicles stop from {v_max_mps:.1f} m/s")
    kinds, index = fleet(v_max_mps)
    if (told := slow(net, zones)) is not None:
        print(f"cz sumo: {told}", file=sys.stderr)
    if args.lights == "off" and args.penetration > 0.0:
        switch_off(zones)
    unknown = [name for name in args.cav if name not in index]
    if unknown:
        raise Error(f"--cav: there is no vehicle type {unknown[0]}, expected one of {', '.join(sorted(index))}")
    span_s = libsumo.simulation.getEndTime() - libsumo.simulation.getTime()
    end_s = args.end or (span_s if span_s > 0.0 else 3600.0)
    written = text(
        "sumo",
        zones,
        kinds,
        seed=seed,
        dt_s=args.step_length,
        end_s=end_s,
        v_max_mps=v_max_mps,
        about=f"Junctions of {os.path.basename(args.config)}, made by `cz sumo run`: SUMO brings the vehicles, whatever the roads say.",
    )
    path = args.scenario_out or os.path.join(folder, "sumo.toml")
    try:
        with open(path, "w") as file:
            file.write(written)
    except OSError as error:
        raise Error(f"--scenario-out {path}: {error.strerror}") from error

    def automated(name: str, kind: str) -> bool:
        return (kind in args.cav if args.cav else is_car(kind)) and is_automated(seed, name, args.penetration)

    traffic = JunctionTraffic(zones, index, simulation, automated, v_max_mps)
    return traffic, simulation, ["run", path, "--in-process", *(f"--set={one}" for one in args.set)]


def switch_off(zones: Sequence[Zone]) -> None:
    """Switches off the traffic lights of zones: in them it is the coordinator who says who goes first, and a driver who starts at green expects
    nobody from the side. SUMO's drivers then keep to the right of way that the network has without lights."""
    entrances = {path.lanes[0][0] for zone in zones for path in zone.paths}
    lights = libsumo.trafficlight
    for light in lights.getIDList():
        lanes = {lane for lane in lights.getControlledLanes(light) if not lane.startswith(":")}
        if lanes and lanes <= entrances:
            lights.setProgram(light, "off")
        elif lanes & entrances:
            others = ", ".join(sorted(lanes - entrances)[:3])
            print(f"cz sumo: traffic light {light} stays on, as it rules {others} too, of no zone: automated vehicles do not obey it", file=sys.stderr)


def suitable(net: typing.Any, named: list[str]) -> list[str]:
    """The junctions that become zones: those that are named, or all that can.

    Raises `Error` when one that is named cannot, or is so twice, or none can.
    """
    nodes = [node for junction in named for node in members(net, junction)]
    twice = next((node for node in nodes if nodes.count(node) > 1), None)
    if twice is not None:
        raise Error(f"--zone: junction {twice} is named twice, expected each in one zone")
    reasons = {junction: too_short(net, junction) for junction in named or with_conflicts(net)}
    bad = [reason for reason in reasons.values() if reason]
    if bad and named:
        raise Error(f"--zone: {bad[0]}: vehicles could not stop between junctions")
    if bad and len(bad) == len(reasons):
        raise Error(f"no junction of the network can be a zone: {bad[0]}, and likewise the others")
    for reason in bad:
        print(f"cz sumo: left to SUMO: {reason}", file=sys.stderr)
    return [junction for junction in named or reasons if reasons.get(junction) is None]


def is_car(kind: str) -> bool:
    """Whether vehicles of a type are automated where nobody says which are: those that drive as cars do."""
    return libsumo.vehicletype.getVehicleClass(kind) in CARS


def fleet(v_max_mps: float) -> tuple[list[Kind], dict[str, int]]:
    """Kinds for the vehicle types that SUMO knows; types alike in what matters here are one kind."""
    kinds: list[Kind] = []
    index: dict[str, int] = {}
    types = libsumo.vehicletype
    for name in sorted(types.getIDList(), key=lambda name: (name != "DEFAULT_VEHTYPE", name)):
        fastest_mps = min(types.getMaxSpeed(name), v_max_mps)
        kind = Kind(word(name), types.getLength(name), -types.getDecel(name), types.getAccel(name), fastest_mps)
        if types.getVehicleClass(name) in NOT_ON_ROADS:
            continue
        same = next((at for at, known in enumerate(kinds) if known[1:] == kind[1:]), None)
        if same is None:
            same = len(kinds)
            kinds.append(kind)
        index[name] = same
    return kinds, index


__all__ = ["JunctionTraffic", "prepare"]
