"""Rates of arrivals by time, as the command line gives them."""

from __future__ import annotations

import argparse
import math
import typing

from .._session import Error

#: How long vehicles come where nothing is said, s.
WHOLE_S = 2000.0


class Period(typing.NamedTuple):
    """A time with one rate of arrivals."""

    until_s: float
    vehicles_per_hour: float


def period(text: str) -> Period:
    """Reads `VPH`, vehicles an hour and road, or `UNTIL_S:VPH`."""
    until, colon, rate = text.rpartition(":")
    try:
        read = Period(float(until) if colon else WHOLE_S, float(rate))
    except ValueError:
        read = Period(math.nan, math.nan)
    if not (0 < read.until_s < math.inf and 0 <= read.vehicles_per_hour <= 36000):
        raise argparse.ArgumentTypeError(f"{text!r}, expected [UNTIL_S:]VPH, such as 400 or 600:300, up to 36000 vehicles an hour")
    return read


def in_order(periods: list[Period]) -> list[Period]:
    """The same, if each ends after the one before."""
    for before, after in zip(periods, periods[1:]):
        if after.until_s <= before.until_s:
            raise Error(f"--rate: a period until {after.until_s:g} s follows one until {before.until_s:g} s, expected a later one")
    return periods
