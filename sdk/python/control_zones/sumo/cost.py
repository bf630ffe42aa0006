"""`cz sumo cost`: whose the time of a step is, with SUMO as the world."""

from __future__ import annotations

import json
import os
import random
import shlex
import subprocess
import sys
import tempfile
import typing

from .._session import Error
from .simulation import make, read_net

if typing.TYPE_CHECKING:
    import argparse

#: Of a grid: between junctions, m; of it there is so much for each vehicle at once, m.
BLOCK_M, ROAD_PER_VEHICLE_M = 150.0, 225.0
#: Vehicles come within so many seconds and drive on to the end of the run, s.
COME_S, END_S = 30.0, 90.0


def junctions_a_side(vehicles: int) -> int:
    """The size of a grid on whose roads so many vehicles have their room."""
    side = 2
    while 4 * side * (side - 1) * BLOCK_M < ROAD_PER_VEHICLE_M * vehicles:
        side += 1
    return side


def grid(vehicles: int, folder: str, seed: int) -> str:
    """A grid and vehicles that wander about in it until the run ends; returns the configuration."""
    base = os.path.join(folder, f"grid{vehicles}")
    side = junctions_a_side(vehicles)
    options = ["--grid", "--grid.number", str(side), "--grid.length", repr(BLOCK_M), "--no-turnarounds", "true"]
    make("netgenerate", *options, "-o", f"{base}.net.xml")
    edges = [edge for edge in read_net(f"{base}.net.xml").getEdges() if not edge.getFunction()]
    onward = {str(edge.getID()): sorted(str(other.getID()) for other in edge.getOutgoing()) for edge in edges}
    chance = random.Random(seed)
    length = int(END_S * 14.0 / BLOCK_M) + 3
    lines = ["<routes>"]
    for vehicle in range(vehicles):
        way = [chance.choice(sorted(onward))]
        while len(way) < length and way[-1] in onward:
            way.append(chance.choice(onward[way[-1]]))
        depart_s = COME_S * vehicle / vehicles
        lines.append(
            f'<vehicle id="v{vehicle}" depart="{depart_s:.2f}">'
            f'<route edges="{" ".join(way)}"/></vehicle>'
        )
    with open(f"{base}.rou.xml", "w") as file:
        file.write("\n".join([*lines, "</routes>"]))
    with open(f"{base}.sumocfg", "w") as file:
        file.write(
            f'<configuration><input><net-file value="{base}.net.xml"/><route-files value="{base}.rou.xml"/></input>'
            f'<time><end value="{END_S}"/></time></configuration>'
        )
    return f"{base}.sumocfg"


class Share(typing.NamedTuple):
    """Wall time of a step by whose it is, us, with so many vehicles at once."""

    vehicles: float
    zones: int
    sumo_us: float
    package_us: float
    roles_us: float
    transport_us: float | None


def measure(vehicles: int, cz: str | None, seed: int) -> Share:
    """Runs the grid in this process, and in several where `cz` names the program that starts them."""
    with tempfile.TemporaryDirectory(prefix=f"cz-sumo-cost-{os.getpid()}-") as folder:
        # While they come there are fewer.
        config = grid(round(vehicles / (1.0 - 0.5 * COME_S / END_S)), folder, seed)
        scenario, summary = os.path.join(folder, "grid.toml"), os.path.join(folder, "summary.json")
        own = [sys.executable, "-m", "control_zones.sumo", "run", config, "--seed", str(seed)]
        # Of several runs the least disturbed.
        times = max(1, min(5, 900 // vehicles))
        alone = least(times, [*own, "--scenario-out", scenario, "--json", summary], summary)
        steps, sumo = alone["steps"], alone["sumo"]
        whole_us, sumo_us = 1e6 * alone["wall_s"] / steps, 1e6 * sumo["sumo_s"] / steps
        package_us = 1e6 * sumo["adapter_s"] / steps
        transport_us = None
        if cz is not None:
            several = least(times, [cz, "run", scenario, "--world", shlex.join(own), "--json", summary], summary)
            if several["state_hash"] != alone["state_hash"]:
                raise Error(f"{several['state_hash']} in several processes, {alone['state_hash']} in one: not the same run")
            # What is slower by is the transport, and the waiting for each other.
            transport_us = 1e6 * several["wall_s"] / steps - whole_us
        at_once = sumo["vehicle_steps"] / steps
        return Share(at_once, len(alone["zones"]), sumo_us, package_us, whole_us - sumo_us - package_us, transport_us)


def least(times: int, command: list[str], summary: str) -> dict[str, typing.Any]:
    """The summary of the quickest of so many runs."""
    return min((said(command, summary) for _ in range(times)), key=lambda found: float(found["wall_s"]))


def said(command: list[str], summary: str) -> dict[str, typing.Any]:
    """The summary of a run."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise Error(f"{shlex.join(command)} failed: {done.stderr.strip().splitlines()[-1] if done.stderr.strip() else done.returncode}")
    with open(summary) as file:
        found: dict[str, typing.Any] = json.load(file)
    return found


def main(args: argparse.Namespace) -> None:
    """Prints a table, a line for each number of vehicles."""
    print("| vehicles at once | zones | a step, ms | SUMO | this package | world, coordinator, controllers | transport |")
    print("|---|---|---|---|---|---|---|")
    for vehicles in args.vehicles:
        share = measure(vehicles, args.cz, args.seed)
        parts = [share.sumo_us, share.package_us, share.roles_us, share.transport_us or 0.0]
        whole_us = sum(parts)
        cells = [f"{part / share.vehicles:.1f} µs, {100.0 * part / whole_us:.0f} %" for part in parts]
        if share.transport_us is None:
            cells[-1] = "not measured"
        print(f"| {share.vehicles:.0f} | {share.zones} | {whole_us * 1e-3:.2f} | {' | '.join(cells)} |", flush=True)
