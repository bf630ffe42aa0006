"""Does SUMO play the world as the contract and docs/sumo.md say?

Usage: python3 sdk/python/check_sumo.py [CZ]   (the program `cz`; the one on the path by default)
Needs the package with its library, and its extra `sumo`. Takes some 20 s.
"""

from __future__ import annotations

import json
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
    found: dict[str, object] = json.loads(done.stdout[done.stdout.index('{\n  "scenario"') :])
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


def main() -> None:
    """All of it, or why not."""
    try:
        import control_zones.sumo.simulation  # noqa: F401
    except Exception as error:  # noqa: BLE001 - whatever is missing is the reason
        print(f"SUMO: {error}: not checked")
        return
    check_scenarios()
    with tempfile.TemporaryDirectory(prefix="cz-check-sumo-") as folder:
        check_networks(Path(folder))


if __name__ == "__main__":
    main()
