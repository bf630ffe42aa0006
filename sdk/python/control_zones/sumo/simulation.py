"""SUMO in this process, and vehicles of it that are driven by acceleration."""

from __future__ import annotations

import os
import random
import subprocess
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
#: Not into whoever is ahead, but through a junction without asking for the right of way: neither of those who come nor of those within.
THROUGH = 1 + 2 + 4 + 32
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
    #: Pairs that collided, with how many of the two were driven by acceleration then.
    pairs: dict[tuple[str, str], int] = field(default_factory=dict)
    #: Vehicle-steps, and the wall time of SUMO's own stepping and of all the rest of this package, s.
    vehicle_steps: int = 0
    sumo_s: float = 0.0
    adapter_s: float = 0.0
    #: Sum and number of travel times from the first step seen to the last, s.
    travel_s: float = 0.0


class Car:
    """A vehicle that is followed."""

    __slots__ = ("advanced_m", "beyond", "distance_m", "is_driven", "lane", "length_m", "name", "number", "path", "seen", "v_mps", "x_m", "zone")

    def __init__(self, name: str) -> None:
        self.name = name
        #: Odometer, m, and speed, m/s, after the step in which it was seen last, and how far it came in that, m.
        self.distance_m, self.v_mps, self.advanced_m, self.seen = 0.0, 0.0, 0.0, -1
        #: Whether it is driven by acceleration.
        self.is_driven = False
        #: Where it is a member of a zone: its number there (-1: nowhere), its way, and how far it has come on that, m.
        self.number, self.zone, self.path, self.length_m, self.x_m = -1, 0, 0, 0.0, 0.0
        #: The lane on which it was seen last outside of zones, or on which it left one; and the same where that zone knows of it.
        self.lane = self.beyond = ""


class Simulation:
    """A started SUMO.

    Calls into libsumo take a quarter of a microsecond each; a subscription to two values makes SUMO's step longer by 4 us a vehicle.
    """

    def __init__(self, options: Sequence[str], dt_s: float, seed: int) -> None:
        milliseconds = 1e3 * dt_s
        if not (1.0 <= milliseconds <= 1e3 and abs(milliseconds - round(milliseconds)) < 1e-6):
            raise Error(f"--step-length is {dt_s} s, expected whole milliseconds up to 1 s: SUMO's time has no others")
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
        self.now = 0
        #: Those who came into the network in the last step, or back into it, and those who are there no more since.
        self.came: list[str] = []
        self.gone: set[str] = set()
        #: Who is driven by acceleration.
        self.driven: set[str] = set()

    def hold(self, car: Car, u_mps2: float) -> None:
        """Has a vehicle hold an acceleration over the next step; it stops rather than reverse."""
        if not car.is_driven:
            car.is_driven = True
            self.driven.add(car.name)
            libsumo.vehicle.setSpeedMode(car.name, OURS)
            libsumo.vehicle.setLaneChangeMode(car.name, NO_CHANGES)
        v_mps = car.v_mps + u_mps2 * self.dt_s
        if v_mps < 0.0:
            # SUMO brakes to a standstill over the whole step, and so comes further than with this braking.
            libsumo.vehicle.setPreviousSpeed(car.name, car.v_mps * car.v_mps / (-u_mps2 * self.dt_s))
            v_mps = 0.0
        libsumo.vehicle.setSpeed(car.name, v_mps)

    def release(self, car: Car, mode: int = SUMOS) -> None:
        """Leaves a vehicle to SUMO's own driver, with these of its checks."""
        if car.is_driven:
            car.is_driven = False
            self.driven.discard(car.name)
            if car.name not in self.gone:
                libsumo.vehicle.setSpeed(car.name, -1.0)
                libsumo.vehicle.setSpeedMode(car.name, mode)
                libsumo.vehicle.setLaneChangeMode(car.name, SUMOS_LANES)

    def see(self, car: Car) -> None:
        """Begins to follow a vehicle, from where it is after the last step."""
        if car.seen != self.now:
            car.distance_m, car.v_mps = libsumo.vehicle.getDistance(car.name), libsumo.vehicle.getSpeed(car.name)
            car.seen = self.now

    def step(self) -> None:
        """One step of SUMO."""
        began = time.perf_counter()
        libsumo.simulationStep()
        self.totals.sumo_s += time.perf_counter() - began
        self.now += 1
        simulation = libsumo.simulation
        now_s = simulation.getTime()
        self.came = list(simulation.getDepartedIDList())
        for vehicle in self.came:
            self.began_s[vehicle] = now_s
            self.totals.departed += 1
        left = simulation.getArrivedIDList()
        for vehicle in left:
            self.totals.arrived += 1
            self.totals.travel_s += now_s - self.began_s.pop(vehicle, now_s)
        jumped = simulation.getStartingTeleportIDList()
        self.totals.teleports += len(jumped)
        self.came += simulation.getEndingTeleportIDList()
        self.gone = {*left, *jumped}
        for collision in simulation.getCollisions():
            said = f"{now_s:.1f} s: {collision.collider} and {collision.victim} on {collision.lane} ({collision.type})"
            self.totals.collisions.append(said)
            pair = (collision.collider, collision.victim)
            self.totals.pairs.setdefault(pair, sum(name in self.driven for name in pair))
        self.totals.vehicle_steps += libsumo.vehicle.getIDCount()

    def moves(self, car: Car) -> bool:
        """Takes how far one that is followed has come over the step, and its speed; `False` when it is gone."""
        if car.seen == self.now:
            return True
        if car.name in self.gone:
            return False
        before_m, v_mps = car.distance_m, libsumo.vehicle.getSpeed(car.name)
        car.distance_m = libsumo.vehicle.getDistance(car.name)
        car.v_mps = v_mps if v_mps > 0.0 else 0.0
        car.advanced_m = car.distance_m - before_m if car.distance_m > before_m else 0.0
        car.seen = self.now
        return True

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


def make(name: str, *arguments: str) -> None:
    """Has one of SUMO's programs make files."""
    done = subprocess.run([program(name), *arguments], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise Error(f"{name}: {(done.stderr or done.stdout).strip()}")


def is_automated(seed: int, vehicle: str | int, share: float) -> bool:
    """Whether a vehicle is one of the share that is automated; the more are, the same ones and others."""
    return random.Random(f"{seed}/{vehicle}").random() < share


def read_net(path: str) -> typing.Any:
    """A network with its internal lanes."""
    try:
        return sumolib.net.readNet(path, withInternal=True)
    except Exception as error:  # noqa: BLE001 - sumolib raises whatever its parser does
        raise Error(f"{path}: the network cannot be read: {error}") from error
