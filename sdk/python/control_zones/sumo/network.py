"""Zones from a SUMO network: its junctions, internal lanes and what comes together where."""

from __future__ import annotations

import hashlib
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
#: Letters that a name in a scenario may have.
LONGEST = 64
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
    #: Within a junction, where nobody waits for others.
    keep_clear: bool = False


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
    #: From where to where on each, m.
    at: dict[str, tuple[float, float]]


@dataclass
class Zone:
    """A junction, or several near each other, as a control zone."""

    name: str
    segments: list[Segment] = field(default_factory=list)
    paths: list[Path] = field(default_factory=list)
    crossings: list[Crossing] = field(default_factory=list)
    #: The least limit of the roads between its junctions, m/s.
    v_max_mps: float = math.inf


@dataclass
class Stretch:
    """What is within a zone: lanes one after the other, from one lane to another."""

    name: str
    start: str
    end: str
    length_m: float
    shape: list[Place]
    #: With the distance from its beginning at which each begins.
    lanes: list[tuple[str, float]]


def members(net: typing.Any, junction: str) -> list[str]:
    """The junctions of a zone: one, or several with plus signs between.

    Raises `Error` when one is not there.
    """
    names = [junction] if net.hasNode(junction) else junction.split("+")
    for name in names:
        if not net.hasNode(name):
            known = ", ".join(sorted(node.getID() for node in net.getNodes())[:20])
            raise Error(f"--zone: there is no junction {name} in the network, expected one of {known}, or several: A+B")
    return names


def zone_of(net: typing.Any, junction: str, approach_m: float) -> Zone:
    """The zone of a junction, or of several as one, with so much of its incoming lanes at most.

    Raises `Error` when there is no such junction, or nothing for vehicles to drive on in it.
    """
    nodes = set(members(net, junction))
    zone = Zone(word(junction))
    inner: dict[str, Stretch] = {}
    for edge in incoming(net, junction):
        for lane in edge.getLanes():
            add_lane(net, zone, lane, approach_m, nodes, inner)
    # Between junctions of a ring, whoever waits before one is in the way of those who leave by the one before.
    rings = {str(node) for ring in net.getRoundabouts() for node in ring.getNodes()}
    if len(nodes) == 1 and nodes <= rings:
        for segment in zone.segments:
            segment.keep_clear = False
    if not zone.paths:
        raise Error(f"--zone: vehicles cannot cross junction {junction}: no connection of it is for passenger cars")
    zone.crossings = crossings(zone, inner)
    return zone


def incoming(net: typing.Any, junction: str) -> list[typing.Any]:
    """The roads that lead to the junctions of a zone from elsewhere, in order of their names."""
    nodes = members(net, junction)
    edges = (edge for node in nodes for edge in net.getNode(node).getIncoming() if edge.getFunction() == "")
    return sorted((edge for edge in edges if edge.getFromNode().getID() not in nodes), key=lambda edge: str(edge.getID()))


def stopping_m(v_mps: float, room_m: float = ROOM_M) -> float:
    """The way that stopping takes, with what is kept beside it, m."""
    return v_mps * v_mps / (2.0 * BRAKING_MPS2) + REACTION_S * v_mps + room_m


def too_short(net: typing.Any, junction: str, room_m: float = ROOM_M) -> str | None:
    """What is wrong with a zone: a road on which vehicles cannot stop, and keep their distance, from one
    junction to the next; `None` when nothing is. `room_m` is kept beside the way that stopping takes."""
    for edge in incoming(net, junction):
        for lane in edge.getLanes():
            v_mps = float(lane.getSpeed())
            needed_m = stopping_m(v_mps, room_m)
            if lane.allows("passenger") and lane.getOutgoing() and float(lane.getLength()) < needed_m:
                return f"lane {lane.getID()} to junction {junction} is {lane.getLength():.1f} m long, expected {needed_m:.1f} at {v_mps:.1f} m/s"
    return None


def is_narrow(net: typing.Any, ring: Sequence[str]) -> bool:
    """Whether the junctions of a roundabout are too near to each other to be zones by themselves: between two of them vehicles
    stop behind two others."""
    return any(too_short(net, node, 3.0 * ROOM_M) for node in ring)


def onward(net: typing.Any, lane: typing.Any) -> list[tuple[Stretch, typing.Any]]:
    """The ways over a junction that begin on a lane, each with the lane it leads to."""
    found: list[tuple[Stretch, typing.Any]] = []
    for connection in lane.getOutgoing():
        to, via = connection.getToLane(), connection.getViaLaneID()
        if not (lane.allows("passenger") and to.allows("passenger")) or any(to is known for _, known in found):
            continue
        start, end = word(lane.getID()), word(to.getID())
        stretch = Stretch(word(f"{start}-{end}"), start, end, 0.0, [], [])
        while via:
            inside = net.getLane(via)
            stretch.lanes.append((via, stretch.length_m))
            stretch.length_m += float(inside.getLength())
            stretch.shape += [place for place in inside.getShape() if not stretch.shape or place != stretch.shape[-1]]
            via = inside.getOutgoing()[0].getViaLaneID() if inside.getOutgoing() else ""
        found.append((stretch, to))
    return found


def ways(net: typing.Any, lane: typing.Any, nodes: set[str], behind: tuple[str, ...] = ()) -> list[tuple[list[Stretch], typing.Any]]:
    """The ways from a lane over the junctions of a zone, and the lanes between them, to lanes that lead out of it."""
    found: list[tuple[list[Stretch], typing.Any]] = []
    for stretch, to in onward(net, lane):
        edge = to.getEdge()
        if edge.getToNode().getID() not in nodes:
            found.append(([stretch], to))
        elif to.getID() not in behind:
            name = word(to.getID())
            between = Stretch(name, name, name, float(to.getLength()), list(to.getShape()), [(to.getID(), 0.0)])
            further = ways(net, to, nodes, (*behind, to.getID()))
            found += [([stretch, between, *rest], end) for rest, end in further]
    return found


def meets_itself(chain: Sequence[Stretch]) -> bool:
    """Whether a way comes too near to itself, as one all the way round a narrow ring may: it would have to give way to itself."""
    pairs = ((one, other) for at, one in enumerate(chain) for other in chain[at + 2 :] if one.shape and other.shape)
    return any(near(one.shape, other.shape) for one, other in pairs)


def add_lane(
    net: typing.Any, zone: Zone, lane: typing.Any, approach_m: float, nodes: set[str], inner: dict[str, Stretch]
) -> None:
    """Adds an incoming lane, and the ways over the zone's junctions that begin on it."""
    entrance = word(lane.getID())
    length_m = float(lane.getLength())
    own_m = min(length_m, approach_m)
    begins = False
    for chain, to in ways(net, lane, nodes):
        if meets_itself(chain):
            continue
        begins = True
        lanes, at_m, segments = [(lane.getID(), own_m - length_m)], own_m, [entrance]
        for stretch in chain:
            lanes += [(name, at_m + from_m) for name, from_m in stretch.lanes]
            at_m += stretch.length_m
            if stretch.length_m > 0.0:
                segments.append(stretch.name)
                if stretch.name not in inner:
                    inner[stretch.name] = stretch
                    inside = stretch.start != stretch.end
                    zone.segments.append(Segment(stretch.name, stretch.length_m, stretch.shape, keep_clear=inside))
            if stretch.start == stretch.end:
                zone.v_max_mps = min(zone.v_max_mps, float(net.getLane(stretch.lanes[0][0]).getSpeed()))
        lanes.append((to.getID(), at_m))
        name, exit_ = word(f"{entrance}-{to.getID()}"), word(to.getID())
        alike = sum(path.name.split(".")[0] == name for path in zone.paths)
        zone.paths.append(Path(f"{name}.{alike}" if alike else name, segments, exit_, lanes, at_m))
    if begins:
        ends = cut(lane.getShape(), (length_m - own_m) / length_m)
        zone.segments.append(Segment(entrance, own_m, ends, road=word(f"{zone.name}-{entrance}")))


def crossings(zone: Zone, inner: dict[str, Stretch]) -> list[Crossing]:
    """Where stretches that no path shares are too near to each other.

    Ways to one lane merge at their ends, as scenarios have it; but bodies meet before that, so whoever waits is to wait
    before the two ways come together. Ways from one lane part where it ends; but one that stops on its way there reaches
    into the other's for as long as they are near each other, so that counts as a crossing too.
    """
    shared = {(one, other) for path in zone.paths for one in path.segments for other in path.segments}
    found: list[Crossing] = []
    stretches = list(inner.values())
    for index, one in enumerate(stretches):
        for other in stretches[index + 1 :]:
            if (one.name, other.name) in shared:
                continue
            parts = near(one.shape, other.shape)
            if parts is None:
                continue
            (from_m, to_m), (other_from_m, other_to_m) = parts
            # Shapes are a little longer or shorter than what SUMO says of their lanes.
            scale, other_scale = (stretch.length_m / length(stretch.shape) for stretch in (one, other))
            at = {one.name: (from_m * scale, to_m * scale), other.name: (other_from_m * other_scale, other_to_m * other_scale)}
            found.append(Crossing(f"c{len(found)}", at))
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
    """A name of SUMO's as scenarios may have them: of these letters, and not too long; a long one ends with its hash."""
    told = "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "_" for c in name)
    return told if len(told) <= LONGEST else f"{told[: LONGEST - 9]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


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
