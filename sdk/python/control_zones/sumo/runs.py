"""Runs of other programs that say in a summary what they came to, and means over several of them."""

from __future__ import annotations

import json
import math
import os
import shlex
import statistics
import subprocess
import typing

from .._session import Error

if typing.TYPE_CHECKING:
    from collections.abc import Sequence

#: The 97.5 % quantile of Student's t by degrees of freedom, from 1.
T_975 = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131, 2.120, 2.110, 2.101, 2.093)


def spread(values: Sequence[float]) -> tuple[float, float | None]:
    """The mean and half of its 95 % interval, which one value does not have."""
    mean = statistics.fmean(values)
    if len(values) < 2:
        return mean, None
    t = T_975[min(len(values) - 2, len(T_975) - 1)]
    return mean, t * statistics.stdev(values) / math.sqrt(len(values))


def interval(values: Sequence[float], digits: int) -> str:
    """The mean and half of its 95 % interval, in words."""
    mean, half = spread(values)
    return f"{mean:.{digits}f}" if half is None else f"{mean:.{digits}f} ± {half:.{digits}f}"


def ran(command: Sequence[str], folder: str) -> dict[str, typing.Any]:
    """Makes a run, and reads its summary."""
    path = os.path.join(folder, "summary.json")
    done = subprocess.run([*command, "--json", path], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        words = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise Error(f"{shlex.join(command)} failed: {words[-1]}")
    with open(path) as file:
        found: dict[str, typing.Any] = json.load(file)
    os.remove(path)
    return found


def collided(summary: dict[str, typing.Any]) -> set[tuple[str, str]]:
    """Pairs that SUMO saw collide: the vehicle that ran into the other, and the other. There is a sample a step: of a pair, one is enough."""
    said = (sample.split(": ", 1)[1].split(" on ")[0].split(" and ") for sample in summary["sumo"]["collisions"])
    return {(first, second) for first, second in said}
