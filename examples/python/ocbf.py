"""The paper's optimal control with control barrier functions (OCBF), written from the equations.

Independent of the built-in law: reference trajectories from the roots of the quartic by numpy, the QP by
quadprog. Both drive the same trajectories to better than 1e-6.

    pip install ./sdk/python numpy quadprog
    cz run --controller merge-2="python3 examples/python/ocbf.py"
"""

import math
import os

import control_zones
import numpy
import quadprog
from control_zones import schemas as s


class Plan:
    """Optimal reference u*(t) = a t + b from the entry, for a terminal speed w (None: free)."""

    def __init__(self, beta, v0, length, w):
        self.w, self.v0 = w, v0
        if w is None:
            quartic = [beta, 0, -1.5 * v0**2, 6 * v0 * length, -4.5 * length**2]
        else:
            quartic = [beta, 0, -2 * (v0**2 + v0 * w + w**2), 12 * length * (v0 + w), -18 * length**2]
        roots = numpy.roots(quartic)
        slope = numpy.polyder(quartic)
        # Minima of the cost are the roots at which its derivative rises; the first can be driven forward.
        t = min(
            r.real
            for r in roots
            if abs(r.imag) < 1e-6 * abs(r) and r.real > 0 and numpy.polyval(slope, r.real) > 0
        )
        for _ in range(3):
            t -= numpy.polyval(quartic, t) / numpy.polyval(slope, t)
        excess = length - v0 * t
        if w is None:
            self.b = 3 * excess / t**2
            self.a = -self.b / t
        else:
            self.a = 6 * (w - v0) / t**2 - 12 * excess / t**3
            self.b = -2 * (w - v0) / t + 6 * excess / t**2
        self.T = t

    def x(self, t):
        return self.a * t**3 / 6 + self.b * t**2 / 2 + self.v0 * t

    def v(self, t):
        return self.a * t**2 / 2 + self.b * t + self.v0

    def reference(self, t, x):
        """Speed and acceleration where the plan is at the same position (one Newton step)."""
        t = min(max(t, 0.0), self.T)
        if self.v(t) > 1e-6:
            t = min(max(t - (self.x(t) - x) / self.v(t), 0.0), self.T)
        return self.v(t), self.a * t + self.b


class Ocbf:
    def attached(self, run):
        self.p = run.spec
        if self.p.law_flags != s.LAW_FEASIBILITY_ROWS | s.LAW_CLF:
            raise SystemExit("this example implements the scenario's default law only")
        self.plans = {}  # by (zone, vehicle)

    def __call__(self, zone):
        fields = (zone.vehicle, zone.x, zone.v, zone.entry_time, zone.entry_speed, zone.length, zone.terminal)
        u = numpy.empty(len(zone))
        for k, (vehicle, x, v, t0, v0, length, w) in enumerate(zip(*fields)):
            w = None if math.isnan(w) else w
            key = zone.zone, int(vehicle)
            u[k] = self.drive(key, zone.time, x, v, t0, v0, length, w, zone.partners[k])
        present = {(zone.zone, int(i)) for i in zone.vehicle}
        self.plans = {key: p for key, p in self.plans.items() if key[0] != zone.zone or key in present}
        return u

    def drive(self, key, time, x, v, t0, v0, length, w, partners):
        p = self.p
        phi, u_min = p.reaction_time_s, p.u_min_mps2
        rows = []  # (coefficient, bound): coefficient * u <= bound
        good = True
        for partner in partners:
            kind, xp, vp, up, at, gap = partner.kind, partner.x, partner.v, partner.u, partner.at, partner.gap
            if kind == s.CONSTRAINT_REAR_END:
                b = xp - x - phi * v - gap
                reserve = vp - v - phi * u_min
                bound = vp - v + p.k_rear_end_per_s * b
                good = good and b >= 0 and phi * u_min <= bound and reserve >= 0
                rows += [(phi, bound), (1.0, up + p.k_rear_end_per_s * reserve)]
                continue
            phi2 = phi / at  # a merge or a crossing, by its own distance
            b = xp - x - phi2 * x * v - gap
            drift = vp - v - phi2 * v * v
            reserve = drift - phi2 * x * u_min
            bound = drift + p.k_merge_per_s * b
            good = good and b >= 0 and phi2 * x * u_min <= bound and reserve >= 0
            rows += [(phi2 * x, bound)]
            rows += [(1 + 2 * phi2 * v, up - phi2 * v * u_min + p.k_merge_per_s * reserve)]
        plan = self.plans.get(key)
        if plan is None and not good and x <= p.fe_fraction * length:
            return u_min
        if plan is None or plan.w != w:
            plan = self.plans[key] = Plan(p.beta, v0, length, w)
        v_ref, u_ref = plan.reference(time - t0, x)
        y = v - v_ref
        rows += [(1.0, p.u_max_mps2), (-1.0, -u_min)]
        rows += [(1.0, p.k_speed_per_s * (p.v_max_mps - v)), (-1.0, -p.k_speed_per_s * (p.v_min_mps - v))]
        # min (u - u_ref)^2 / 2 + lambda e^2 over (u, e); the CLF row is 2 y u + eps y^2 <= e.
        c = [[-a for a, _ in rows] + [-2 * y], [0.0] * len(rows) + [1.0]]
        bounds = [-bound for _, bound in rows] + [p.clf_rate_per_s * y * y]
        g = numpy.diag([1.0, 2 * p.slack_weight])
        try:
            answer = quadprog.solve_qp(g, numpy.array([u_ref, 0.0]), numpy.array(c), numpy.array(bounds))
        except ValueError:  # no command satisfies all rows
            return u_min
        return min(max(answer[0][0], u_min), p.u_max_mps2)


class Traced(Ocbf):
    """The same, writing what it sees: for the test that compares it with the built-in law."""

    def __init__(self, path):
        self.file = open(path, "w")

    def __call__(self, zone):
        for state in zone.states:
            if not state["flags"] & s.STATE_LEFT:
                print(zone.step, state["vehicle"], repr(float(state["x_m"])), repr(float(state["v_mps"])),
                      sep=",", file=self.file)
        return super().__call__(zone)


trace = os.environ.get("CZ_TRACE")
control_zones.run(Traced(trace) if trace else Ocbf())
