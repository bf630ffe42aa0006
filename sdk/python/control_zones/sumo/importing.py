"""`cz import sumo`: a SUMO network as a scenario for our own world."""

from __future__ import annotations

import os
import typing
import xml.etree.ElementTree as ElementTree

from .._session import Error
from .network import Zone, connect, incoming, is_narrow, onward, word, zone_of
from .scenario import Kind, text
from .simulation import read_net

if typing.TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

#: SUMO's default passenger car.
CAR = Kind("passenger", 5.0, -4.5, 2.6)
DT_S = 0.1


def write(args: argparse.Namespace) -> None:
    """Writes the scenario.

    Raises `Error` when something cannot be read, or written.
    """
    if not 1.0 <= args.rate <= 10_000.0:
        raise Error(f"--rate is {args.rate}, expected 1 to 10000 vehicles an hour")
    net = read_net(args.net)
    ids = args.zone or with_conflicts(net)
    zones = [zone_of(net, junction, args.approach) for junction in ids]
    v_max_mps = limit(net, zones)
    connect(net, list(zip(ids, zones)), v_max_mps * DT_S)
    roads = [segment for zone in zones for segment in zone.segments if segment.road]
    if not roads:
        raise Error("--zone: every road to these junctions comes from another of them; expected some that vehicles come in by")
    by_edge = rates(args.rou)
    lanes = {word(lane.getID()): lane for junction in ids for edge in incoming(net, junction) for lane in edge.getLanes()}
    per_hour = {}
    for segment in roads:
        edge = lanes[segment.name].getEdge()
        on_edge = [one for one in roads if lanes[one.name].getEdge() is edge]
        rate = by_edge.get(str(edge.getID()), 0.0) / len(on_edge) if args.rou else args.rate
        # A road on which nobody comes has a table all the same.
        per_hour[str(segment.road)] = max(rate, 1.0)
    name = word(os.path.basename(args.net).split(".")[0]) or "sumo"
    about = f"{os.path.basename(args.net)}, by `cz import sumo`: its junctions as zones, its lanes as they lie."
    made = text(name, zones, [CAR], seed=1, dt_s=DT_S, end_s=600.0, v_max_mps=v_max_mps, rates=per_hour, about=about)
    try:
        with open(args.out, "w") as file:
            file.write(made)
    except OSError as error:
        raise Error(f"--out {args.out}: {error}") from error


def limit(net: typing.Any, zones: Sequence[Zone]) -> float:
    """The least limit of roads to and within zones, m/s."""
    to_them = [float(net.getLane(path.lanes[0][0]).getSpeed()) for zone in zones for path in zone.paths]
    return min([*to_them, *(zone.v_max_mps for zone in zones)])


def slow(net: typing.Any, zones: Sequence[Zone]) -> str | None:
    """What to say where the limit of all zones is well below that of some of their roads; `None` where it is not."""
    lanes = {path.lanes[0][0]: zone for zone in zones for path in zone.paths}
    limits = {name: float(net.getLane(name).getSpeed()) for name in lanes}
    least_mps = limit(net, zones)
    fast = sum(mps > 1.3 * least_mps for mps in limits.values())
    if fast == 0:
        return None
    slowest = min(limits, key=lambda name: limits[name])
    at = f"lane {slowest} to {lanes[slowest].name}" if limits[slowest] == least_mps else "a lane within a zone"
    return (
        f"in all zones vehicles drive at most {least_mps:.1f} m/s, the limit of {at}, though {fast} of {len(limits)} lanes to zones "
        f"allow up to {max(limits.values()):.1f}: name junctions of faster roads only (--zone)"
    )


def with_conflicts(net: typing.Any) -> list[str]:
    """Junctions at which ways of cars meet, in order of their names; those of what SUMO knows as a roundabout together, where it
    is narrow."""
    all_rings = [sorted(str(node) for node in ring.getNodes()) for ring in net.getRoundabouts()]
    rings = ["+".join(nodes) for nodes in all_rings if is_narrow(net, nodes)]
    found = list(rings)
    in_rings = {node for ring in rings for node in ring.split("+")}
    for node in net.getNodes():
        if node.getID() in in_rings:
            continue
        edges = incoming(net, str(node.getID()))
        if sum(any(onward(net, lane) for lane in edge.getLanes()) for edge in edges) > 1:
            found.append(str(node.getID()))
    if not found:
        raise Error("--zone: no junction of the network has two incoming roads for passenger cars")
    return sorted(found)


def rates(files: list[str]) -> dict[str, float]:
    """Vehicles an hour by the edge on which they begin, of vehicles, trips and flows in route files."""
    counts: dict[str, float] = {}
    begins: list[float] = []
    for path in files:
        try:
            root = ElementTree.parse(path).getroot()
        except (OSError, ElementTree.ParseError) as error:
            raise Error(f"--rou {path}: cannot be read: {error}") from error
        routes = {route.get("id"): route.get("edges", "") for route in root.iter("route") if route.get("id")}
        for one in root:
            if one.tag not in ("vehicle", "trip", "flow"):
                continue
            inner = one.find("route")
            edges = inner.get("edges", "") if inner is not None else routes.get(one.get("route"), "")
            first = (edges.split() or [one.get("from", "")])[0]
            if one.tag == "flow":
                begin, end = float(one.get("begin", 0.0)), float(one.get("end", 3600.0))
                counts[first] = counts.get(first, 0.0) + per_second(one, end - begin) * (end - begin)
                begins += [begin, end]
            else:
                counts[first] = counts.get(first, 0.0) + 1.0
                begins.append(float(one.get("depart", 0.0)))
    span_s = max(max(begins) - min(begins), 1.0) if begins else 3600.0
    return {edge: 3600.0 * count / span_s for edge, count in counts.items()}


def per_second(flow: ElementTree.Element, span_s: float) -> float:
    """The mean rate of a flow, vehicles per second."""
    period = flow.get("period", "")
    if flow.get("number"):
        return float(flow.get("number", 0.0)) / span_s
    if period.startswith("exp(") and period.endswith(")"):
        return float(period[4:-1])
    if period:
        return 1.0 / float(period)
    return float(flow.get("probability", 0.0)) or float(flow.get("vehsPerHour", 0.0)) / 3600.0
