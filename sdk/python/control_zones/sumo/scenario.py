"""Zones as a scenario file."""

from __future__ import annotations

import math
import typing

if typing.TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from .network import Zone


#: The least extent of a crossing in a scenario, and a little, m.
LEAST_M = 0.11


class Kind(typing.NamedTuple):
    """A kind of vehicle: what of a SUMO vehicle type a scenario knows."""

    name: str
    length_m: float
    u_min_mps2: float
    u_max_mps2: float
    #: Where it is below that of the roads.
    v_max_mps: float = math.inf


def text(
    name: str,
    zones: Sequence[Zone],
    kinds: Sequence[Kind],
    *,
    seed: int,
    dt_s: float,
    end_s: float,
    v_max_mps: float,
    rates: Mapping[str, float] | None = None,
    speed_mps: float = 0.0,
    about: str,
) -> str:
    """The TOML of a scenario; `rates` are vehicles an hour by road, none where somebody else brings the vehicles."""
    reference = kinds[0]
    lines = [
        *(f"# {line}" for line in about.splitlines()),
        f'name = "{name}"',
        f"seed = {seed}",
        f"dt_s = {dt_s!r}",
        'shield = "on"',
        f"end = {{ time_s = {float(end_s)!r} }}",
        "objective = { beta = 1.0 }",
        'control = { law = "viable" }',
        'gate = { entry = "viable" }',
        "",
        "[vehicle]",
        *(f"{key} = {value!r}" for key, value in limits(reference)),
        f"v_max_mps = {v_max_mps!r}",
        "reaction_time_s = 1.2",
        f"standstill_gap_m = {reference.length_m + 1.5!r}",
        "",
    ]
    if len(kinds) > 1:
        for kind in kinds:
            lines += ["[[fleet]]", f'name = "{kind.name}"', f"share = {1.0 / len(kinds)!r}"]
            lines += [f"{key} = {value!r}" for key, value in limits(kind)]
            lines += [f"v_max_mps = {kind.v_max_mps!r}"] if kind.v_max_mps < v_max_mps else []
            lines += [""]
    for road in (segment.road for zone in zones for segment in zone.segments if segment.road):
        lines += ["[[roads]]", f'name = "{road}"', *demand((rates or {}).get(road), end_s, speed_mps, v_max_mps), ""]
    for zone in zones:
        lines += [*shape(zone), ""]
    return "\n".join(lines)


def limits(kind: Kind) -> list[tuple[str, float]]:
    """What scenarios say of a kind."""
    return [
        ("u_min_mps2", -abs(kind.u_min_mps2)),
        ("u_max_mps2", kind.u_max_mps2),
        ("length_m", kind.length_m),
    ]


def demand(per_hour: float | None, end_s: float, speed_mps: float, v_max_mps: float) -> list[str]:
    """The demand of a road; a table is wanted also where it is not used."""
    speed_mps = min(speed_mps or v_max_mps, v_max_mps)
    rate = f"{{ until_s = {float(end_s) if per_hour else 1.0!r}, vehicles_per_hour = {per_hour or 1.0!r} }}"
    return [
        "[roads.demand]",
        f"rates = [{rate}]",
        "min_headway_s = 1.5",
        f"speed_mean_mps = {speed_mps!r}",
        "speed_sd_mps = 0.0",
        f"speed_min_mps = {speed_mps!r}",
        f"speed_max_mps = {speed_mps!r}",
    ]


def shape(zone: Zone) -> list[str]:
    """The table of a zone."""
    lines = ["[[zones]]", f'name = "{zone.name}"', "segments = ["]
    for segment in zone.segments:
        places = ", ".join(f"[{x:.2f}, {y:.2f}]" for x, y in segment.shape)
        source = ""
        if segment.road:
            source = f', road = "{segment.road}"'
        elif segment.zone:
            link = f", link_m = {segment.link_m:.3f}" if segment.link_m else ""
            source = f', zone = "{segment.zone[0]}", exit = "{segment.zone[1]}"{link}'
        inner = ", keep_clear = true" if segment.keep_clear else ""
        lines.append(f'    {{ name = "{segment.name}", length_m = {segment.length_m:.6f}, shape = [{places}]{source}{inner} }},')
    lines += ["]", "paths = ["]
    for path in zone.paths:
        lines.append(f'    {{ name = "{path.name}", segments = [{quoted(path.segments)}], exit = "{path.exit}" }},')
    if not zone.crossings:
        return [*lines, "]"]
    lines += ["]", "crossings = ["]
    for crossing in zone.crossings:
        at = ", ".join(f'"{name}" = [{from_m:.3f}, {max(to_m, from_m + LEAST_M):.3f}]' for name, (from_m, to_m) in crossing.at.items())
        lines.append(f'    {{ name = "{crossing.name}", at = {{ {at} }} }},')
    return [*lines, "]"]


def quoted(names: Iterable[str]) -> str:
    """Names as a list of strings has them."""
    return ", ".join(f'"{name}"' for name in names)
