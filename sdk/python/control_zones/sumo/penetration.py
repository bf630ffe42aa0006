"""`cz sumo penetration`: SUMO's drivers and automated vehicles in one traffic, at every share of these."""

from __future__ import annotations

import concurrent.futures
import hashlib
import json
import os
import sys
import tempfile
import typing
import xml.etree.ElementTree as ElementTree

from .._session import Error
from .figure import Panel, svg
from .runs import collided, interval, ran, spread
from .simulation import is_automated

if typing.TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

#: What SUMO's safety device counts: time to collision, s, and deceleration to avoid one, m/s^2.
THRESHOLDS = {"TTC": 3.0, "DRAC": 3.0}
#: Petrol, mg/ml.
PETROL_MG_ML = 743.0
#: Of every run; then demand and rules by scenario: both of `cz study penetration`, and how SUMO's drivers pass.
SETS = (
    "gate.entry=viable",
    "control.law=viable",
    "coordination.schedule=tandem",
    "coordination.order=resequenced",
    "end.vehicles=100",
    "end.time_s=1000",
)
RATES = {"two-merges": 300, "roundabout": 250}
RULE = "priority"
#: And SUMO's other ways to rule the same junction, where nobody is automated.
OTHERS = {"two-merges": ["zipper", "traffic_light"], "intersection": ["allway_stop", "traffic_light"], "roundabout": ["zipper", "traffic_light"]}


class Run(typing.NamedTuple):
    """One run of the study."""

    scenario: str
    rule: str
    share: float
    seed: int


#: What one run showed, by measure; `None` where nothing was to be seen.
Found = typing.Dict[str, typing.Optional[float]]


class Measure(typing.NamedTuple):
    """A column: key, heading, decimals, and what is made of the runs."""

    key: str
    heading: str
    digits: int
    over: str = "mean"


MEASURES = (
    Measure("ended", "runs that ended", 0, "sum"),
    Measure("throughput", "vehicles/h", 0),
    Measure("time_s", "time, s", 1),
    Measure("energy", "energy, m²/s³", 1),
    Measure("fuel_ml", "fuel, ml", 1),
    Measure("stops", "stops", 1),
    Measure("TTC", "TTC < 3 s", 1),
    Measure("DRAC", "DRAC > 3 m/s²", 1),
    Measure("humans", "collided: humans", 0, "sum"),
    Measure("mixed", "one automated", 0, "sum"),
    Measure("automated", "both automated", 0, "sum"),
    Measure("overlaps", "overlaps", 0, "sum"),
    Measure("rear_end_m", "rear end, m", 2, "least"),
    Measure("merge_m", "merge, m", 2, "least"),
    Measure("lost", "lost", 0, "sum"),
    Measure("began_unsafe", "began unsafe", 0, "sum"),
)

LEGEND = """\
Means over runs with 95 % intervals of: vehicles/h from the beginning to the last exit; per vehicle time with waits outside, energy (∫½u²dt) and fuel (SUMO's \
HBEFA emissions, to the end of the road behind the last zone); per 100 vehicles standstills (SUMO's `waitingCount`) and pairs of which SUMO's safety device saw a time to \
collision below 3 s, or a deceleration to avoid one above 3 m/s². Over all runs: pairs that SUMO saw \
collide (with its options collision.mingap-factor 0 and collision.check-junctions), by who they were; pairs whose bodies overlapped by the world's ledger; the least \
margins of automated vehicles that were safe when they came to owe them; vehicle-steps at whose end an automated vehicle had left a safe set it was in, and duties that began outside it. Means are of the runs that ended, \
in which everybody got through."""


def command_of(run: Run, sets: Sequence[str]) -> list[str]:
    """The command of a run without what it is to write."""
    demand = [f"roads.*.demand.rates=[{{until_s=3600.0,vehicles_per_hour={RATES[run.scenario]}}}]"] if run.scenario in RATES else []
    command = [sys.executable, "-m", "control_zones.sumo", "scenario", run.scenario, "--junctions", run.rule, "--shield", "on"]
    command += ["--penetration", str(run.share / 100.0), "--seed", str(run.seed)]
    command += [f"--set={one}" for one in (*SETS, *demand, *sets)]
    command += [f"--sumo={one}" for one in ("--device.emissions.probability=1", "--device.ssm.probability=1")]
    thresholds = " ".join(str(most) for most in THRESHOLDS.values())
    return [*command, f"--sumo=--device.ssm.measures={' '.join(THRESHOLDS)}", f"--sumo=--device.ssm.thresholds={thresholds}"]


def conflicts(path: str) -> dict[str, int]:
    """Pairs that came too near to each other, by measure."""
    pairs: dict[str, set[tuple[str, ...]]] = {name: set() for name in THRESHOLDS}
    for conflict in ElementTree.parse(path).getroot().iter("conflict"):
        pair = tuple(sorted((conflict.get("ego", ""), conflict.get("foe", ""))))
        for tag, name in (("minTTC", "TTC"), ("maxDRAC", "DRAC")):
            said = conflict.find(tag)
            value = said.get("value", "NA") if said is not None else "NA"
            if value != "NA" and (float(value) > THRESHOLDS[name] if name == "DRAC" else float(value) < THRESHOLDS[name]):
                pairs[name].add(pair)
    return {name: len(found) for name, found in pairs.items()}


def make(run: Run, sets: Sequence[str]) -> Found:
    """Makes a run and says what it showed."""
    with tempfile.TemporaryDirectory(prefix=f"cz-sumo-penetration-{os.getpid()}-") as folder:
        trips, ssm = os.path.join(folder, "trips.xml"), os.path.join(folder, "ssm.xml")
        written = [f"--sumo=--tripinfo-output={trips}", "--sumo=--tripinfo-output.write-unfinished=true", f"--sumo=--device.ssm.file={ssm}"]
        summary = ran([*command_of(run, sets), *written], folder)
        vehicles = list(ElementTree.parse(trips).getroot().iter("tripinfo"))
        near = conflicts(ssm)
    emissions = [vehicle.find("emissions") for vehicle in vehicles]
    fuel_mg = sum(float(emitted.get("fuel_abs", "nan")) for emitted in emissions if emitted is not None)
    count = max(len(vehicles), 1)
    automated = [sum(is_automated(run.seed, int(one), run.share / 100.0) for one in pair) for pair in collided(summary)]
    controllers, zones = summary["shield"]["controllers"], summary["zones"]
    return {
        "ended": float(summary["departed"] == summary["arrived"] and summary["waiting"] == 0),
        "throughput": 3600.0 * summary["departed"] / (summary["steps"] * summary["dt_s"]),
        "time_s": sum(zone["mean_time_s"] + zone["mean_wait_s"] for zone in zones),
        "energy": sum(zone["mean_energy"] for zone in zones),
        "fuel_ml": fuel_mg / PETROL_MG_ML / count,
        "stops": 100.0 * sum(float(vehicle.get("waitingCount", "0")) for vehicle in vehicles) / count,
        **{name: 100.0 * pairs / count for name, pairs in near.items()},
        **{name: float(automated.count(of)) for of, name in enumerate(("humans", "mixed", "automated"))},
        "overlaps": float(summary["overlaps"]["pairs"]),
        "rear_end_m": least(zones, "min_rear_end_margin_clean_m"),
        "merge_m": least(zones, "min_merge_margin_clean_m"),
        "lost": float(sum(row["lost"] for row in controllers)),
        "began_unsafe": float(sum(row["began_unsafe"] for row in controllers)),
    }


def least(zones: Sequence[dict[str, typing.Any]], key: str) -> float | None:
    """The least of the zones that have one."""
    return min((zone[key] for zone in zones if zone[key] is not None), default=None)


def found(run: Run, sets: Sequence[str], cache: str | None) -> Found:
    """What a run shows, from the cache if it is there."""
    if cache is None:
        return make(run, sets)
    # By the arguments behind the interpreter's path.
    key = hashlib.sha256("\0".join(command_of(run, sets)[1:]).encode()).hexdigest()[:16]
    path = os.path.join(cache, f"{os.path.basename(run.scenario)}-{run.rule}-{run.share:g}-{run.seed}-{key}.json")
    if os.path.exists(path):
        with open(path) as file:
            known: Found = json.load(file)
        return known
    showed = make(run, sets)
    with open(f"{path}.part", "w") as file:
        json.dump(showed, file)
    os.replace(f"{path}.part", path)
    return showed


def means(results: Sequence[Found], key: str) -> list[float]:
    """A measure in the runs that ended: in others it would be of those who got through."""
    return [value for one in results if one["ended"] and (value := one[key]) is not None]


def cell(results: Sequence[Found], measure: Measure) -> str:
    """A mean with its interval over the runs that ended, or a sum or the least over all."""
    if measure.over == "mean":
        values = means(results, measure.key)
        return interval(values, measure.digits) if values else "–"
    values = [value for one in results if (value := one[measure.key]) is not None]
    if not values:
        return "–"
    return f"{sum(values) if measure.over == 'sum' else min(values):.{measure.digits}f}"


def table(name: str, rule: str, results: dict[float, list[Found]]) -> str:
    """The runs under one rule, share by share."""
    lines = [f"### {name}, SUMO's drivers under `{rule}`", ""]
    lines += [f"| automated, % | {' | '.join(measure.heading for measure in MEASURES)} |", "|---:" * (len(MEASURES) + 1) + "|"]
    for share, runs in results.items():
        lines.append(f"| {share:g} | {' | '.join(cell(runs, measure) for measure in MEASURES)} |")
    return "\n".join([*lines, ""])


def figure(rules: dict[str, dict[float, list[Found]]]) -> str:
    """Time, fuel, stops and close encounters over shares."""
    titles = {"time_s": "time per vehicle (s)", "fuel_ml": "fuel per vehicle (ml)", "stops": "stops per 100 vehicles"}
    panels = []
    for key, title in {**titles, "TTC": "pairs with TTC < 3 s per 100 vehicles"}.items():
        curves = []
        for rule, shares in rules.items():
            over = {share: means(runs, key) for share, runs in shares.items()}
            curves.append((rule, [(share, *spread(values)) for share, values in over.items() if values]))
        panels.append(Panel(title, curves))
    return svg("automated, %", panels)


def main(args: argparse.Namespace) -> None:
    """Makes the runs, prints the tables, and writes what is asked for."""
    names = args.scenario or ["two-merges", "intersection", "roundabout"]
    series = [(name, rule, args.shares) for name in names for rule in args.rules or [RULE]]
    if args.rules is None:
        series += [(name, rule, [0.0]) for name in names for rule in OTHERS.get(name, [])]
    runs = [Run(name, rule, share, seed) for name, rule, shares in series for share in shares for seed in args.seeds]
    for folder in (args.out, args.cache):
        if folder:
            os.makedirs(folder, exist_ok=True)
    if args.jobs < 1:
        raise Error(f"--jobs is {args.jobs}, expected at least 1")
    showed: dict[Run, Found] = {}
    with concurrent.futures.ThreadPoolExecutor(args.jobs) as pool:
        coming = {pool.submit(found, run, args.set, args.cache): run for run in runs}
        try:
            for done in concurrent.futures.as_completed(coming):
                showed[coming[done]] = done.result()
                if sys.stderr.isatty():
                    print(f"\r{len(showed)} of {len(runs)} runs", end="", file=sys.stderr, flush=True)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    text = [LEGEND, ""]
    curves: dict[str, dict[str, dict[float, list[Found]]]] = {}
    for name, rule, over in sorted(series, key=lambda one: names.index(one[0])):
        shares = {share: [showed[Run(name, rule, share, seed)] for seed in args.seeds] for share in over}
        curves.setdefault(name, {})[rule] = shares
        text.append(table(name, rule, shares))
    print("\n".join(text))
    if args.out:
        written = {"penetration.md": "\n".join(text), "penetration.json": json.dumps([{**run._asdict(), **showed[run]} for run in runs], indent=1)}
        for name, rules in curves.items():
            written[f"sumo-penetration-{os.path.basename(name)}.svg"] = figure(rules)
        for file, content in written.items():
            with open(os.path.join(args.out, file), "w") as out:
                out.write(content)
