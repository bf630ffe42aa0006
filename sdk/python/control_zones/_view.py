"""What a controller sees of one zone."""

from . import _schemas as s

try:
    import numpy
except ImportError:  # lists take the place of arrays
    numpy = None

NAN = float("nan")
#: Records in a zone's slice that are not members.
_LEFT = s.STATE_LEFT


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
        path: index of each vehicle's approach.
        x, v, u: position since the zone's origin, m; speed, m/s; acceleration over the step just ended.
        entry_time, entry_speed: at the zone's origin, s and m/s.
        length: length of each vehicle's approach, m.
        terminal: terminal speed to leave with, m/s; NaN where it is free.
        ahead_x, ahead_v, ahead_u: the vehicle ahead on the same path; NaN where there is none.
        merge_x, merge_v, merge_u: the vehicle of another path that passes the conflict point first,
            in the vehicle's own coordinate; NaN where there is none.
        merge_at: distance of the conflict point on the vehicle's own path, m.
        states: all records of the zone, index 0 (the vehicle that left it last) included.
        commands: the records that will be sent, the only array to be written to; `u_mps2` is filled from what
            the function returns, other fields, such as the planned exit, may be set here.
    """

    def __init__(self, run, zone, name, header, states, own, partners, commands):
        self.run = run
        self.zone = zone
        self.name = name
        self.step = header.step
        self.time = header.time_ns * 1e-9
        self.dt = run.spec.dt_s
        self.states = states
        self.commands = commands
        self._own = own
        self._partners = partners
        self._cache = {}

    def __len__(self):
        return len(self.commands)

    def _once(self, key, make):
        if key not in self._cache:
            self._cache[key] = frozen(make())
        return self._cache[key]

    def _field(self, name):
        def own():
            if numpy is not None:
                # A copy, so that whoever keeps it does not keep all records.
                return numpy.array(self.states[name][self._own])
            own = self._own
            places = range(*own.indices(len(self.states))) if isinstance(own, slice) else own
            return [getattr(self.states[i], name) for i in places]

        return self._once(name, own)

    vehicle = property(lambda self: self._field("vehicle"))
    path = property(lambda self: self._field("path"))
    x = property(lambda self: self._field("x_m"))
    v = property(lambda self: self._field("v_mps"))
    u = property(lambda self: self._field("u_mps2"))
    entry_time = property(lambda self: self._field("entry_time_s"))
    entry_speed = property(lambda self: self._field("entry_speed_mps"))

    @property
    def length(self):
        lengths = self.run.lengths[self.zone]
        return self._once("length", lambda: _array([lengths[path] for path in self.path]))

    @property
    def terminal(self):
        return self._once("terminal", lambda: _array(self._partners.terminal))

    ahead_x = property(lambda self: self._partner("ahead", "x_m"))
    ahead_v = property(lambda self: self._partner("ahead", "v_mps"))
    ahead_u = property(lambda self: self._partner("ahead", "u_mps2"))
    merge_x = property(lambda self: self._partner("merge", "x_m"))
    merge_v = property(lambda self: self._partner("merge", "v_mps"))
    merge_u = property(lambda self: self._partner("merge", "u_mps2"))

    @property
    def merge_at(self):
        return self._once("merge_at", lambda: _array(self._partners.merge_at))

    def _partner(self, kind, field):
        def partners():
            p = self._partners
            places = p.ahead if kind == "ahead" else p.merge
            shifts = p.merge_shift if kind == "merge" and field == "x_m" else [0.0] * len(places)
            if numpy is None:
                return [
                    getattr(self.states[i], field) + shift if i >= 0 else NAN for i, shift in zip(places, shifts)
                ]
            places = numpy.asarray(places, dtype=int)
            values = numpy.full(len(places), NAN)
            there = places >= 0
            values[there] = self.states[field][places[there]]
            return values + numpy.asarray(shifts)

        return self._once((kind, field), partners)


class Partners:
    """Who yields to whom in a zone, resolved to places in the zone's slice of the state frame.

    The slice keeps its shape until the zone's next event, and with that come new assignments.
    """

    def __init__(self, states, own, assignments):
        places = {int(states[i].vehicle): i for i in range(len(states))}
        order = {int(states[i].vehicle): n for n, i in enumerate(own)}
        n = len(own)
        self.terminal = [NAN] * n
        self.ahead = [-1] * n
        self.merge = [-1] * n
        self.merge_shift = [0.0] * n
        self.merge_at = [NAN] * n
        for a in assignments:
            k = order.get(a.vehicle)
            if k is None:
                continue
            if not a.flags & s.ASSIGNMENT_FREE_TERMINAL:
                self.terminal[k] = a.terminal_speed_mps
            if a.kind == s.CONSTRAINT_REAR_END:
                self.ahead[k] = places.get(a.partner, -1)
            elif a.kind == s.CONSTRAINT_MERGE:
                self.merge[k] = places.get(a.partner, -1)
                self.merge_shift[k] = a.own_conflict_m - a.partner_conflict_m
                self.merge_at[k] = a.own_conflict_m


def _array(values):
    return list(values) if numpy is None else numpy.array(values, dtype=float)


def structured(records):
    """A ctypes array of records as a numpy structured array over the same memory, where there is numpy."""
    if numpy is None:
        return records
    if not len(records):
        return numpy.zeros(0, dtype=numpy.dtype(records._type_))
    return numpy.ctypeslib.as_array(records)


def frozen(values):
    """The same, refusing to be written to, where that can be said of it."""
    if numpy is not None and isinstance(values, numpy.ndarray):
        values.setflags(write=False)
    return values
