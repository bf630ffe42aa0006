"""A world of one's own: who brings vehicles into Control Zones and moves them.

The library keeps the ledger of a run (zones, duties, gateway, shield, margins, frames); a `Traffic` is asked once a step what
every vehicle did. The contract is docs/world-contract.md; `control_zones.sumo` is one for SUMO.

    import sys
    import control_zones.world

    class Mine(control_zones.world.Traffic):
        name, brings = "mine", False
        ...

    sys.exit(control_zones.world.run(Mine(), sys.argv[1:]))

is a program for `cz run SCENARIO --world "python3 mine.py"`, and by itself `python3 mine.py run SCENARIO --in-process`.
"""

from __future__ import annotations

import ctypes
import json
import math
import struct
import typing

from ._library import load
from ._session import Error

if typing.TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

__all__ = ["GONE", "NONE", "Admitted", "Newcomer", "Task", "Traffic", "describe", "run"]

#: No road, or no route.
NONE = 2**32 - 1
#: What a vehicle did that is there no more: metres, m/s.
GONE = (math.nan, 0.0)

_TASK = struct.Struct("=dII")
_NEWCOMER = struct.Struct("=ddIIIIII")
_ADMITTED = struct.Struct("=ddIIIIII")


class Task(typing.NamedTuple):
    """What a vehicle is to do over a step."""

    #: Acceleration to hold, m/s^2, where it is to hold one.
    u_mps2: float
    vehicle: int
    #: 1 where it is to hold the acceleration, 0 where it drives at its own discretion.
    is_held: int


class Newcomer(typing.NamedTuple):
    """A vehicle that came during the step; see the contract."""

    x_m: float
    v_mps: float
    zone: int
    path: int
    road: int = NONE
    route: int = NONE
    kind: int = 0
    is_commanded: int = 1


class Admitted(typing.NamedTuple):
    """A vehicle that the scenario's gates have let in."""

    x_m: float
    v_mps: float
    vehicle: int
    kind: int
    road: int
    #: Zones and paths on its way out of the network.
    way: tuple[tuple[int, int], ...]


class Traffic:
    """Whoever brings vehicles in and moves them; to be derived from."""

    #: What it is called in reports.
    name: str = "traffic"
    #: Whether it brings its vehicles itself; otherwise the scenario's roads do, and `admit` tells of them.
    brings: bool = True

    def begin(self, scenario: dict[str, typing.Any]) -> None:
        """Told once, before anything else, what is played: the scenario as `describe` has it, `dt_ns` among it."""

    def step(self, step: int, tasks: Sequence[tuple[float, int, int]]) -> tuple[Iterable[float], Sequence[Newcomer], bool]:
        """Makes one step.

        `tasks` are tuples like `Task`, in order of vehicle. Returns for each of them, one after the other, how far it has come,
        m (`GONE` when it is there no more), and its speed, m/s; who came during the step; and whether more may come.
        """
        raise NotImplementedError

    def admit(self, vehicles: Sequence[Admitted]) -> Sequence[bool]:
        """Puts vehicles where the gates have let them in at the end of the step; returns which of them are commanded."""
        raise NotImplementedError


_STEP = ctypes.CFUNCTYPE(
    ctypes.c_int,
    ctypes.c_void_p,
    ctypes.c_uint64,
    ctypes.c_uint32,
    ctypes.c_void_p,
    ctypes.c_void_p,
    ctypes.c_uint32,
    ctypes.c_void_p,
    ctypes.POINTER(ctypes.c_uint32),
)
_ADMIT = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_void_p, ctypes.c_void_p)
_BEGIN = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_char_p)


class _Callbacks(ctypes.Structure):
    _fields_ = [
        ("context", ctypes.c_void_p),
        ("step", _STEP),
        ("admit", _ADMIT),
        ("brings", ctypes.c_int),
        ("begin", _BEGIN),
    ]


def run(traffic: Traffic, arguments: Sequence[str]) -> int:
    """A run (`run SCENARIO --in-process …`), or the world of one (`world …`), whose vehicles `traffic` moves.

    Returns the exit code of `cz`; raises what the traffic raised.
    """
    library = load()
    raised: list[BaseException] = []
    waiting: list[Newcomer] = []

    def begin(_: object, scenario: bytes) -> None:
        try:
            traffic.begin(json.loads(scenario))
        except BaseException as error:  # noqa: BLE001 - the first step says so
            raised.append(error)

    def step(
        _: object, number: int, count: int, tasks: int, done: int, room: int, newcomers: int, came: typing.Any
    ) -> int:
        if raised:
            return -1
        try:
            told = ctypes.string_at(tasks, count * _TASK.size) if count else b""
            did, new, comes = traffic.step(number, list(_TASK.iter_unpack(told)))
            words = struct.pack(f"={2 * count}d", *did)
            ctypes.memmove(done, words, len(words))
            waiting.extend(new)
            now, waiting[:] = waiting[:room], waiting[room:]
            packed = b"".join(_NEWCOMER.pack(*newcomer) for newcomer in now)
            ctypes.memmove(newcomers, packed, len(packed))
            came[0] = len(now)
            return 0 if comes or waiting else 1
        except BaseException as error:  # noqa: BLE001 - it goes on behind the library
            raised.append(error)
            return -1

    def admit(_: object, count: int, vehicles: int, ways: int) -> int:
        try:
            records = list(_ADMITTED.iter_unpack(ctypes.string_at(vehicles, count * _ADMITTED.size)))
            hops = sum(record[5] for record in records)
            flat = iter(struct.iter_unpack("=II", ctypes.string_at(ways, 8 * hops)))
            told = []
            for x_m, v_mps, vehicle, kind, road, length, _, _ in records:
                way = tuple((zone, path) for zone, path in (next(flat) for _ in range(length)))
                told.append(Admitted(x_m, v_mps, vehicle, kind, road, way))
            commanded = traffic.admit(told)
            for at, (record, is_commanded) in enumerate(zip(records, commanded)):
                packed = _ADMITTED.pack(*record[:6], int(is_commanded), 0)
                ctypes.memmove(vehicles + at * _ADMITTED.size, packed, len(packed))
            return 0
        except BaseException as error:  # noqa: BLE001 - it goes on behind the library
            raised.append(error)
            return -1

    if any("\n" in argument for argument in arguments):
        raise Error("an argument has a line break in it")
    library.cz_world_run.restype = ctypes.c_int
    library.cz_world_run.argtypes = [ctypes.c_char_p, ctypes.c_char_p, ctypes.POINTER(_Callbacks)]
    # Who does not ask what is played is not told: of a great network that is a long text.
    wants = type(traffic).begin is not Traffic.begin
    callbacks = _Callbacks(None, _STEP(step), _ADMIT(admit), int(traffic.brings), _BEGIN(begin if wants else 0))
    lines = "\n".join(arguments).encode()
    code = int(library.cz_world_run(traffic.name.encode(), lines, ctypes.byref(callbacks)))
    if raised:
        raise raised[0]
    return code


def describe(scenario: str | None, sets: Iterable[str] = ()) -> dict[str, typing.Any]:
    """A scenario as the library reads it: `scenario`, and `shapes` by zone and segment.

    Raises `Error` when it cannot be loaded.
    """
    library = load()
    library.cz_world_scenario.restype = ctypes.c_void_p
    library.cz_world_scenario.argtypes = [ctypes.c_char_p, ctypes.c_char_p]
    library.cz_env_error.restype = ctypes.c_char_p
    library.cz_env_forget.argtypes = [ctypes.c_void_p]
    given = None if scenario is None else scenario.encode()
    told = library.cz_world_scenario(given, "\n".join(sets).encode())
    if told is None:
        raise Error(library.cz_env_error().decode(errors="replace"))
    described: dict[str, typing.Any] = json.loads(ctypes.string_at(told))
    library.cz_env_forget(told)
    return described
