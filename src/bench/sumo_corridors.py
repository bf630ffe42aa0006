"""SUMO's own stepping through merging corridors side by side, driven by its human drivers.

Without arguments it says which version there is; `VEHICLES STEP_S FROM_S UNTIL_S REPEATS` measures.
Both print one JSON object. Needs the package eclipse-sumo.
"""

import importlib.metadata
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree

# As in `cz bench scale`: each road has 400 vehicles an hour, entering at 16 m/s, and each approach 400 m.
VEHICLES_PER_HOUR = 400.0
ENTRY_MPS = 16.0
APPROACH_M = 400.0
# A limit near which SUMO's drivers take as long through a corridor as ours, so that both have the same
# number of vehicles at once in the same number of corridors.
LIMIT_MPS = 18.5
VEHICLES_PER_CORRIDOR = 12.4


def call(name, *arguments):
    home = str(importlib.metadata.distribution("eclipse-sumo").locate_file("sumo"))
    command = [os.path.join(home, "bin", name), *arguments]
    environment = {**os.environ, "SUMO_HOME": home}
    try:
        done = subprocess.run(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
    except OSError as error:
        raise SystemExit(f"{name}: {error}")
    if done.returncode != 0:
        raise SystemExit(f"{name}: {done.stdout.strip()[-400:]}")


def network(path, corridors):
    """Two merges in a row, as often as asked for: the road that comes from the side gives way like a zip."""
    with open(f"{path}.nod.xml", "w") as nodes, open(f"{path}.edg.xml", "w") as edges:
        nodes.write("<nodes>\n")
        edges.write("<edges>\n")
        for i in range(corridors):
            y = 1000.0 * i
            for name, x, dy, kind in [
                ("a", 0.0, 0.0, "priority"),
                ("b", APPROACH_M - 399.0, -30.0, "priority"),
                ("m1", APPROACH_M, 0.0, "zipper"),
                ("c", 2 * APPROACH_M - 399.0, -30.0, "priority"),
                ("m2", 2 * APPROACH_M, 0.0, "zipper"),
                ("z", 2 * APPROACH_M + 10.0, 0.0, "priority"),
            ]:
                nodes.write(f'<node id="{name}{i}" x="{x}" y="{y + dy}" type="{kind}"/>\n')
            for name, start, end, priority in [
                ("main1", "a", "m1", 2),
                ("merge1", "b", "m1", 1),
                ("main2", "m1", "m2", 2),
                ("merge2", "c", "m2", 1),
                ("out", "m2", "z", 2),
            ]:
                edges.write(
                    f'<edge id="{name}-{i}" from="{start}{i}" to="{end}{i}" numLanes="1" '
                    f'speed="{LIMIT_MPS}" priority="{priority}"/>\n'
                )
        nodes.write("</nodes>\n")
        edges.write("</edges>\n")
    call("netconvert", "-n", f"{path}.nod.xml", "-e", f"{path}.edg.xml", "-o", f"{path}.net.xml",
         "--no-turnarounds", "true", "--no-warnings", "true")


def demand(path, corridors, until_s):
    with open(f"{path}.rou.xml", "w") as routes:
        routes.write('<routes>\n<vType id="human"/>\n')
        rate = VEHICLES_PER_HOUR / 3600.0
        for i in range(corridors):
            for name, edges in [
                ("main1", f"main1-{i} main2-{i} out-{i}"),
                ("merge1", f"merge1-{i} main2-{i} out-{i}"),
                ("merge2", f"merge2-{i} out-{i}"),
            ]:
                routes.write(
                    f'<flow id="{name}-{i}" type="human" begin="0" end="{until_s}" period="exp({rate:.6f})" '
                    f'departSpeed="{ENTRY_MPS}"><route edges="{edges}"/></flow>\n'
                )
        routes.write("</routes>\n")


def run(path, step_s, until_s):
    """Wall time of the stepping, s, and vehicle-steps; loading is not in it. SUMO gives hundredths of a second."""
    call("sumo", "-n", f"{path}.net.xml", "-r", f"{path}.rou.xml", "--begin", "0", "--end", str(until_s),
         "--step-length", str(step_s), "--threads", "1", "--seed", "1", "--time-to-teleport", "-1",
         "--no-step-log", "true", "--no-warnings", "true", "--statistic-output", f"{path}.stat.xml")
    performance = ElementTree.parse(f"{path}.stat.xml").getroot().find("performance")
    duration_s = float(performance.get("clockDuration"))
    return duration_s, duration_s * float(performance.get("vehicleUpdatesPerSecond"))


def measure(vehicles, step_s, from_s, until_s, repeats):
    corridors = max(1, math.ceil(vehicles / VEHICLES_PER_CORRIDOR))
    # The process id in the name lets `cz clean` tell what a killed measurement has left.
    directory = os.path.join(tempfile.gettempdir(), f"cz-sumo-{os.getpid()}")
    os.mkdir(directory, 0o700)
    try:
        path = os.path.join(directory, "corridors")
        network(path, corridors)
        demand(path, corridors, until_s)
        shorter, longer = [], []
        for _ in range(repeats):
            shorter.append(run(path, step_s, from_s))
            longer.append(run(path, step_s, until_s))
    finally:
        shutil.rmtree(directory)
    # The same seed steps the same way, so only the time differs from run to run; the least counts, as
    # interruptions only ever add.
    (short_s, short_steps), (long_s, long_steps) = min(shorter), min(longer)
    vehicle_steps, wall_s = long_steps - short_steps, long_s - short_s
    if wall_s <= 0.0:
        raise SystemExit(f"{vehicles} vehicles are too few for SUMO's clock")
    steps = (until_s - from_s) / step_s
    return {
        "corridors": corridors,
        "vehicles": vehicle_steps / steps,
        "ns_per_vehicle_step": 1e9 * wall_s / vehicle_steps,
    }


def main():
    try:
        version = importlib.metadata.version("eclipse-sumo")
    except importlib.metadata.PackageNotFoundError:
        raise SystemExit("the package eclipse-sumo is not installed")
    if len(sys.argv) == 1:
        call("sumo", "--version")
        print(json.dumps({"version": version}))
        return
    vehicles, step_s, from_s, until_s, repeats = sys.argv[1:]
    print(json.dumps(measure(int(vehicles), float(step_s), float(from_s), float(until_s), int(repeats))))


if __name__ == "__main__":
    main()
