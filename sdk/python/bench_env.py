"""Environment steps per second, beside SUMO's with the same arrivals on roads of the same shape.

Usage: python3 -I sdk/python/bench_env.py [SECONDS]   (per figure; 10 by default; -I takes the package that is installed)

Needs `control_zones.env`, and eclipse-sumo and libsumo for what is beside it (`pip install eclipse-sumo libsumo traci`). Every
step shows where all vehicles are and how fast, and gives each an acceleration; SUMO is told by one call per vehicle, as it has no
other, and asked by subscription, one call for all. "Alone" are steps in which SUMO is neither asked nor told. What
Control Zones does beside, coordination and the law, is in its figures.
"""

from __future__ import annotations

import csv
import os
import subprocess
import sys
import tempfile
import time
import typing
from pathlib import Path

import numpy

from control_zones.env import ZonesEnv, ZoneVectorEnv

ROOT = Path(__file__).resolve().parents[2]
ARRIVALS = ROOT / "scenarios/data/sumo-400-1.csv"
SCENARIO, VEHICLES, DT_S, LENGTH_M = "paper", 120, 0.1, 200.0
#: What SUMO's vehicles are told to hold.
SPEED_MPS = 17.0


class Figure(typing.NamedTuple):
    """What was measured."""

    what: str
    steps_per_s: float
    #: Mean number of vehicles in a step of one run.
    vehicles: float


def one(seconds: float) -> Figure:
    """One environment with all zones."""
    env = ZonesEnv(SCENARIO)
    seen, _ = env.reset(seed=1)
    steps, vehicles, start = 0, 0, time.perf_counter()
    while (gone := time.perf_counter() - start) < seconds:
        if not env.agents:
            seen, _ = env.reset(seed=1)
        seen, *_ = env.step(env.law(seen))
        steps += 1
        vehicles += sum(int(numpy.count_nonzero(rows[:, 0])) for rows in seen.values())
    return Figure("Control Zones, one", steps / gone, vehicles / steps)


def batch(seconds: float, count: int, vehicles: float) -> Figure:
    """As many of one zone side by side; their runs have as many vehicles as one has."""
    env = ZoneVectorEnv(count, SCENARIO, zone="merge-2")
    seen, _ = env.reset(seed=list(range(1, count + 1)))
    steps, start = 0, time.perf_counter()
    while (gone := time.perf_counter() - start) < seconds:
        seen, *_ = env.step(env.law(seen))
        steps += count
    return Figure(f"Control Zones, {count} in a batch", steps / gone, vehicles)


def sumo_files(place: Path) -> list[str]:
    """Two merges in a row, and the arrivals; the arguments with which SUMO runs them."""
    length = LENGTH_M
    nodes = {"main1": (0, 0), "merge1": (0, 100), "merge2": (length, 100), "m1": (length, 0), "m2": (2 * length, 0)}
    nodes["out"] = (3 * length, 0)
    edges = [("main1", "m1"), ("merge1", "m1"), ("m1", "m2"), ("merge2", "m2"), ("m2", "out")]
    (place / "a.nod.xml").write_text(
        "<nodes>" + "".join(f'<node id="{name}" x="{x}" y="{y}" type="zipper"/>' for name, (x, y) in nodes.items()) + "</nodes>"
    )
    (place / "a.edg.xml").write_text(
        "<edges>"
        + "".join(
            f'<edge id="{a}-{b}" from="{a}" to="{b}" numLanes="1" speed="30" length="{length if b != "out" else 10}"/>'
            for a, b in edges
        )
        + "</edges>"
    )
    network = place / "a.net.xml"
    convert = ["netconvert", "-n", place / "a.nod.xml", "-e", place / "a.edg.xml", "-o", network]
    subprocess.run(convert, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    ways = {"main1": "main1-m1 m1-m2 m2-out", "merge1": "merge1-m1 m1-m2 m2-out", "merge2": "merge2-m2 m2-out"}
    with ARRIVALS.open() as file:
        arrivals = list(csv.DictReader(file))[:VEHICLES]
    (place / "a.rou.xml").write_text(
        '<routes><vType id="car" accel="4" decel="4" length="4.5" minGap="0" tau="1.8" maxSpeed="30"/>'
        + "".join(f'<route id="{name}" edges="{way}"/>' for name, way in ways.items())
        + "".join(
            f'<vehicle id="{at}" type="car" route="{row["road"]}" depart="{row["time_s"]}" departSpeed="{row["speed_mps"]}"/>'
            for at, row in enumerate(arrivals)
        )
        + "</routes>"
    )
    quiet = ["--no-step-log", "true", "--no-warnings", "true", "--duration-log.disable", "true"]
    return ["-n", str(network), "-r", str(place / "a.rou.xml"), "--step-length", str(DT_S), *quiet]


def sumo(seconds: float, name: str, program: str, arguments: list[str], driven: bool) -> Figure:
    """A run of SUMO again and again, by the module of that name."""
    module = __import__(name)
    variables = [module.constants.VAR_LANEPOSITION, module.constants.VAR_SPEED, module.constants.VAR_ACCELERATION]
    steps, vehicles, start, gone = 0, 0, time.perf_counter(), 0.0
    while gone < seconds:
        module.start([program, *arguments])
        # Starting is not stepping.
        begun = time.perf_counter()
        while module.simulation.getMinExpectedNumber() > 0 and gone + time.perf_counter() - begun < seconds:
            module.simulationStep()
            steps += 1
            vehicles += module.vehicle.getIDCount()
            if driven:
                for vehicle in module.simulation.getDepartedIDList():
                    module.vehicle.subscribe(vehicle, variables)
                seen = module.vehicle.getAllSubscriptionResults()
                for vehicle, values in seen.items():
                    acceleration = min(4.0, max(-4.0, SPEED_MPS - values[variables[1]]))
                    module.vehicle.setAcceleration(vehicle, acceleration, DT_S)
        gone += time.perf_counter() - begun
        module.close()
    what = "observed and driven" if driven else "alone"
    return Figure(f"SUMO by {name}, {what}", steps / gone, vehicles / steps)


def main() -> None:
    """The table."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    figures = [one(seconds)]
    figures.append(batch(seconds, 64, figures[0].vehicles))
    try:
        import libsumo  # noqa: F401
        import traci  # noqa: F401
    except ImportError as error:
        print(f"{error}; nothing is measured beside Control Zones")
    else:
        import sumo as home

        os.environ.setdefault("SUMO_HOME", home.SUMO_HOME)
        os.environ["PATH"] = f"{home.SUMO_HOME}/bin:{os.environ['PATH']}"
        with tempfile.TemporaryDirectory(prefix="cz-bench-") as place:
            arguments = sumo_files(Path(place))
            for name in ("libsumo", "traci"):
                figures += [sumo(seconds, name, "sumo", arguments, driven) for driven in (True, False)]
    print("| | steps/s | vehicles in a step | one / this | 64 in a batch / this | the same by vehicle-steps |")
    print("|---|---:|---:|---:|---:|---:|")
    for figure in figures:
        ratios = [f"{mine.steps_per_s / figure.steps_per_s:.1f}" for mine in figures[:2]]
        moved = [mine.steps_per_s * mine.vehicles / figure.steps_per_s / figure.vehicles for mine in figures[:2]]
        print(
            f"| {figure.what} | {figure.steps_per_s:.0f} | {figure.vehicles:.1f} "
            f"| {ratios[0]} | {ratios[1]} | {moved[0]:.1f}, {moved[1]:.1f} |"
        )


main()
