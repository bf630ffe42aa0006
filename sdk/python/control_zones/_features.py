"""What an environment's observation has, of what a controller sees."""

from __future__ import annotations

import typing

if typing.TYPE_CHECKING:
    import numpy
    from numpy.typing import NDArray

    from ._view import ZoneView

#: The columns, as `control_zones.env` has them; env/src/run.rs says what they are.
FEATURES = (
    "present",
    "path",
    "x_m",
    "v_mps",
    "u_mps2",
    "remaining_m",
    "in_zone_s",
    "has_terminal",
    "terminal_mps",
    "has_schedule",
    "scheduled_in_m",
    "scheduled_in_s",
    "has_ahead",
    "ahead_m",
    "ahead_mps",
    "ahead_mps2",
    "has_merge",
    "merge_m",
    "merge_mps",
    "merge_mps2",
    "merge_in_m",
    "law_mps2",
)


def features(zone: ZoneView) -> NDArray[numpy.float64]:
    """A row per vehicle and a column per feature, as an environment of `control_zones.env` would show this zone: what was
    trained there drives here. What the law would do is not known to a controller; that column is 0. Needs numpy.
    """
    import numpy

    x, v = zone.x, zone.v
    columns: dict[str, typing.Any] = {
        "present": 1.0,
        "path": zone.path,
        "x_m": x,
        "v_mps": v,
        "u_mps2": zone.u,
        "remaining_m": zone.length - x,
        "in_zone_s": zone.time - zone.entry_time,
        "has_terminal": ~numpy.isnan(zone.terminal),
        "terminal_mps": zone.terminal,
        "has_schedule": ~numpy.isnan(zone.scheduled_at),
        "scheduled_in_m": zone.scheduled_at - x,
        "scheduled_in_s": zone.scheduled_time - zone.time,
        "has_ahead": ~numpy.isnan(zone.ahead_x),
        "ahead_m": zone.ahead_x - x,
        "ahead_mps": zone.ahead_v - v,
        "ahead_mps2": zone.ahead_u,
        "has_merge": ~numpy.isnan(zone.merge_x),
        "merge_m": zone.merge_x - x,
        "merge_mps": zone.merge_v - v,
        "merge_mps2": zone.merge_u,
        "merge_in_m": zone.merge_at - x,
    }
    rows = numpy.zeros((len(zone), len(FEATURES)))
    for at, name in enumerate(FEATURES[:-1]):
        rows[:, at] = columns[name]
    # Where there is nothing of the kind.
    rows[numpy.isnan(rows)] = 0.0
    return rows
