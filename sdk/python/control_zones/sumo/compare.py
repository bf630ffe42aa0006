"""`cz sumo compare`: the same demand in our world and in SUMO's, all automated, and with SUMO's drivers under SUMO's rules."""

from __future__ import annotations

import json
import math
import os
import shlex
import statistics
import subprocess
import sys
import tempfile
import typing

from .._session import Error

if typing.TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

#: The 97.5 % quantile of Student's t by degrees of freedom, from 1.
T_975 = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131, 2.120, 2.110, 2.101, 2.093)


class Result(typing.NamedTuple):
    """What a run came to."""

    total: float
    time_s: float
    energy: float
    arrived: int
    departed: int
    #: Pairs of vehicles that SUMO saw collide; `None` in our world, which SUMO does not see.
    collisions: int | None
    #: Negative margins and overlaps that the world's ledger counted.
    overlaps: int


def interval(values: Sequence[float], digits: int) -> str:
    """The mean and half of its 95 % interval."""
    mean = statistics.fmean(values)
    if len(values) < 2:
        return f"{mean:.{digits}f}"
    t = T_975[min(len(values) - 2, len(T_975) - 1)]
    return f"{mean:.{digits}f} ± {t * statistics.stdev(values) / math.sqrt(len(values)):.{digits}f}"


def result(summary: dict[str, typing.Any]) -> Result:
    """What a summary says."""
    zones = summary["zones"]
    sumo = summary.get("sumo")
    # A sample a step: of a pair, one is enough.
    pairs = {said.split(": ", 1)[1].split(" on ")[0] for said in sumo["collisions"]} if sumo else set()
    return Result(
        summary["total_objective"],
        sum(zone["mean_time_s"] + zone["mean_wait_s"] for zone in zones),
        sum(zone["mean_energy"] for zone in zones),
        summary["arrived"],
        summary["departed"],
        len(pairs) if sumo else None,
        summary["overlaps"]["pairs"],
    )


def made(command: list[str], folder: str) -> Result:
    """Makes a run."""
    path = os.path.join(folder, "summary.json")
    done = subprocess.run([*command, "--json", path], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        words = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise Error(f"{shlex.join(command)} failed: {words[-1]}")
    with open(path) as file:
        found = json.load(file)
    os.remove(path)
    return result(found)


def row(name: str, who: str, results: Sequence[Result], ours: Sequence[Result]) -> str:
    """A line of the table; what is against our world is of the same seed."""
    through = f"{sum(one.departed for one in results)} of {sum(one.arrived for one in results)}"
    collisions = "–" if results[0].collisions is None else str(sum(one.collisions or 0 for one in results))
    values = [interval(column, 2) for column in zip(*((one.total, one.time_s, one.energy) for one in results))]
    against = [100.0 * (one.total / own.total - 1.0) for one, own in zip(results, ours)]
    values.insert(1, "–" if results is ours else interval(against, 1))
    return f"| `{name}` | {who} | {' | '.join(values)} | {through} | {collisions} | {sum(one.overlaps for one in results)} |"


def main(args: argparse.Namespace) -> None:
    """Prints the table, a line for each scenario and way."""
    if args.cz is None:
        raise Error("--cz: there is no cz on the path, expected the program that runs our own world")
    print("| scenario | who moves and decides | total | against ours, % | time, s | energy | left of came | SUMO: pairs that collided | overlaps |")
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory(prefix=f"cz-sumo-compare-{os.getpid()}-") as folder:
        for name in args.scenario or ["two-merges", "intersection", "roundabout"]:
            sets = [f"--set={one}" for one in args.set]
            sumo = [sys.executable, "-m", "control_zones.sumo", "scenario", name, *sets]
            ways = [("our world, all automated", [args.cz, "run", name, "--in-process", *sets]), ("SUMO, all automated", sumo)]
            ways += [(f"SUMO, its drivers, `{rule}`", [*sumo, "--penetration", "0", "--junctions", rule]) for rule in args.rules]
            ours: list[Result] = []
            for who, command in ways:
                results = [made([*command, "--seed", str(seed)], folder) for seed in range(1, args.seeds + 1)]
                ours = ours or results
                print(row(name, who, results, ours), flush=True)
