"""@NAME@: goes for the terminal speed, and keeps its distance to all it must respect."""

import control_zones


class Controller:
    """One acceleration per vehicle, m/s^2, for each zone and step."""

    def attached(self, run):
        """Called once, before the first step: limits and gains are in `run.spec`."""
        self.spec = run.spec

    def __call__(self, zone):
        return [self.decide(zone, i) for i in range(len(zone))]

    def decide(self, zone, i):
        x, v, terminal = zone.x[i], zone.v[i], zone.terminal[i]
        # NaN where the terminal speed is free.
        u = 0.6 * ((terminal if terminal == terminal else 18.0) - v)
        for partner in zone.partners[i]:
            gap = partner.x - x - partner.gap - self.spec.reaction_time_s * v
            u = min(u, 0.4 * gap + 1.2 * (partner.v - v))
        return max(self.spec.u_min_mps2, min(u, self.spec.u_max_mps2))

    def on_end(self, summary):
        """Called when the run is over."""
        print(f"{summary.answered} steps answered, {summary.skipped} passed without this controller")


control_zones.run(Controller())
