"""Zones from a SUMO network: its junctions, internal lanes and what comes together where."""

from __future__ import annotations

import math
import typing
from dataclasses import dataclass, field

from .._session import Error

if typing.TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

Place = tuple[float, float]

#: Bodies whose middles come nearer than this may touch: a vehicle's width and what is kept beside it, m.
NEAR_M = 2.2
#: What is reckoned with where it is asked whether vehicles have room to stop: m/s^2, s, m.
BRAKING_MPS2, REACTION_S, ROOM_M = 4.5, 1.2, 6.5
#: Distance between the places of a lane that are looked at, m.
SAMPLE_M = 0.5


@dataclass
class Segment:
    """A stretch of lane; `source` is a road, or the zone and exit it comes from."""

    name: str
    length_m: float
    shape: list[Place]
    road: str | None = None
    zone: tuple[str, str] | None = None
    link_m: float = 0.0


@dataclass
class Path:
    """A way over an incoming lane and internal lanes to an outgoing one."""

    name: str
    #: Entrance and, unless it is all there is, the lanes within the junction.
    segments: list[str]
    exit: str
    #: Lanes in order, with the distance from the zone's origin at which each begins; the last is the outgoing one.
    lanes: list[tuple[str, float]]
    length_m: float


@dataclass
class Crossing:
    """Where two segments are too near to each other."""

    name: str
    length_m: float
    at: dict[str, float]


@dataclass
class Zone:
    """A junction as a control zone."""

    name: str
    segments: list[Segment] = field(default_factory=list)
    paths: list[Path] = field(default_factory=list)
    crossings: list[Crossing] = field(default_factory=list)


def zone_of(net: typing.Any, junction: str, approach_m: float) -> Zone:
    """The zone of a junction, with so much of its incoming lanes at most.

    Raises `Error` when there is no such junction, or nothing for vehicles to drive on in it.
    """
    if not net.hasNode(junction):
        known = ", ".join(sorted(node.getID() for node in net.getNodes())[:20])
        raise Error(f"--zone: there is no junction {junction} in the network, expected one of {known}")
    zone = Zone(word(junction))
    inner: dict[str, list[Place]] = {}
    for edge in incoming(net, junction):
        for lane in edge.getLanes():
            add_lane(net, zone, lane, approach_m, inner)
    if not zone.paths:
        raise Error(f"--zone: vehicles cannot cross junction {junction}: no connection of it is for passenger cars")
    zone.crossings = crossings(zone, inner)
    return zone


def incoming(net: typing.Any, junction: str) -> list[typing.Any]:
    """The roads that lead to a junction, in order of their names."""
    edges = (edge for edge in net.getNode(junction).getIncoming() if edge.getFunction() == "")
    return sorted(edges, key=lambda edge: str(edge.getID()))


def too_short(net: typing.Any, junction: str) -> str | None:
    """What is wrong with a junction as a zone: a road on which vehicles cannot stop, and keep their distance, from one
    junction to the next; `None` when nothing is."""
    for edge in incoming(net, junction):
        for lane in edge.getLanes():
            v_mps = float(lane.getSpeed())
            needed_m = v_mps * v_mps / (2.0 * BRAKING_MPS2) + REACTION_S * v_mps + ROOM_M
            if lane.allows("passenger") and lane.getOutgoing() and float(lane.getLength()) < needed_m:
                return f"lane {lane.getID()} to junction {junction} is {lane.getLength():.1f} m long, expected {needed_m:.1f} at {v_mps:.1f} m/s"
    return None


def add_lane(net: typing.Any, zone: Zone, lane: typing.Any, approach_m: float, inner: dict[str, list[Place]]) -> None:
    """Adds an incoming lane, and the ways over the junction that begin on it."""
    entrance = word(lane.getID())
    length_m = float(lane.getLength())
    own_m = min(length_m, approach_m)
    seen: set[str] = set()
    for connection in lane.getOutgoing():
        to, via = connection.getToLane(), connection.getViaLaneID()
        if not (lane.allows("passenger") and to.allows("passenger")) or to.getID() in seen:
            continue
        seen.add(to.getID())
        lanes, at_m = [(lane.getID(), own_m - length_m)], own_m
        shape: list[Place] = []
        while via:
            inside = net.getLane(via)
            lanes.append((via, at_m))
            at_m += float(inside.getLength())
            shape += [place for place in inside.getShape() if not shape or place != shape[-1]]
            via = inside.getOutgoing()[0].getViaLaneID() if inside.getOutgoing() else ""
        lanes.append((to.getID(), at_m))
        name = f"{entrance[:30]}-{word(to.getID())[:30]}"
        segments = [entrance]
        if at_m > own_m:
            zone.segments.append(Segment(name, at_m - own_m, shape))
            inner[name] = shape
            segments.append(name)
        zone.paths.append(Path(name, segments, word(to.getID()), lanes, at_m))
    if seen:
        ends = cut(lane.getShape(), (length_m - own_m) / length_m)
        zone.segments.append(Segment(entrance, own_m, ends, road=f"{zone.name}-{entrance}"))


def crossings(zone: Zone, inner: dict[str, list[Place]]) -> list[Crossing]:
    """Where ways of different entrances are too near to each other.

    Ways to one exit merge at their ends, as scenarios have it; but bodies meet before that, so whoever waits is to wait
    before the two ways come together. Ways from one entrance part where it ends.
    """
    lengths = {segment.name: segment.length_m for segment in zone.segments}
    found: list[Crossing] = []
    ways = [path for path in zone.paths if len(path.segments) > 1]
    for index, one in enumerate(ways):
        for other in ways[index + 1 :]:
            if one.segments[0] == other.segments[0]:
                continue
            names = (one.segments[1], other.segments[1])
            parts = near(inner[names[0]], inner[names[1]])
            if parts is None:
                continue
            (from_m, to_m), (other_from_m, other_to_m) = parts
            # Shapes are a little longer or shorter than what SUMO says of their lanes.
            scale, other_scale = (lengths[name] / length(inner[name]) for name in names)
            area_m = max((to_m - from_m) * scale, (other_to_m - other_from_m) * other_scale, 0.1)
            at = {names[0]: from_m * scale, names[1]: other_from_m * other_scale}
            found.append(Crossing(f"c{len(found)}", area_m, at))
    return found


def near(one: Sequence[Place], other: Sequence[Place]) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """From where to where each of two lines is nearer to the other than bodies may be, m; `None` where they nowhere are."""
    parts = []
    for line, against in ((one, other), (other, one)):
        places = sampled(line)
        close = [at_m for at_m, place in places if distance(place, against) < NEAR_M]
        if not close:
            return None
        parts.append((close[0], close[-1]))
    return parts[0], parts[1]


def sampled(line: Sequence[Place]) -> list[tuple[float, Place]]:
    """Places along a line, with their distances from its beginning."""
    found: list[tuple[float, Place]] = []
    before_m = 0.0
    for start, end in zip(line, line[1:]):
        piece_m = math.dist(start, end)
        count = max(1, math.ceil(piece_m / SAMPLE_M))
        for index in range(count):
            t = index / count
            place = (start[0] + t * (end[0] - start[0]), start[1] + t * (end[1] - start[1]))
            found.append((before_m + t * piece_m, place))
        before_m += piece_m
    return [*found, (before_m, line[-1])]


def distance(place: Place, line: Sequence[Place]) -> float:
    """The least distance of a place from a line, m."""
    least = math.inf
    for (ax, ay), (bx, by) in zip(line, line[1:]):
        dx, dy = bx - ax, by - ay
        square = dx * dx + dy * dy
        t = 0.0 if square == 0.0 else max(0.0, min(1.0, ((place[0] - ax) * dx + (place[1] - ay) * dy) / square))
        least = min(least, math.dist(place, (ax + t * dx, ay + t * dy)))
    return least


def length(line: Sequence[Place]) -> float:
    """The length of a line, m."""
    return sum(math.dist(start, end) for start, end in zip(line, line[1:])) or 1e-9


def cut(line: Sequence[Place], share: float) -> list[Place]:
    """What of a line is behind a share of its length."""
    skip_m = max(0.0, share) * length(line)
    for index, (start, end) in enumerate(zip(line, line[1:])):
        piece_m = math.dist(start, end)
        if skip_m < piece_m:
            t = skip_m / piece_m
            first = (start[0] + t * (end[0] - start[0]), start[1] + t * (end[1] - start[1]))
            return [first, *line[index + 1 :]]
        skip_m -= piece_m
    return list(line[-2:])


def word(name: str) -> str:
    """A name of SUMO's as scenarios may have them."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "_" for c in name)[:64]


def connect(net: typing.Any, zones: Iterable[tuple[str, Zone]], least_m: float) -> None:
    """Leads exits of zones to entrances of others over the lanes between them."""
    zones = list(zones)
    exits = {path.exit: zone.name for _, zone in zones for path in zone.paths}
    for junction, zone in zones:
        lanes = {word(lane.getID()): lane for edge in incoming(net, junction) for lane in edge.getLanes()}
        for segment in zone.segments:
            if segment.road is None or segment.name not in exits:
                continue
            segment.zone, segment.road = (exits[segment.name], segment.name), None
            rest_m = float(lanes[segment.name].getLength()) - segment.length_m
            # A link shorter than a step's way is part of the approach.
            if rest_m >= least_m:
                segment.link_m = rest_m
            elif rest_m > 0.0:
                segment.length_m += rest_m
                for path in zone.paths:
                    if path.segments[0] == segment.name:
                        path.length_m += rest_m
