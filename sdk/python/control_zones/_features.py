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
    }

    def where_there_is(name: str, there: NDArray[numpy.bool_], values: dict[str, NDArray[numpy.float64]]) -> None:
        columns[f"has_{name}"] = there
        columns.update({key: numpy.where(there, value, 0.0) for key, value in values.items()})

    where_there_is("terminal", ~numpy.isnan(zone.terminal), {"terminal_mps": zone.terminal})
    scheduled = {"scheduled_in_m": zone.scheduled_at - x, "scheduled_in_s": zone.scheduled_time - zone.time}
    where_there_is("schedule", ~numpy.isnan(zone.scheduled_at), scheduled)
    ahead = {"ahead_m": zone.ahead_x - x, "ahead_mps": zone.ahead_v - v, "ahead_mps2": zone.ahead_u}
    where_there_is("ahead", ~numpy.isnan(zone.ahead_x), ahead)
    merge = {"merge_m": zone.merge_x - x, "merge_mps": zone.merge_v - v, "merge_mps2": zone.merge_u}
    where_there_is("merge", ~numpy.isnan(zone.merge_x), {**merge, "merge_in_m": zone.merge_at - x})
    rows = numpy.zeros((len(zone), len(FEATURES)))
    for at, name in enumerate(FEATURES[:-1]):
        rows[:, at] = columns[name]
    return rows
