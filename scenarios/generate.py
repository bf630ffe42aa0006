#!/usr/bin/env python3
"""Writes the scenarios whose geometry is worked out rather than typed: python3 scenarios/generate.py

The files are checked in; run this after changing it. Distances are in m, rounded to mm.
"""

import math
from pathlib import Path

HERE = Path(__file__).parent


def length(shape):
    return sum(math.dist(a, b) for a, b in zip(shape, shape[1:]))


def number(x):
    return f"{round(x, 3):g}" if abs(x) < 1e5 else f"{x:.3f}"


def points(shape):
    return "[" + ", ".join(f"[{x:.2f}, {y:.2f}]" for x, y in shape) + "]"


def segment(name, shape, source=""):
    source = f", {source}" if source else ""
    return f'{{ name = "{name}", length_m = {number(length(shape))}, shape = {points(shape)}{source} }}'


def listed(key, items):
    return f"{key} = [\n" + "".join(f"    {item},\n" for item in items) + "]\n"


def road(name, rate, speed, until, routes=""):
    mean, sd, low, high = speed
    return f'''
[[roads]]
name = "{name}"
{routes}[roads.demand]
rates = [{{ until_s = {until}, vehicles_per_hour = {rate} }}]
min_headway_s = 2.0
speed_mean_mps = {mean}
speed_sd_mps = {sd}
speed_min_mps = {low}
speed_max_mps = {high}
'''


HEAD = '''# {title}
#
# Written by scenarios/generate.py.
name = "{name}"
seed = 1
dt_s = 0.1
shield = "{shield}"

[end]
time_s = {end}

[vehicle]
u_min_mps2 = -{u}
u_max_mps2 = {u}
v_max_mps = {v}
length_m = {body}
reaction_time_s = 1.8
standstill_gap_m = {gap}

[objective]
beta = {beta}
'''


# The four-legged intersection of the literature: two lanes per leg, twelve conflict points.
POINTS = {
    1: (288.92, 204.82), 2: (295.37, 187.58), 3: (312.60, 195.05), 4: (305.70, 213.32),
    5: (295.26, 205.09), 6: (295.33, 194.57), 7: (305.83, 194.95), 8: (305.76, 205.46),
    9: (300.54, 205.26), 10: (295.61, 199.74), 11: (300.52, 194.90), 12: (305.63, 200.31),
}  # fmt: skip
MOVEMENTS = {
    "north": {"right": [1], "straight": [5, 10, 6, 2], "left": [9, 12]},
    "west": {"right": [2], "straight": [6, 11, 7, 3], "left": [10, 9]},
    "south": {"right": [3], "straight": [7, 12, 8, 4], "left": [11, 10]},
    "east": {"right": [4], "straight": [8, 9, 5, 1], "left": [12, 11]},
}
HEADING = {"north": (0, -1), "west": (1, 0), "south": (0, 1), "east": (-1, 0)}
EXIT_OF_MERGE = {1: "west", 2: "south", 3: "east", 4: "north"}
LEFT_EXIT = {"north": "east", "west": "north", "south": "west", "east": "south"}
FIRST_POINT_M = 300.0
SPLIT_M = 280.0
CLEARANCE_M = 10.0
LEFT_ASIDE_M = 2.67


def trimmed(line, by_m):
    """A line without so much of its end."""
    line = list(line)
    while by_m >= (piece_m := math.dist(line[-2], line[-1])):
        by_m -= piece_m
        line.pop()
    (ax, ay), (bx, by) = line[-2:]
    share = by_m / piece_m
    return [*line[:-1], (bx - share * (bx - ax), by - share * (by - ay))]


def intersection():
    body = 4.5
    area_m = CLEARANCE_M - body
    segments, paths, crossings = [], [], {}
    for leg, movements in MOVEMENTS.items():
        dx, dy = HEADING[leg]
        for lane, turns in [("r", ["right", "straight"]), ("l", ["left"])]:
            # Every movement reaches its first point after 300 m; the lane runs straight towards it.
            x, y = POINTS[movements[turns[-1]][0]]
            back = lambda m: (x - dx * m, y - dy * m)
            # Lines cross in the middle of the conflict area, which begins at the published point.
            split = back(FIRST_POINT_M - SPLIT_M + 0.5 * area_m)
            shape = [back(FIRST_POINT_M + 0.5 * area_m), split]
            segments.append(segment(f"{leg}-{lane}", shape, f'road = "{leg}-{lane}"'))
            for turn in turns:
                on_way = [POINTS[k] for k in movements[turn]]
                last = on_way[-1]
                shape = [split, back(FIRST_POINT_M - SPLIT_M), *on_way]
                if turn == "left":
                    ex, ey = -dy, dx
                    # Straight on until between the lanes beside: on one line with them comes who waits from the other side.
                    (px, py), slant = on_way[-2], LEFT_ASIDE_M * math.sqrt(2)
                    long_m = math.dist((px, py), last)
                    x1 = last[0] + slant * (last[0] - px) / long_m
                    y1 = last[1] + slant * (last[1] - py) / long_m
                    shape += [(x1, y1), (x1 + (8 - slant) * ex, y1 + (8 - slant) * ey)]
                name = f"{leg}-{turn}"
                shape = trimmed(shape, 0.5 * area_m)
                inner = FIRST_POINT_M - SPLIT_M
                total = inner + length(on_way) + (8 if turn == "left" else 0)
                segments.append(
                    f'{{ name = "{name}", length_m = {number(total)}, shape = {points(shape)} }}'
                )
                exit_ = f"{LEFT_EXIT[leg]}-l" if turn == "left" else f"{EXIT_OF_MERGE[movements[turn][-1]]}-r"
                share = {"right": 0.3, "straight": 0.7, "left": 1.0}[turn]
                paths.append(
                    f'{{ name = "{name}", segments = ["{leg}-{lane}", "{name}"], exit = "{exit_}", share = {share} }}'
                )
                at = inner
                for k, (a, b) in zip(movements[turn], zip(on_way, on_way[1:] + [last])):
                    if k > 4:
                        crossings.setdefault(k, {})[name] = at
                    at += math.dist(a, b)
    text = HEAD.format(
        title="Four legs with two lanes each, twelve conflict points: the intersection of the literature on coordinated\n"
        "# crossing, at its published setting. Right and straight from the right lane, left from the left one.",
        name="intersection", shield="on", end=2000.0, u="3.0", v="15.0", body=body, gap=CLEARANCE_M, beta="1.0",
    )  # fmt: skip
    for leg in MOVEMENTS:
        text += road(f"{leg}-r", "250.0", (11.0, 1.0, 8.0, 14.0), 600.0)
        text += road(f"{leg}-l", "100.0", (11.0, 1.0, 8.0, 14.0), 600.0)
    text += '\n[[zones]]\nname = "centre"\n'
    text += listed("segments", segments)
    text += listed("paths", paths)
    places = lambda at: ", ".join(f"{name} = {number(m)}" for name, m in at.items())
    area = number(area_m)
    text += listed(
        "crossings",
        [f'{{ name = "p{k}", length_m = {area}, at = {{ {places(crossings[k])} }} }}' for k in sorted(crossings)],
    )
    (HERE / "intersection.toml").write_text(text)


def arc(centre, radius, start, end, count=12):
    angles = [start + (end - start) * i / count for i in range(count + 1)]
    return [(centre[0] + radius * math.cos(a), centre[1] + radius * math.sin(a)) for a in angles]


def roundabout():
    text = HEAD.format(
        title="A ring with three entries and three merging points, each in a zone of its own of 60 m.",
        name="roundabout", shield="on", end=2000.0, u="3.0", v="13.0", body=4.5, gap="6.0", beta="1.0",
    )  # fmt: skip
    radius = 180.0 / (2 * math.pi)
    for i in range(3):
        text += road(f"entry-{i + 1}", "250.0", (8.0, 1.0, 5.0, 11.0), 600.0)
    for i in range(3):
        # A third of the ring, counter-clockwise; the merge is at its end, the way out in its middle.
        a0, a1 = 2 * math.pi * i / 3, 2 * math.pi * (i + 1) / 3
        mid = (a0 + a1) / 2
        first, second = arc((0, 0), radius, a0, mid), arc((0, 0), radius, mid, a1)
        out = [first[-1]]
        for step in range(1, 4):
            bend = mid + math.pi / 2 - 0.5 * step
            out.append((out[-1][0] + 10 * math.cos(bend), out[-1][1] + 10 * math.sin(bend)))
        merge = second[-1]
        entry = [merge]
        for step in range(1, 7):
            # Backwards from the merge, bending away from the ring.
            bend = a1 + math.pi / 2 + 0.16 * step
            entry.append((entry[-1][0] - 10 * math.cos(bend), entry[-1][1] - 10 * math.sin(bend)))
        entry.reverse()
        before = f"ring-{(i - 1) % 3 + 1}"
        here = f"ring-{i + 1}"
        text += f'\n[[zones]]\nname = "{here}"\n'
        sized = lambda name, shape, m, source="": (
            f'{{ name = "{name}", length_m = {number(m)}, shape = {points(shape)}' + (f", {source}" if source else "") + " }"
        )
        text += listed(
            "segments",
            [
                sized("arc", first, 30.0, f'zone = "{before}", exit = "ring"'),
                sized("on", second, 30.0),
                sized("out", out, 30.0),
                sized("entry", entry, 60.0, f'road = "entry-{i + 1}"'),
            ],
        )
        text += listed(
            "paths",
            [
                '{ name = "stay", segments = ["arc", "on"], exit = "ring", share = 0.4 }',
                '{ name = "leave", segments = ["arc", "out"], exit = "out", share = 0.6 }',
                '{ name = "enter", segments = ["entry"], exit = "ring" }',
            ],
        )
    (HERE / "roundabout.toml").write_text(text)


def lane_drop():
    text = HEAD.format(
        title="Two lanes become one, in front of a zone with one lane that an on-ramp joins.",
        name="lane-drop", shield="on", end=2000.0, u="4.0", v="30.0", body=4.5, gap="5.0", beta="0.6666666666666666",
    )  # fmt: skip
    for name, rate in [("left", "500.0"), ("right", "500.0"), ("ramp", "200.0")]:
        text += road(name, rate, (16.0, 1.2, 12.0, 20.0), 600.0)
    bend = [(300.0, 3.5), (340.0, 0.0)]
    text += '\n[[zones]]\nname = "drop"\n'
    text += listed(
        "segments",
        [
            segment("left", [(0.0, 3.5), (300.0, 3.5)], 'road = "left"'),
            segment("right", [(0.0, 0.0), (300.0, 0.0)], 'road = "right"'),
            segment("closing", bend),
            segment("open", [(300.0, 0.0), (340.0, 0.0)]),
            segment("single", [(340.0, 0.0), (380.0, 0.0)]),
        ],
    )
    text += listed(
        "paths",
        [
            '{ name = "left", segments = ["left", "closing", "single"], exit = "on" }',
            '{ name = "right", segments = ["right", "open", "single"], exit = "on" }',
        ],
    )
    text += '\n[[zones]]\nname = "ramp"\nflow = { policy = "fixed", terminal_mps = 18.5 }\n'
    text += listed(
        "segments",
        [
            segment("main", [(380.0, 0.0), (580.0, 0.0)], 'zone = "drop"'),
            segment("ramp", [(400.0, -40.0), (520.0, -12.0), (580.0, 0.0)], 'road = "ramp"'),
        ],
    )
    text += listed(
        "paths",
        [
            '{ name = "main", segments = ["main"], exit = "on" }',
            '{ name = "ramp", segments = ["ramp"], exit = "on" }',
        ],
    )
    (HERE / "lane-drop.toml").write_text(text)


SIDES = ["north", "east", "south", "west"]
# Direction of travel of a vehicle that comes from a side.
TRAVEL = {"north": (0, -1), "east": (-1, 0), "south": (0, 1), "west": (1, 0)}
LANE_M, BOX_M, IN_M, OUT_M, AREA_M = 1.75, 12.0, 150.0, 30.0, 4.0


def crossing_places(a, b):
    """Where two polylines cross: distances along each, or nothing."""
    along = 0.0
    for p, q in zip(a, a[1:]):
        other = 0.0
        for r, s in zip(b, b[1:]):
            d = (q[0] - p[0]) * (s[1] - r[1]) - (q[1] - p[1]) * (s[0] - r[0])
            if abs(d) > 1e-12:
                t = ((r[0] - p[0]) * (s[1] - r[1]) - (r[1] - p[1]) * (s[0] - r[0])) / d
                u = ((r[0] - p[0]) * (q[1] - p[1]) - (r[1] - p[1]) * (q[0] - p[0])) / d
                if 0 <= t <= 1 and 0 <= u <= 1:
                    return along + t * math.dist(p, q), other + u * math.dist(r, s)
            other += math.dist(r, s)
        along += math.dist(p, q)
    return None


def turn(side, to):
    """Shape inside the box from the end of the lane in to the beginning of the lane out, round (0, 0)."""
    dx, dy = TRAVEL[side]
    start = (-dx * BOX_M + dy * LANE_M, -dy * BOX_M - dx * LANE_M)
    ex, ey = (-TRAVEL[to][0], -TRAVEL[to][1])
    end = (ex * BOX_M + ey * LANE_M, ey * BOX_M - ex * LANE_M)
    if (dx, dy) == (ex, ey):
        return [start, end]
    # A quadratic curve whose middle point is where the two lanes would meet.
    corner = (end[0], start[1]) if dx else (start[0], end[1])
    curve = []
    for i in range(9):
        t = i / 8
        curve.append(tuple((1 - t) ** 2 * start[k] + 2 * t * (1 - t) * corner[k] + t * t * end[k] for k in (0, 1)))
    return curve


def grid(rows, columns):
    spacing = IN_M + OUT_M + 2 * BOX_M
    text = HEAD.format(
        title="Nine intersections of two-way streets, one lane per direction; vehicles turn as they like.",
        name=f"grid-{rows}x{columns}", shield="on", end=1500.0, u="3.0", v="15.0", body=4.5, gap="6.0", beta="1.0",
    )  # fmt: skip
    zones, roads = "", ""
    at = {"north": (-1, 0), "south": (1, 0), "east": (0, 1), "west": (0, -1)}
    name_of = lambda r, c: f"x{r + 1}{c + 1}"
    opposite = {"north": "south", "south": "north", "east": "west", "west": "east"}
    for r in range(rows):
        for c in range(columns):
            cx, cy = c * spacing, -r * spacing
            move = lambda shape: [(x + cx, y + cy) for x, y in shape]
            segments, paths, turns = [], [], {}
            for side in SIDES:
                dx, dy = TRAVEL[side]
                nr, nc = r + at[side][0], c + at[side][1]
                inside = 0 <= nr < rows and 0 <= nc < columns
                if inside:
                    source = f'zone = "{name_of(nr, nc)}", exit = "{opposite[side]}"'
                else:
                    road_name = f"{side}-{name_of(r, c)}"
                    source = f'road = "{road_name}"'
                    roads += road(road_name, "120.0", (10.0, 1.0, 7.0, 13.0), 600.0)
                offset = (dy * LANE_M, -dx * LANE_M)
                lane = [(offset[0] - dx * m, offset[1] - dy * m) for m in (IN_M + BOX_M, BOX_M)]
                segments.append(segment(f"in-{side}", move(lane), source))
                ex, ey = -dx, -dy
                lane = [(ey * LANE_M + ex * m, -ex * LANE_M + ey * m) for m in (BOX_M, BOX_M + OUT_M)]
                segments.append(segment(f"out-{side}", move(lane)))
            for side in SIDES:
                for to in SIDES:
                    if to == side:
                        continue
                    shape = turn(side, to)
                    turns[side, to] = shape
                    segments.append(segment(f"{side}-{to}", move(shape)))
                    share = 0.6 if TRAVEL[side][0] == -TRAVEL[to][0] and TRAVEL[side][1] == -TRAVEL[to][1] else 0.2
                    paths.append(
                        f'{{ name = "{side}-{to}", segments = ["in-{side}", "{side}-{to}", "out-{to}"], '
                        f'exit = "{to}", share = {share} }}'
                    )
            crossings = []
            keys = list(turns)
            for i, a in enumerate(keys):
                for b in keys[i + 1 :]:
                    if a[0] == b[0] or a[1] == b[1]:
                        continue
                    places = crossing_places(turns[a], turns[b])
                    if places:
                        # The area begins half its extent before the lines meet.
                        x, y = (max(0.0, m - AREA_M / 2) for m in places)
                        p, q = "-".join(a), "-".join(b)
                        crossings.append(
                            f'{{ name = "{p}.{q}", length_m = {AREA_M:g}, at = {{ {p} = {number(x)}, {q} = {number(y)} }} }}'.replace(
                                ".", "_", 1
                            )
                        )
            zones += f'\n[[zones]]\nname = "{name_of(r, c)}"\n'
            zones += listed("segments", segments) + listed("paths", paths) + listed("crossings", crossings)
    (HERE / f"grid-{rows}x{columns}.toml").write_text(text + roads + zones)


if __name__ == "__main__":
    intersection()
    roundabout()
    lane_drop()
    grid(3, 3)
