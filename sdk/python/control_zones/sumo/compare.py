"""`cz sumo compare`: the same demand in our world and in SUMO's, all automated, and with SUMO's drivers under SUMO's rules."""

from __future__ import annotations

import os
import sys
import tempfile
import typing

from .._session import Error
from .runs import collided, interval, ran

if typing.TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

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


def result(summary: dict[str, typing.Any]) -> Result:
    """What a summary says."""
    zones = summary["zones"]
    sumo = summary.get("sumo")
    return Result(
        summary["total_objective"],
        sum(zone["mean_time_s"] + zone["mean_wait_s"] for zone in zones),
        sum(zone["mean_energy"] for zone in zones),
        summary["arrived"],
        summary["departed"],
        len(collided(summary)) if sumo else None,
        summary["overlaps"]["pairs"],
    )


def made(command: list[str], folder: str) -> Result:
    """Makes a run."""
    return result(ran(command, folder))


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
