"""Write a controller for Control Zones in Python.

A controller is a function from a view of one zone to one acceleration per vehicle:

    import control_zones

    def cruise(zone):
        spec = zone.run.spec
        return (15.0 - zone.v).clip(spec.u_min_mps2, spec.u_max_mps2)

    control_zones.run(cruise)

Start it with `cz run --controller merge-2="python3 cruise.py"`. The loop, joining the run and the checks of
every frame are in `run`; `Session` is the same without a loop. Arrays are read-only numpy arrays, copies that
may be kept, where numpy is installed, and lists where it is not.
"""

from . import _schemas as schemas
from ._features import features
from ._session import Error, Run, Session, Summary, run
from ._view import Feedback, Partner, ZoneView

__all__ = ["Error", "Feedback", "Partner", "Run", "Session", "Summary", "ZoneView", "features", "run", "schemas"]
