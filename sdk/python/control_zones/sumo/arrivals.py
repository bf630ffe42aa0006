"""Arrival traces of SUMO's human drivers: who comes on a road once they have driven after each other for a while."""

from __future__ import annotations

import os
import re
import typing

import libsumo

from .._session import Error
from .periods import WHOLE_S, Period, in_order
from .simulation import make

if typing.TYPE_CHECKING:
    import argparse

#: Way from where vehicles begin to where they are told of, m: after it those who are faster have come up behind others.
WAY_M = 1000.0
#: The road's speed limit, m/s (60 km/h), which SUMO's drivers keep to within a tenth, more or less.
LIMIT_MPS = 60.0 / 3.6
#: Behind where they are told of, m.
REST_M = 200.0


def write(args: argparse.Namespace, folder: str) -> None:
    """Has SUMO drive and writes the trace."""
    roads: list[str] = args.road or ["main1", "merge1", "merge2"]
    for road in roads:
        if re.fullmatch(r"[\w-]+", road, re.ASCII) is None or roads.count(road) > 1:
            raise Error(f"--road is {road!r}, expected a name of letters, digits, _ and -, each once")
    if args.vehicles is not None and args.vehicles < 1:
        raise Error(f"--vehicles is {args.vehicles}, expected 1 or more")
    rates = in_order(args.rate or [Period(WHOLE_S, 400.0)])
    try:
        with open(args.out, "w", encoding="utf-8") as file:
            file.write("time_s,road,speed_mps\n")
            for time_s, road, speed_mps in trace(roads, rates, args.seed, folder)[: args.vehicles]:
                file.write(f"{time_s:.2f},{road},{speed_mps:.2f}\n")
    except OSError as error:
        raise Error(f"--out {args.out}: {error.strerror}") from error


def trace(roads: list[str], rates: list[Period], seed: int, folder: str) -> list[tuple[float, str, float]]:
    """Instants, roads and speeds of all that pass the ends of their roads, in order of time; the first comes at 0."""
    net, routes = _network(roads, folder), _routes(roads, rates, folder)
    options = ["--step-length", "0.1", "--seed", str(seed), "--no-step-log", "--no-warnings", "--time-to-teleport", "-1"]
    libsumo.start(["sumo", "-n", net, "-r", routes, *options])
    rows: list[tuple[float, str, float]] = []
    try:
        before: dict[str, float] = {}
        while libsumo.simulation.getMinExpectedNumber() > 0:
            libsumo.simulationStep()
            now = libsumo.simulation.getTime()
            after = {vehicle: libsumo.vehicle.getLanePosition(vehicle) for vehicle in libsumo.vehicle.getIDList()}
            for vehicle, x_m in after.items():
                was_m = before.get(vehicle, x_m)
                if was_m < WAY_M <= x_m:
                    since_s = 0.1 * (x_m - WAY_M) / (x_m - was_m)
                    rows.append((now - since_s, libsumo.vehicle.getRoadID(vehicle), libsumo.vehicle.getSpeed(vehicle)))
            before = after
    finally:
        libsumo.close()
    rows.sort()
    return [(time_s - rows[0][0], road, speed_mps) for time_s, road, speed_mps in rows]


def _network(roads: list[str], folder: str) -> str:
    nodes, edges = ["<nodes>"], ["<edges>"]
    for at, road in enumerate(roads):
        for end, x_m in (("from", 0.0), ("to", WAY_M + REST_M)):
            nodes.append(f'<node id="{road}-{end}" x="{x_m}" y="{100 * at}"/>')
        edges.append(f'<edge id="{road}" from="{road}-from" to="{road}-to" numLanes="1" speed="{LIMIT_MPS}"/>')
    files = []
    for kind, lines in (("nod", [*nodes, "</nodes>"]), ("edg", [*edges, "</edges>"])):
        files.append(os.path.join(folder, f"roads.{kind}.xml"))
        _write(files[-1], lines)
    net = os.path.join(folder, "roads.net.xml")
    make("netconvert", "-n", files[0], "-e", files[1], "-o", net)
    return net


def _routes(roads: list[str], rates: list[Period], folder: str) -> str:
    lines = ["<routes>", '<vType id="human" length="4.5"/>', *(f'<route id="{road}" edges="{road}"/>' for road in roads)]
    begin_s = 0.0
    for at, (until_s, vehicles_per_hour) in enumerate(rates):
        lines += [
            f'<flow id="{road}-{at}" type="human" route="{road}" begin="{begin_s}" end="{until_s}" '
            f'period="exp({vehicles_per_hour / 3600})" departSpeed="desired"/>'
            for road in roads
            if vehicles_per_hour > 0
        ]
        begin_s = until_s
    file = os.path.join(folder, "roads.rou.xml")
    _write(file, [*lines, "</routes>"])
    return file


def _write(file: str, lines: list[str]) -> None:
    with open(file, "w", encoding="utf-8") as out:
        out.write("\n".join(lines) + "\n")
