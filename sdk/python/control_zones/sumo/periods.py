"""Rates of arrivals by time, as the command line gives them."""

from __future__ import annotations

import typing


class Period(typing.NamedTuple):
    """A time with one rate of arrivals."""

    until_s: float
    vehicles_per_hour: float


def period(text: str) -> Period:
    """Reads `VPH`, vehicles an hour and road for 2 000 s, or `UNTIL_S:VPH`."""
    until, colon, rate = text.rpartition(":")
    return Period(float(until) if colon else 2000.0, float(rate))
