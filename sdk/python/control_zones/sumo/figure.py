"""Curves with intervals as SVG."""

from __future__ import annotations

import html
import math
import typing

if typing.TYPE_CHECKING:
    from collections.abc import Sequence

#: A mean and half of its interval, where there is one, by value.
Points = typing.List[typing.Tuple[float, float, typing.Optional[float]]]

WIDTH, HEIGHT = 400, 250
LEFT, RIGHT, TOP, BOTTOM = 52, 14, 30, 40
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")


class Panel(typing.NamedTuple):
    """One measure of several curves."""

    title: str
    curves: Sequence[tuple[str, Points]]


def rounded(high: float) -> float:
    """A distance of marks of which some five come up to a value."""
    rough = max(high, 1e-9) / 5.0
    ten = 10.0 ** math.floor(math.log10(rough))
    return next(step * ten for step in (1.0, 2.0, 5.0, 10.0) if step * ten >= rough)


def panel(axis: str, drawn: Panel, at: tuple[int, int], with_names: bool) -> list[str]:
    """The elements of a panel whose corner is there."""
    ends = [mean + (half or 0.0) for _, points in drawn.curves for _, mean, half in points]
    high = 1.3 * max([1e-3, *ends])

    def x_px(x: float) -> float:
        return at[0] + LEFT + (WIDTH - LEFT - RIGHT) * (x + 3.0) / 106.0

    def y_px(y: float) -> float:
        return at[1] + HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * max(0.0, y) / high

    base = y_px(0.0)
    out = [f'<text x="{at[0] + WIDTH / 2}" y="{at[1] + 18}" text-anchor="middle" font-size="13">{html.escape(drawn.title)}</text>']
    out += [f'<path d="M{x_px(-3):.1f} {y_px(high):.1f}V{base:.1f}H{x_px(103):.1f}" fill="none" stroke="#000"/>']
    for share in range(0, 101, 20):
        out += [f'<text x="{x_px(share):.1f}" y="{base + 15:.1f}" text-anchor="middle">{share}</text>']
    out += [f'<text x="{x_px(50):.1f}" y="{base + 31:.1f}" text-anchor="middle">{html.escape(axis)}</text>']
    mark = rounded(high)
    for count in range(int(high / mark) + 1):
        mark_px = y_px(count * mark)
        out += [f'<text x="{x_px(-3) - 5:.1f}" y="{mark_px + 4:.1f}" text-anchor="end">{count * mark:g}</text>']
        out += [f'<path d="M{x_px(-3):.1f} {mark_px:.1f}H{x_px(103):.1f}" stroke="#ddd"/>'] if count else []
    for number, (name, points) in enumerate(drawn.curves):
        colour = COLOURS[number % len(COLOURS)]
        line = " ".join(f"{x_px(x):.1f},{y_px(mean):.1f}" for x, mean, _ in points)
        out += [f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="2"/>']
        for x, mean, half in points:
            out += [f'<circle cx="{x_px(x):.1f}" cy="{y_px(mean):.1f}" r="2.5" fill="{colour}"/>']
            out += [f'<path d="M{x_px(x):.1f} {y_px(mean - half):.1f}V{y_px(mean + half):.1f}" stroke="{colour}"/>'] if half else []
        if with_names:
            name_px = at[1] + TOP + 10 + 15 * number
            out += [f'<path d="M{x_px(55):.1f} {name_px - 4}h16" stroke="{colour}" stroke-width="2"/>']
            out += [f'<text x="{x_px(55) + 21:.1f}" y="{name_px}">{html.escape(name)}</text>']
    return out


def svg(axis: str, panels: Sequence[Panel]) -> str:
    """Panels two by two, over shares in per cent; the first says whose the curves are."""
    rows = (len(panels) + 1) // 2
    out = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {2 * WIDTH} {rows * HEIGHT}" font-family="sans-serif" font-size="11">']
    out += [f'<rect width="{2 * WIDTH}" height="{rows * HEIGHT}" fill="#fff"/>']
    for number, one in enumerate(panels):
        out += panel(axis, one, (number % 2 * WIDTH, number // 2 * HEIGHT), number == 0)
    return "\n".join([*out, "</svg>", ""])
