#!/usr/bin/env python3
"""Compares the passing orders where paths cross, and writes docs/orders.md: python3 scenarios/orders.py [CZ]

Each row is one run in one process, shield on: arrivals of the scenario's roads for ten minutes at the given rate, and as
long as it takes until everybody has left.
"""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
SEEDS = [1, 2, 3]
DEMANDS = {"intersection": [100, 250, 400], "roundabout": [200, 400, 700]}
HEADER = """# Passing orders where paths cross

Written by `python3 scenarios/orders.py`. Rates are vehicles/h of each road (at the intersection of each of the eight lanes),
for ten minutes; means over the seeds 1 to 3, each run to its end. Throughput is vehicles that left per hour from the
start until the last has left. Time is in all zones, from entry to exit of each; delay what it exceeds the
time at the entry speeds' mean; held are arrivals that had to wait outside, by the end nobody, and wait is how long on
average over all vehicles. Infeasible are vehicles that met a QP without solution; bounded are commands the shield changed.

Where queues grow `per_point` carries less than `fifo`, and more vehicles meet steps without solution: whoever comes to a point first is not
whoever came to the zone first, and duties come up that were not there when a vehicle planned. While traffic is light at the
roundabout it saves a little time. `resequenced` carries most at the intersection, where the law of the paper meets more infeasible steps
under it too (under the law `viable` there are none: [control](control.md)); in the roundabout's small zones it finds nobody to put behind.

"""


def run(cz, name, rate, order, seed):
    scenario = tomllib.loads((ROOT / "scenarios" / f"{name}.toml").read_text())
    sets = ["end.time_s=20000"]
    for road in scenario["roads"]:
        period = f"{{until_s=600.0,vehicles_per_hour={float(rate)}}}"
        sets.append(f"roads.{road['name']}.demand.rates=[{period}]")
    sets += [f"zones.{zone['name']}.order={order}" for zone in scenario["zones"]]
    command = [cz, "run", name, "--in-process", "--seed", str(seed), "--json", "-"]
    for each in sets:
        command += ["--set", each]
    summary = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    speed = scenario["roads"][0]["demand"]["speed_mean_mps"]
    lengths = {}
    for zone in scenario["zones"]:
        of = {segment["name"]: segment["length_m"] for segment in zone["segments"]}
        paths = [(sum(of[s] for s in p["segments"]), p.get("share", 1.0)) for p in zone["paths"]]
        lengths[zone["name"]] = sum(m * w for m, w in paths) / sum(w for _, w in paths)
    zones = summary["zones"]
    vehicles = summary["departed"]
    passages = [z["vehicles"] for z in zones]
    total = lambda key: sum(z[key] * z["vehicles"] for z in zones)
    time = total("mean_time_s") / vehicles
    free = sum(lengths[z["zone"]] / speed * n for z, n in zip(zones, passages)) / vehicles
    shield = summary["shield"]["controllers"][0]
    return {
        "left": vehicles,
        "all": summary["arrived"] + summary["waiting"],
        "per_hour": vehicles / (summary["steps"] * summary["dt_s"]) * 3600,
        "time": time,
        "delay": time - free,
        "energy": total("mean_energy") / vehicles,
        "infeasible": sum(z["infeasible_vehicles"] for z in zones),
        "held": summary["held_arrivals"],
        "wait": total("mean_wait_s") / vehicles,
        "bounded": 100 * shield["bounded"] / max(shield["commands"], 1),
        "overlaps": summary["overlaps"]["pairs"],
        "refused": sum(z["orders_refused"] for z in zones),
    }


def main():
    cz = sys.argv[1] if len(sys.argv) > 1 else str(ROOT / "target" / "release" / "cz")
    text = HEADER
    columns = [
        ("vehicles", "left", "{:.0f}"), ("throughput [1/h]", "per_hour", "{:.0f}"), ("time [s]", "time", "{:.1f}"),
        ("delay [s]", "delay", "{:.1f}"), ("energy [m²/s³]", "energy", "{:.2f}"),
        ("infeasible", "infeasible", "{:.1f}"), ("held", "held", "{:.1f}"),
        ("wait [s]", "wait", "{:.1f}"), ("bounded [%]", "bounded", "{:.2f}"),
        ("overlaps", "overlaps", "{:.1f}"), ("orders refused", "refused", "{:.1f}"),
    ]  # fmt: skip
    for name, rates in DEMANDS.items():
        text += f"## {name}\n\n| rate [1/h] | order | " + " | ".join(c for c, _, _ in columns) + " |\n"
        text += "|---" * (len(columns) + 2) + "|\n"
        for rate in rates:
            for order in ["fifo", "per_point", "resequenced"]:
                runs = [run(cz, name, rate, order, seed) for seed in SEEDS]
                assert all(r["left"] == r["all"] for r in runs), "somebody has not left"
                mean = lambda key: sum(r[key] for r in runs) / len(runs)
                text += f"| {rate} | {order} | " + " | ".join(f.format(mean(k)) for _, k, f in columns) + " |\n"
        text += "\n"
    (ROOT / "docs" / "orders.md").write_text(text.rstrip() + "\n")
    print(text)


if __name__ == "__main__":
    main()
