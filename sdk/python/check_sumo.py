"""Does SUMO play the world as the contract and docs/sumo.md say?

Usage: python3 sdk/python/check_sumo.py [CZ]   (the program `cz`; the one on the path by default)
Needs the package with its library, and its extra `sumo`. Takes a minute.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path

CZ = sys.argv[1] if len(sys.argv) > 1 else "cz"


def sumo(*arguments: str) -> dict[str, object]:
    """The summary of a run with SUMO as its world."""
    command = [sys.executable, "-m", "control_zones.sumo", *arguments, "--json", "-"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, f"{arguments}: {done.stderr}"
    found: dict[str, object] = json.loads(done.stdout)
    return found


def own(name: str) -> dict[str, object]:
    """The summary of the same run in our own world."""
    done = subprocess.run([CZ, "run", name, "--in-process", "--json", "-"], capture_output=True, text=True, check=True)
    found: dict[str, object] = json.loads(done.stdout)
    return found


def check_scenarios() -> None:
    """All automated, totals are those of our world but for what vehicles do outside, and SUMO sees no collision."""
    for name in ("two-merges", "intersection"):
        ours, theirs = own(name), sumo("scenario", name)
        assert theirs["sumo"]["collisions"] == [], theirs["sumo"]
        assert theirs["overlaps"]["pairs"] == 0 and theirs["departed"] == ours["departed"], theirs
        a, b = ours["total_objective"], theirs["total_objective"]
        assert abs(a - b) < 0.01 * a, f"{name}: {a} and {b}"
        assert theirs["traffic"]["greatest_disobedience_mps2"] < 1e-6, theirs["traffic"]
        print(f"{name}: {a:.3f} in our world, {b:.3f} in SUMO's, no collision: passed")


def check_mixture() -> None:
    """Among SUMO's drivers, who follow no order of ours, everybody gets through, and SUMO sees no collision."""
    rate = ["--set", "roads.*.demand.rates=[{until_s=3600.0,vehicles_per_hour=300}]"]
    for name, demand, seed, count in (("two-merges", rate, 4, 60), ("roundabout", rate, 4, 60), ("intersection", [], 7, 100)):
        limits = ["--set", f"end.vehicles={count}", "--set", "end.time_s=1000"]
        found = sumo("scenario", name, "--penetration", "0.5", "--seed", str(seed), "--shield", "on", *demand, *limits)
        assert found["departed"] == found["arrived"] == count, f"{name}: {found['departed']} of {count} got through"
        assert 0.3 * count < found["traffic"]["uncommanded"] < 0.7 * count, found["traffic"]
        assert found["sumo"]["collisions"] == [] and found["overlaps"]["pairs"] == 0, found["sumo"]
        print(f"{name}, half of the vehicles SUMO's: {count} of {count}, no collision: passed")


def check_networks(folder: Path) -> None:
    """A generated network runs without a change to it, repeats exactly, replays, and can be imported."""
    from control_zones.sumo.simulation import program

    net, routes, config = folder / "g.net.xml", folder / "g.rou.xml", folder / "g.sumocfg"
    grid = [program("netgenerate"), "--grid", "--grid.number", "3", "--grid.length", "150", "--grid.attach-length", "150"]
    subprocess.run([*grid, "-o", str(net)], check=True, capture_output=True)
    ways = ["left0A0 A0B0 B0C0 C0right0", "bottom1B0 B0B1 B1B2 B2top1", "right2C2 C2B2 B2A2 A2left2"]
    flows = [f'<flow id="f{i}" begin="0" end="120" period="6"><route edges="{way}"/></flow>' for i, way in enumerate(ways)]
    routes.write_text("<routes>" + "".join(flows) + "</routes>")
    edges = net.read_text()
    if not all(f'id="{edge}"' in edges for way in ways for edge in way.split()):
        raise SystemExit("netgenerate names its edges otherwise than this check expects")
    config.write_text(
        f'<configuration><input><net-file value="{net.name}"/><route-files value="{routes.name}"/></input></configuration>'
    )
    recording = str(folder / "g.czlog")
    first = sumo("run", str(config), "--record", recording)
    again = sumo("run", str(config))
    assert first["state_hash"] == again["state_hash"], "a seed does not repeat"
    assert first["sumo"]["arrived"] == 60 and first["sumo"]["collisions"] == [], first["sumo"]
    replayed = subprocess.run([CZ, "replay", recording], capture_output=True, text=True)
    assert replayed.returncode == 0 and first["state_hash"] in replayed.stdout, replayed
    humans = sumo("run", str(config), "--penetration", "0")
    assert humans["traffic"]["uncommanded"] == humans["arrived"] > 0, humans["traffic"]
    imported = str(folder / "g.toml")
    made = [sys.executable, "-m", "control_zones.sumo", "import", str(net), "--rou", str(routes), "--out", imported]
    subprocess.run(made, check=True)
    subprocess.run([CZ, "show", imported, "--network", "--out", str(folder / "g.svg")], check=True, capture_output=True)
    assert own(imported)["arrived"] > 20
    print("a grid that netgenerate made: runs, repeats, replays, is imported: passed")


def check_grids(folder: Path) -> None:
    """In a closed grid of five by five, with lights or without, with demand that nobody fitted to it, everybody arrives at every share:
    nobody waits so long that SUMO takes it out, and no two that are commanded collide."""
    from control_zones.sumo.simulation import program, sumolib_home

    for name, how in (("plain", []), ("lights", ["-j", "traffic_light"])):
        net, routes, config = (folder / f"{name}.{kind}" for kind in ("net.xml", "rou.xml", "sumocfg"))
        grid = [program("netgenerate"), "--grid", "--grid.number", "5", "--grid.length", "150", *how]
        subprocess.run([*grid, "-o", str(net)], check=True, capture_output=True)
        trips = [sys.executable, str(Path(sumolib_home()) / "tools" / "randomTrips.py"), "-n", str(net), "-e", "600", "-p", "1.5", "--seed", "1"]
        surroundings = {**os.environ, "SUMO_HOME": sumolib_home()}
        subprocess.run([*trips, "-r", str(routes), "-o", str(folder / "trips.xml")], check=True, capture_output=True, env=surroundings)
        config.write_text(
            f'<configuration><input><net-file value="{net.name}"/><route-files value="{routes.name}"/></input></configuration>'
        )
        means = []
        for share in ("1", "0.8", "0.5", "0.2"):
            recording = str(folder / f"{name}-{share}.czlog")
            summary = sumo("run", str(config), "--penetration", share, "--record", recording)
            found = summary["sumo"]
            replayed = subprocess.run([CZ, "replay", recording], capture_output=True, text=True)
            assert replayed.returncode == 0 and summary["state_hash"] in replayed.stdout, replayed
            assert found["departed"] == found["arrived"] == 400 and found["teleports"] == 0, (name, share, found)
            assert share != "1" or found["collided_pairs"] == 0, found
            means.append(f"{found['mean_travel_s']:.1f}")
        print(f"a closed grid, {name}: 400 of 400 at 100, 80, 50 and 20 %, mean travel time {', '.join(means)} s: passed")


def check_examples() -> None:
    """SUMO's own examples run as they are, and more vehicles arrive than with SUMO's drivers and lights."""
    from control_zones.sumo.simulation import sumolib_home

    for name in ("corridor", "cross", "square", "grid6"):
        config = str(Path(sumolib_home()) / "tools" / "game" / f"{name}.sumocfg")
        ours, theirs = (sumo("run", config, "--penetration", share)["sumo"] for share in ("1", "0"))
        assert ours["collided_pairs"] == 0 and ours["teleports"] == 0, (name, ours)
        assert ours["arrived"] > 1.2 * theirs["arrived"], (name, ours["arrived"], theirs["arrived"])
        print(f"{name}, of SUMO's examples: {ours['arrived']} arrive, {theirs['arrived']} without automated vehicles: passed")


def write_roundabout(folder: Path, radius_m: float) -> Path:
    """A ring of four junctions with four roads, which netconvert is left to recognise as a roundabout; its configuration."""
    from control_zones.sumo.simulation import program

    nodes, edges, flows = ["<nodes>"], ["<edges>"], ["<routes>"]
    place = [(1, 0), (0, 1), (-1, 0), (0, -1)]
    for arm, (x, y) in enumerate(place):
        nodes += [f'<node id="r{arm}" x="{x * radius_m}" y="{y * radius_m}"/>']
        nodes += [f'<node id="o{arm}" x="{x * (radius_m + 200)}" y="{y * (radius_m + 200)}"/>']
        edges += [f'<edge id="in{arm}" from="o{arm}" to="r{arm}" numLanes="1" speed="13.9"/>']
        edges += [f'<edge id="out{arm}" from="r{arm}" to="o{arm}" numLanes="1" speed="13.9"/>']
        angles = [math.pi * (arm / 2 + part / 16) for part in range(9)]
        shape = " ".join(f"{radius_m * math.cos(angle):.2f},{radius_m * math.sin(angle):.2f}" for angle in angles)
        edges += [f'<edge id="ring{arm}" from="r{arm}" to="r{(arm + 1) % 4}" numLanes="1" speed="8.0" priority="3" shape="{shape}"/>']
        for over in (1, 2, 3):
            way = [f"in{arm}", *(f"ring{(arm + part) % 4}" for part in range(over)), f"out{(arm + over) % 4}"]
            flows += [f'<flow id="f{arm}{over}" begin="{arm + over}" end="200" period="exp(0.04)"><route edges="{" ".join(way)}"/></flow>']
    for name, lines, last in (("nod", nodes, "nodes"), ("edg", edges, "edges"), ("rou", flows, "routes")):
        (folder / f"r.{name}.xml").write_text("\n".join([*lines, f"</{last}>"]))
    net = folder / "r.net.xml"
    command = [program("netconvert"), "-n", str(folder / "r.nod.xml"), "-e", str(folder / "r.edg.xml"), "-o", str(net)]
    subprocess.run(command, check=True, capture_output=True)
    assert "<roundabout" in net.read_text(), "netconvert takes it for no roundabout"
    config = folder / "r.sumocfg"
    config.write_text(
        '<configuration><input><net-file value="r.net.xml"/><route-files value="r.rou.xml"/></input></configuration>'
    )
    return config


def check_roundabout(folder: Path) -> None:
    """A roundabout too small for a zone for each junction is one zone, and nobody collides."""
    config = write_roundabout(folder, 18.0)
    for name in ([], ["--zone", "r0+r1+r2+r3"]):
        found = sumo("run", str(config), *name)
        assert [zone["zone"] for zone in found["zones"]] == ["r0_r1_r2_r3"], found["zones"]
        assert found["sumo"]["collisions"] == [] and found["overlaps"]["pairs"] == 0, found["sumo"]
        assert found["sumo"]["arrived"] == found["sumo"]["departed"] > 60, found["sumo"]
    print(f"a roundabout of 18 m: {found['sumo']['arrived']} vehicles in one zone, no collision: passed")


def check_contract() -> None:
    """SUMO keeps the contract for worlds."""
    command = [CZ, "world", "check", "--", sys.executable, "-m", "control_zones.sumo", "scenario"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout
    print("cz world check: passed")


def check_stops(folder: Path) -> None:
    """Who is to stop on its way stops where it is to, and who does not drive as cars do drives by itself, with its own length."""
    from control_zones.sumo.simulation import program

    net, routes, config = folder / "s.net.xml", folder / "s.rou.xml", folder / "s.sumocfg"
    grid = [program("netgenerate"), "--grid", "--grid.number", "3", "--grid.length", "200", "--grid.attach-length", "200"]
    subprocess.run([*grid, "-o", str(net)], check=True, capture_output=True)
    stop = '<stop lane="left0A0_0" endPos="120" duration="20"/>'
    routes.write_text(
        '<routes><vType id="tall" vClass="motorcycle" length="2.2"/><route id="r" edges="left0A0 A0B0 B0C0 C0right0"/>'
        f'<vehicle id="stops" route="r" depart="0">{stop}</vehicle><vehicle id="rides" type="tall" route="r" depart="60"/>'
        '<vehicle id="drives" route="r" depart="90"/></routes>'
    )
    config.write_text(
        f'<configuration><input><net-file value="{net.name}"/><route-files value="{routes.name}"/></input>'
        '<time><begin value="0:0:0"/><end value="0:5:0"/></time></configuration>'
    )
    stopped = folder / "stops.xml"
    found = sumo("run", str(config), f"--sumo=--stop-output={stopped}")
    assert found["sumo"]["arrived"] == 3 and found["traffic"]["greatest_disobedience_mps2"] < 1e-6, found["traffic"]
    # The one that stops before the first zone's end, and the motorcycle in each of three.
    assert found["traffic"]["uncommanded"] == 4, found["traffic"]
    assert 'pos="120.' in stopped.read_text() or 'pos="119.' in stopped.read_text(), stopped.read_text()
    print("stops are kept, and times of a configuration read: passed")


def check_refusals() -> None:
    """What cannot be meant is refused in a line that says what was expected."""
    from control_zones.sumo.simulation import sumolib_home

    config = str(Path(sumolib_home()) / "tools" / "game" / "square.sumocfg")
    for bad, said in (
        (["--end", "0"], "--end is 0.0, expected seconds above 0"),
        (["--approach", "20"], "--approach is 20.0, expected at least"),
        (["--step-length", "0.0333"], "--step-length is 0.0333 s, expected whole milliseconds"),
        (["--zone", "A1", "--zone", "A1+B1"], "junction A1 is named twice"),
        (["--json", "/nowhere/x"], "--json /nowhere/x: No such file"),
        (["--scenario-out", "/nowhere/x"], "--scenario-out /nowhere/x: No such file"),
        (["--sumo=--lateral-resolution=0.8"], "lateral-resolution is set"),
    ):
        command = [sys.executable, "-m", "control_zones.sumo", "run", config, *bad]
        done = subprocess.run(command, capture_output=True, text=True, timeout=100)
        assert done.returncode == 2 and said in done.stderr and "Traceback" not in done.stderr, (bad, done.stderr)
    print("what cannot be meant is refused: passed")


def check_arrivals(folder: Path) -> None:
    """A trace that comes with the program is made again, and what cannot be meant is refused in a line."""
    out = folder / "arrivals.csv"

    def arrivals(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "control_zones.sumo", "arrivals", "--out", str(out), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=100)

    assert arrivals("--seed", "4", "--vehicles", "150").returncode == 0
    kept = Path(__file__).resolve().parents[2] / "scenarios" / "data" / "sumo-400-4.csv"
    assert out.read_bytes() == kept.read_bytes(), "not the trace that comes with the program"
    for bad in (["--rate", "nan"], ["--rate", "9:1", "--rate", "5:1"], ["--road", "a<b"], ["--vehicles", "0"], ["--out", "/nowhere/a"]):
        done = arrivals(*bad)
        assert done.returncode == 2 and "Traceback" not in done.stderr, f"{bad}: {done.stderr}"
    print("arrivals: a trace of the program's made again: passed")


def main() -> None:
    """All of it, or why not."""
    try:
        import control_zones.sumo.simulation  # noqa: F401
    except Exception as error:  # noqa: BLE001 - whatever is missing is the reason
        print(f"SUMO: {error}: not checked")
        return
    check_scenarios()
    check_mixture()
    check_contract()
    check_examples()
    check_refusals()
    with tempfile.TemporaryDirectory(prefix="cz-check-sumo-") as folder:
        check_networks(Path(folder))
        check_grids(Path(folder))
        check_roundabout(Path(folder))
        check_stops(Path(folder))
        check_arrivals(Path(folder))


if __name__ == "__main__":
    main()
