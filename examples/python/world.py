"""A world of one's own: vehicles that hold their accelerations exactly, moved by this program.

    cz world check -- python3 examples/python/world.py
    cz run intersection --world "python3 examples/python/world.py"
    python3 examples/python/world.py run intersection --in-process
"""

from __future__ import annotations

import sys
import typing

import control_zones.world

if typing.TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from control_zones.world import Admitted, Newcomer


class Points(control_zones.world.Traffic):
    """Vehicles as points with a speed; the scenario's own roads and gates let them in."""

    name, brings = "points", False

    def begin(self, scenario: dict[str, typing.Any]) -> None:
        self.dt_s = scenario["dt_ns"] * 1e-9
        self.speeds_mps: dict[int, float] = {}

    def step(self, step: int, tasks: Sequence[tuple[float, int, int]]) -> tuple[Iterable[float], Sequence[Newcomer], bool]:
        did: list[float] = []
        now: dict[int, float] = {}
        for u_mps2, vehicle, is_held in tasks:
            v_mps, u = self.speeds_mps[vehicle], u_mps2 if is_held else 0.0
            end_mps = v_mps + u * self.dt_s
            # It stops rather than reverse.
            advanced_m = 0.5 * (v_mps + end_mps) * self.dt_s if end_mps >= 0.0 else v_mps * v_mps / (-2.0 * u)
            now[vehicle] = max(0.0, end_mps)
            did += [advanced_m, now[vehicle]]
        self.speeds_mps = now
        return did, (), False

    def admit(self, vehicles: Sequence[Admitted]) -> Sequence[bool]:
        self.speeds_mps.update((admitted.vehicle, admitted.v_mps) for admitted in vehicles)
        return [True] * len(vehicles)


if __name__ == "__main__":
    sys.exit(control_zones.world.run(Points(), sys.argv[1:]))
