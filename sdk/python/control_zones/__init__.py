"""Write a controller for Control Zones in Python.

A controller is a function from a view of one zone to one acceleration per vehicle:

    import control_zones

    def cruise(zone):
        return 15.0 - zone.v

    control_zones.run(cruise)

Start it with `cz run --controller merge-2="python3 cruise.py"`. The loop, joining the run and the checks of
every frame are in `run`; `Session` is the same without a loop. Arrays are numpy views of shared memory
where numpy is installed, and lists where it is not.
"""

from . import _schemas as schemas
from ._session import Error, Run, Session, run
from ._view import ZoneView

__all__ = ["Error", "Run", "Session", "ZoneView", "run", "schemas"]
