"""What a controller sees of one zone."""

from __future__ import annotations

import ctypes
import functools
import typing

from . import _schemas as s

try:
    import numpy
except ImportError:  # lists take the place of arrays
    numpy = None  # type: ignore[assignment]

if typing.TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from ._session import Run

    Floats = NDArray[numpy.float64]
    Ids = NDArray[numpy.uint32]
    Flags = NDArray[numpy.bool_]

NAN = float("nan")


class Feedback(typing.NamedTuple):
    """What became of a command (`row` is not 0), or why a frame was refused (`rule` is not 0)."""

    #: `row`: what was to be applied, m/s^2. `rule`: what the field held (0 where it is no number).
    value: float
    #: The least and the greatest that was allowed; the shield's, where `row` says so.
    least: float
    greatest: float
    #: Step of the command; the vehicle, its zone (`schemas.NO_VEHICLE`, `NO_ZONE` where it is about none).
    step: int
    vehicle: int
    zone: int
    #: `row`: the vehicle toward which, or `schemas.NO_VEHICLE`.
    toward: int
    #: `rule`: place in the frame of the record at fault.
    record: int
    #: What bounded the command: `schemas.ROW_MERGE` and its like.
    row: int
    #: What was broken, `schemas.RULE_LIMITS` and its like, and by which field, `schemas.FIELD_U_MPS2` and its like.
    rule: int
    field: int

    @property
    def row_name(self) -> str:
        return _named("ROW_", self.row)

    @property
    def rule_name(self) -> str:
        return _named("RULE_", self.rule)

    @property
    def field_name(self) -> str:
        return _named("FIELD_", self.field)

    def __str__(self) -> str:
        return f"step {self.step}: {self._words()}"

    def _words(self) -> str:
        vehicle, value, least, greatest = self.vehicle, *map(_number, (self.value, self.least, self.greatest))
        if self.row == s.ROW_LIMITS:
            return f"u_mps2 of vehicle {vehicle} was not within its limits, {greatest} taken"
        if self.row != s.ROW_NONE:
            toward = "" if self.toward == s.NO_VEHICLE else f" toward {self.toward}"
            return f"vehicle {vehicle} was to have {value} m/s^2, at most {greatest} by {self.row_name}{toward}"
        known = {
            s.RULE_UNKNOWN: f"vehicle {vehicle} is in no zone",
            s.RULE_FOREIGN: f"vehicle {vehicle} is driven by another controller",
            s.RULE_TWICE: f"vehicle {vehicle} is commanded twice",
            s.RULE_MISSING: f"vehicle {vehicle} has no command at place {self.record} of the frame",
            s.RULE_UNASKED: "nobody asked for this answer",
        }.get(self.rule)
        if known is not None:
            return known
        field = self.field_name if vehicle == s.NO_VEHICLE else f"{self.field_name} of vehicle {vehicle}"
        if self.rule == s.RULE_NOT_FINITE:
            return f"{field} is no number"
        if self.rule == s.RULE_LIMITS:
            bound = f"at most {greatest}" if self.value > self.greatest else f"at least {least}"
            return f"{field} is {value}, {bound} allowed"
        if self.field in (s.FIELD_RUN_ID, s.FIELD_SCHEMA_HASH, s.FIELD_SENDER):
            return f"{field} is not the one expected"
        return f"{field} is {value}, expected {least}"


def feedback_of(record: s.Feedback) -> Feedback:
    """A record as it came."""
    return Feedback(*(getattr(record, name) for name in Feedback._fields))


def _number(value: float) -> str:
    return repr(float(value)).removesuffix(".0")


def _named(prefix: str, code: int) -> str:
    names = (name for name, value in vars(s).items() if name.startswith(prefix) and value == code)
    return next(names, f"{prefix}{code}").removeprefix(prefix).lower()


#: What is shown of a partner.
_PARTNER_FIELDS = ("x_m", "v_mps", "u_mps2", "planned_exit_time_s", "planned_exit_speed_mps")


class ZoneView:
    """One zone in one step, as far as this controller drives it.

    Arrays have one element per vehicle to be commanded, in passing order. They are copies, may be kept as long
    as one likes, and are read-only: what a function changed would be changed for whoever looks next. Make an
    array of your own where you need one: `err = zone.v - 15` or `v = zone.v.copy()`. Without numpy they are lists.

    Attributes:
        run: the run (`run.spec` has limits, gains and the step length).
        zone: index of the zone; name: its name.
        time: simulated time, s; dt: step length, s; step: its number.
        vehicle: ids.
        path: index of each vehicle's path.
        x, v, u: position since the zone's origin, m; speed, m/s; acceleration over the step just ended.
        entry_time, entry_speed: at the zone's origin, s and m/s.
        length: length of each vehicle's path, m.
        terminal: terminal speed to leave with, m/s; NaN where it is free.
        scheduled_at, scheduled_time: place on its path that a vehicle is scheduled for, m, and the instant before which
            it is not to be there, s; NaN where nothing is scheduled.
        ahead_x, ahead_v, ahead_u: the nearest vehicle ahead on the same way, in the vehicle's own coordinate; NaN
            where there is none.
        merge_x, merge_v, merge_u: the vehicle that passes the nearest conflict point first, in the vehicle's own
            coordinate; NaN where there is none.
        merge_at: distance of that conflict point on the vehicle's own path, m.
        partners: for each vehicle a list of all it must respect where they are now, each a `Partner`.
        entered: whether each vehicle has entered the zone in the step just ended.
        commanded: what this controller commanded each vehicle for the step just ended, m/s^2; NaN where it did not. What
            was applied is `u`, and the rest is the shield's, or what the speed limit allowed.
        bounded: for each vehicle what the shield found of that command where it did not let it pass, a `Feedback`, else None:
            `row` says what bounded it, `toward` which vehicle, and `greatest` is what it allowed, m/s^2.
        refusals: answers of this controller that the world refused since the last one it took, of all its zones, each a
            `Feedback` with field and rule.
        states: all records of the zone, index 0 (the vehicle that left it last) included.
        own: of each of those, whether it is a vehicle to be commanded.
        frame: the records of all zones.
        missed: whether the world put something in for a controller that was late in the step before.
        skipped: steps that have passed without this controller since its last answer.
        commands: the records that will be sent, the only array to be written to; `u_mps2` is filled from what
            the function returns, other fields, such as the planned exit, may be set here.
    """

    run: Run
    zone: int
    name: str
    step: int
    time: float
    dt: float
    states: typing.Any
    frame: typing.Any
    commands: typing.Any
    missed: bool
    skipped: int
    refusals: list[Feedback]

    def __init__(
        self,
        run: Run,
        zone: int,
        name: str,
        header: s.FrameHeader,
        states: typing.Any,
        own: slice | list[int],
        partners: Partners,
        commands: typing.Any,
        frame: typing.Any = None,
        skipped: int = 0,
        commanded: dict[int, float] | None = None,
        bounded: dict[int, Feedback] | None = None,
        refusals: list[Feedback] | None = None,
    ) -> None:
        self.run = run
        self.zone = zone
        self.name = name
        self.step = header.step
        self.time = header.time_ns * 1e-9
        self.dt = run.spec.dt_s
        self.states = states
        self.frame = states if frame is None else frame
        self.commands = commands
        self.missed = bool(header.flags & s.FLAG_MISSED)
        self.skipped = skipped
        self._commanded = commanded or {}
        self._bounded = bounded or {}
        self.refusals = refusals or []
        self._own = own
        self._partners = partners
        self._cache: dict[object, Floats] = {}
        self._partners_now: list[list[Partner]] | None = None
        self._nearest_now: dict[str, list[Partner | None]] = {}

    def __len__(self) -> int:
        return len(self.commands)

    def _once(self, key: object, make: Callable[[], Floats]) -> Floats:
        if key not in self._cache:
            self._cache[key] = frozen(make())
        return self._cache[key]

    def _field(self, name: str) -> Floats:
        def own() -> typing.Any:
            if numpy is not None:
                # A copy, so that whoever keeps it does not keep all records.
                return numpy.array(self.states[name][self._own])
            own = self._own
            places = range(*own.indices(len(self.states))) if isinstance(own, slice) else own
            return [getattr(self.states[i], name) for i in places]

        return self._once(name, own)

    def _ids(self, name: str) -> Ids:
        return typing.cast("Ids", self._field(name))

    @property
    def vehicle(self) -> Ids:
        return self._ids("vehicle")

    @property
    def path(self) -> Ids:
        return self._ids("path")

    @property
    def x(self) -> Floats:
        return self._field("x_m")

    @property
    def v(self) -> Floats:
        return self._field("v_mps")

    @property
    def u(self) -> Floats:
        return self._field("u_mps2")

    @property
    def entry_time(self) -> Floats:
        return self._field("entry_time_s")

    @property
    def entry_speed(self) -> Floats:
        return self._field("entry_speed_mps")

    @property
    def entered(self) -> Flags:
        def entered() -> typing.Any:
            flags = self._field("flags")
            if numpy is not None:
                return (flags.astype(int) & s.STATE_ENTERED) != 0
            return [bool(int(f) & s.STATE_ENTERED) for f in flags]

        return typing.cast("Flags", self._once("entered", entered))

    @property
    def own(self) -> Flags:
        def own() -> typing.Any:
            places = self._own
            count = len(self.states)
            if isinstance(places, slice):
                places = list(range(*places.indices(count)))
            if numpy is not None:
                mask = numpy.zeros(count, dtype=bool)
                mask[places] = True
                return mask
            known = set(places)
            return [i in known for i in range(count)]

        return typing.cast("Flags", self._once("own", own))

    @property
    def commanded(self) -> Floats:
        known = self._commanded
        return self._once("commanded", lambda: _array([known.get(int(v), NAN) for v in self.vehicle]))

    @property
    def bounded(self) -> list[Feedback | None]:
        return [self._bounded.get(int(v)) for v in self.vehicle]

    @property
    def length(self) -> Floats:
        lengths = self.run.lengths[self.zone]
        return self._once("length", lambda: _array([lengths[path] for path in self.path]))

    @property
    def terminal(self) -> Floats:
        return self._once("terminal", lambda: _array(self._partners.terminal))

    @property
    def scheduled_at(self) -> Floats:
        return self._once("scheduled_at", lambda: _array(self._partners.scheduled_at))

    @property
    def scheduled_time(self) -> Floats:
        return self._once("scheduled_time", lambda: _array(self._partners.scheduled_time))

    @property
    def ahead_x(self) -> Floats:
        return self._nearest("ahead", "x")

    @property
    def ahead_v(self) -> Floats:
        return self._nearest("ahead", "v")

    @property
    def ahead_u(self) -> Floats:
        return self._nearest("ahead", "u")

    @property
    def merge_x(self) -> Floats:
        return self._nearest("merge", "x")

    @property
    def merge_v(self) -> Floats:
        return self._nearest("merge", "v")

    @property
    def merge_u(self) -> Floats:
        return self._nearest("merge", "u")

    @property
    def merge_at(self) -> Floats:
        return self._nearest("merge", "at")

    @property
    def partners(self) -> list[list[Partner]]:
        if self._partners_now is None:
            self._partners_now = self._partners.now(self.states, self.x)
        return self._partners_now

    def _nearest(self, kind: str, field: str) -> Floats:
        found = self._nearest_now.get(kind)
        if found is None:
            if kind == "ahead":
                found = [min(_of(all_, True), key=_where, default=None) for all_ in self.partners]
            else:
                found = [min(_of(all_, False), key=_where_met, default=None) for all_ in self.partners]
            self._nearest_now[kind] = found
        return self._once((kind, field), lambda: _array([NAN if p is None else getattr(p, field) for p in found]))


class Partner(typing.NamedTuple):
    """A vehicle that another must respect."""

    #: `schemas.CONSTRAINT_REAR_END` (it drives ahead), `CONSTRAINT_MERGE` (it passes a merge first) or
    #: `CONSTRAINT_CROSS` (it crosses first).
    kind: int
    #: Its id.
    vehicle: int
    #: Its position in the vehicle's own coordinate, m; its speed, m/s; its acceleration, m/s^2.
    x: float
    v: float
    u: float
    #: Distance of the conflict point on the vehicle's path, m; means nothing toward a leader.
    at: float
    #: Distance to be kept to it beside phi v, m.
    gap: float
    #: Its place among `states` of the view.
    place: int
    #: Its broadcast intent: when it plans to reach the end of its path, s (0 without a plan), and how fast, m/s.
    exit_time: float
    exit_speed: float


def _of(partners: list[Partner], ahead: bool) -> list[Partner]:
    return [p for p in partners if (p.kind == s.CONSTRAINT_REAR_END) == ahead]


def _where(partner: Partner) -> float:
    return partner.x


def _where_met(partner: Partner) -> float:
    return partner.at


class Partners:
    """Who yields to whom in a zone, resolved to places in the zone's slice of the state frame.

    The slice keeps its shape until the zone's next event, and with that come new assignments.
    """

    def __init__(
        self, states: Sequence[s.VehicleState], own: list[int], assignments: Iterable[s.Assignment]
    ) -> None:
        places = {int(states[i].vehicle): i for i in range(len(states))}
        order = {int(states[i].vehicle): n for n, i in enumerate(own)}
        self.terminal = [NAN] * len(own)
        self.scheduled_at = [NAN] * len(own)
        self.scheduled_time = [NAN] * len(own)
        #: For each vehicle: place of the partner, its id, kind, distances of the point on the two paths, gap, and
        #: from which position of the partner on nothing is owed.
        self._owed: list[list[tuple[int, int, int, float, float, float, float]]] = [[] for _ in own]
        for a in assignments:
            k = order.get(a.vehicle)
            if k is None:
                continue
            if not a.flags & s.ASSIGNMENT_FREE_TERMINAL:
                self.terminal[k] = a.terminal_speed_mps
            if a.scheduled_time_s > 0:
                self.scheduled_at[k], self.scheduled_time[k] = a.scheduled_at_m, a.scheduled_time_s
            place = places.get(a.partner)
            if place is not None and a.kind != s.CONSTRAINT_NONE:
                owed = (place, a.partner, a.kind, a.own_conflict_m, a.partner_conflict_m, a.gap_m, a.until_m)
                self._owed[k].append(owed)

    def now(self, states: typing.Any, own_x: Iterable[float]) -> list[list[Partner]]:
        """What is owed where the vehicles are: for each a list of `Partner`."""
        if numpy is None:
            at = [tuple(getattr(r, name) for name in _PARTNER_FIELDS) for r in states]
        else:
            at = list(zip(*(states[name].tolist() for name in _PARTNER_FIELDS)))
        all_ = []
        for x_own, owed in zip(own_x, self._owed):
            partners = []
            for place, vehicle, kind, own_m, partner_m, gap, until in owed:
                x, v, u, exit_time, exit_speed = at[place]
                if x >= until or kind == s.CONSTRAINT_CROSS and x_own >= own_m:
                    continue
                # Behind the merge the one that passed it first is the leader.
                if kind == s.CONSTRAINT_MERGE and x_own >= own_m:
                    kind = s.CONSTRAINT_REAR_END
                where = x + own_m - partner_m
                partners.append(Partner(kind, vehicle, where, v, u, own_m, gap, place, exit_time, exit_speed))
            all_.append(partners)
        return all_


def _array(values: list[float]) -> Floats:
    return typing.cast("Floats", list(values)) if numpy is None else numpy.array(values, dtype=float)


def structured(records: ctypes.Array[typing.Any]) -> typing.Any:
    """A ctypes array of records as a numpy structured array over the same memory, where there is numpy."""
    if numpy is None:
        return records
    buffer: typing.Any = records
    dtype = _dtype(buffer._type_)
    # Numpy cannot make an array of an empty buffer.
    return numpy.frombuffer(buffer, dtype) if len(records) else numpy.zeros(0, dtype)


@functools.lru_cache(maxsize=None)
def _dtype(record: type[ctypes.Structure]) -> typing.Any:
    """The type of a record in numpy, made once, as making it takes longer than a step may."""
    return numpy.dtype(record)


def frozen(values: typing.Any) -> typing.Any:
    """The same, refusing to be written to, where that can be said of it."""
    if numpy is not None and isinstance(values, numpy.ndarray):
        values.setflags(write=False)
    return values
