"""SUMO in this process, and vehicles of it that are driven by acceleration."""

from __future__ import annotations

import os
import random
import time
import typing
from dataclasses import dataclass, field

from .._session import Error

if typing.TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ..world import Admitted, Newcomer, Traffic

try:
    import libsumo
    import sumolib
except ImportError as error:
    raise Error(f"SUMO is missing ({error}); pip install 'control-zones[sumo]' installs it") from error

#: Speeds are ours alone: none of SUMO's checks of distance, acceleration, right of way, red lights or limits.
OURS = 32 + 64
#: What SUMO does by itself, of speeds and of lanes.
SUMOS, SUMOS_LANES = 31, 1621
#: Lane changes: none.
NO_CHANGES = 0


@dataclass
class Totals:
    """What SUMO has to say of a run."""

    collisions: list[str] = field(default_factory=list)
    teleports: int = 0
    departed: int = 0
    arrived: int = 0
    #: Vehicle-steps, and the wall time of SUMO's own stepping and of all the rest of this package, s.
    vehicle_steps: int = 0
    sumo_s: float = 0.0
    adapter_s: float = 0.0
    #: Sum and number of travel times from the first step seen to the last, s.
    travel_s: float = 0.0


class Simulation:
    """A started SUMO."""

    def __init__(self, options: Sequence[str], dt_s: float, seed: int) -> None:
        home = sumolib_home()
        os.environ.setdefault("SUMO_HOME", home)
        own = ["--step-length", repr(dt_s), "--step-method.ballistic", "true", "--seed", str(seed)]
        own += ["--collision.action", "warn", "--collision.mingap-factor", "0", "--collision.check-junctions", "true"]
        own += ["--no-step-log", "true", "--duration-log.disable", "true", "--no-warnings", "true"]
        try:
            libsumo.start(["sumo", *own, *options])
        except Exception as error:  # noqa: BLE001 - libsumo has several of its own
            raise Error(f"SUMO does not start: {error}") from error
        self.dt_s = dt_s
        self.totals = Totals()
        self.began_s: dict[str, float] = {}
        self.driven: set[str] = set()
        #: Odometer and speed after the last step, of those who are asked about.
        self.last: dict[str, tuple[float, float]] = {}
        self.gone: set[str] = set()

    def hold(self, vehicle: str, u_mps2: float) -> None:
        """Has a vehicle hold an acceleration over the next step; it stops rather than reverse."""
        if vehicle not in self.driven:
            self.driven.add(vehicle)
            libsumo.vehicle.setSpeedMode(vehicle, OURS)
            libsumo.vehicle.setLaneChangeMode(vehicle, NO_CHANGES)
        libsumo.vehicle.setSpeed(vehicle, max(0.0, self.last[vehicle][1] + u_mps2 * self.dt_s))

    def release(self, vehicle: str) -> None:
        """Leaves a vehicle to SUMO's own driver."""
        if vehicle in self.driven:
            self.driven.discard(vehicle)
            if vehicle not in self.gone:
                libsumo.vehicle.setSpeed(vehicle, -1.0)
                libsumo.vehicle.setSpeedMode(vehicle, SUMOS)
                libsumo.vehicle.setLaneChangeMode(vehicle, SUMOS_LANES)

    def see(self, vehicle: str) -> None:
        """Begins to follow a vehicle."""
        self.last[vehicle] = (libsumo.vehicle.getDistance(vehicle), libsumo.vehicle.getSpeed(vehicle))

    def step(self) -> None:
        """One step of SUMO."""
        began = time.perf_counter()
        libsumo.simulationStep()
        self.totals.sumo_s += time.perf_counter() - began
        simulation = libsumo.simulation
        now_s = simulation.getTime()
        for vehicle in simulation.getDepartedIDList():
            self.began_s[vehicle] = now_s
            self.totals.departed += 1
        left = list(simulation.getArrivedIDList())
        for vehicle in left:
            self.totals.arrived += 1
            self.totals.travel_s += now_s - self.began_s.pop(vehicle, now_s)
        jumped = list(simulation.getStartingTeleportIDList())
        self.totals.teleports += len(jumped)
        self.gone = {*left, *jumped}
        self.driven -= self.gone
        for collision in simulation.getCollisions():
            said = f"{now_s:.1f} s: {collision.collider} and {collision.victim} on {collision.lane} ({collision.type})"
            self.totals.collisions.append(said)
        self.totals.vehicle_steps += libsumo.vehicle.getIDCount()

    def moved(self, vehicle: str) -> tuple[float, float] | None:
        """How far one that is followed has come over the step, m, and its speed, m/s; `None` when it is gone."""
        if vehicle in self.gone or vehicle not in self.last:
            self.last.pop(vehicle, None)
            return None
        before_m = self.last[vehicle][0]
        now_m, v_mps = libsumo.vehicle.getDistance(vehicle), max(0.0, libsumo.vehicle.getSpeed(vehicle))
        self.last[vehicle] = (now_m, v_mps)
        return max(0.0, now_m - before_m), v_mps

    def time_calls(self, traffic: Traffic) -> None:
        """Counts what a traffic's calls take beside SUMO's own steps."""
        make, let_in = traffic.step, traffic.admit

        def step(number: int, tasks: Sequence[tuple[float, int, int]]) -> tuple[Iterable[float], Sequence[Newcomer], bool]:
            began, before_s = time.perf_counter(), self.totals.sumo_s
            result = make(number, tasks)
            self.totals.adapter_s += time.perf_counter() - began - (self.totals.sumo_s - before_s)
            return result

        def admit(vehicles: Sequence[Admitted]) -> Sequence[bool]:
            began = time.perf_counter()
            result = let_in(vehicles)
            self.totals.adapter_s += time.perf_counter() - began
            return result

        traffic.step, traffic.admit = step, admit  # type: ignore[method-assign, assignment]

    def close(self) -> None:
        """Ends SUMO, which then writes what it was asked to."""
        libsumo.close()


def sumolib_home() -> str:
    """Where the wheel has put SUMO."""
    import sumo

    return str(os.path.dirname(sumo.__file__))


def program(name: str) -> str:
    """The path of one of SUMO's programs."""
    return os.path.join(sumolib_home(), "bin", name)


def is_automated(seed: int, vehicle: str | int, share: float) -> bool:
    """Whether a vehicle is one of the share that is automated; the more are, the same ones and others."""
    return random.Random(f"{seed}/{vehicle}").random() < share


def read_net(path: str) -> typing.Any:
    """A network with its internal lanes."""
    try:
        return sumolib.net.readNet(path, withInternal=True)
    except Exception as error:  # noqa: BLE001 - sumolib raises whatever its parser does
        raise Error(f"{path}: the network cannot be read: {error}") from error
