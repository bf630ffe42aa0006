"""Installs a wheel where there is nothing else, and runs the main job, a controller in Python and the environments there.

Usage: python3 sdk/python/check_wheel.py WHEEL
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

EXAMPLE = Path(__file__).resolve().parents[2] / "examples/python/cruise.py"
ENVIRONMENTS = Path(__file__).resolve().with_name("check_env.py")
SWEEPS = Path(__file__).resolve().with_name("check_sweep.py")
SUMO = Path(__file__).resolve().with_name("check_sumo.py")
PROGRAMS = ("cz", "cz-world", "cz-coord", "cz-ctrl", "cz-export", "cz-report", "cz-sweep", "cz-view", "cz-top")


class Empty:
    """A home, a runtime directory and a Python environment with nothing in them; no Rust."""

    def __init__(self, place: Path) -> None:
        self.home, self.programs = place / "home", place / "venv/bin"
        for folder in (self.home, place / "tmp"):
            folder.mkdir()
        path = f"{self.programs}:/usr/bin:/bin"
        self.environment = {"HOME": str(self.home), "TMPDIR": str(place / "tmp"), "PATH": path}
        # Where packages come from is the machine's affair.
        self.environment.update({key: value for key, value in os.environ.items() if key.startswith(("PIP_", "SSL_"))})
        for key in ("https_proxy", "HTTPS_PROXY", "no_proxy", "NO_PROXY"):
            if key in os.environ:
                self.environment[key] = os.environ[key]
        self.ran("a new environment", sys.executable, "-m", "venv", str(place / "venv"))

    def ran(self, what: str, *command: str) -> str:
        """What the command prints; says how long it took."""
        start = time.monotonic()
        done = subprocess.run(command, cwd=self.home, env=self.environment, stdout=subprocess.PIPE, timeout=600)
        if done.returncode != 0:
            raise SystemExit(f"{what}: exit code {done.returncode} from {' '.join(command)}")
        print(f"{time.monotonic() - start:7.2f} s  {what}")
        return done.stdout.decode()


def check(wheel: Path, place: Path) -> None:
    """Everything that must work."""
    empty = Empty(place)
    if subprocess.run(["sh", "-c", "command -v cargo"], env=empty.environment, stdout=subprocess.PIPE).stdout:
        raise SystemExit("cargo is on the path of what is to do without it")
    install = ("pip", "install", "--quiet", "--disable-pip-version-check")
    empty.ran("the wheel and numpy installed", *install, str(wheel), "numpy")
    for program in PROGRAMS:
        if not (empty.programs / program).is_file():
            raise SystemExit(f"{wheel.name} does not bring {program}")
    summary = json.loads(empty.ran("cz run", "cz", "run", "--json", "-", "--record", "run.czlog"))
    state_hash = summary["state_hash"]
    alone = json.loads(empty.ran("cz run --in-process", "cz", "run", "--in-process", "--json", "-"))
    if alone["state_hash"] != state_hash:
        raise SystemExit(f"state hash {alone['state_hash']} in one process, {state_hash} in several")
    controller = f"merge-2=python {EXAMPLE}"
    summary = json.loads(
        empty.ran("cz run with a controller in Python", "cz", "run", "--shield", "on", "--json", "-", "--controller", controller)
    )
    if summary["state_hash"] == state_hash:
        raise SystemExit("the controller in Python changed nothing")
    empty.ran("cz plugin check of it", "cz", "plugin", "check", "--", "python", str(EXAMPLE))
    if shutil.which("cc") and shutil.which("make"):
        empty.ran("cz plugin new c", "cz", "plugin", "new", "c", "own")
        empty.ran("make of it", "make", "-C", "own")
        empty.ran("cz plugin check of that", "cz", "plugin", "check", "--", "own/controller")
    empty.ran("cz report", "cz", "report", "run.czlog", "--out", "run.html")
    empty.ran("cz export", "cz", "export", "run.czlog", "--to", "parquet")
    empty.ran("what environments need installed", *install, f"{wheel}[env]")
    # Isolated: what lies beside the script is not what was installed.
    print(empty.ran("the environments' checkers", "python", "-I", str(ENVIRONMENTS)), end="")
    empty.ran("cz sweep of 20 runs", "cz", "sweep", "paper-none", "--scenario", "paper", "--seeds", "20")
    empty.ran("what sweeps on a cluster need installed", *install, f"{wheel}[dask]")
    print(empty.ran("the same sweep by cz and by Dask", "python", "-I", str(SWEEPS)), end="")
    empty.ran("what SUMO as world needs installed", *install, f"{wheel}[sumo]")
    print(empty.ran("SUMO as world", "python", "-I", str(SUMO), "cz"), end="")
    for program in ("cz-view", "cz-top", "cz-sumo", "cz-world", "cz-coord", "cz-ctrl"):
        empty.ran(f"{program} --help", program, "--help")


def main() -> None:
    """Checks the wheel named on the command line."""
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    wheel = Path(sys.argv[1]).resolve()
    if not wheel.is_file():
        raise SystemExit(f"{wheel} is not there; sdk/python/wheel.sh builds it")
    print(f"{wheel.stat().st_size / 1e6:7.1f} MB {wheel.name}")
    with tempfile.TemporaryDirectory(prefix="cz-wheel-") as place:
        check(wheel, Path(place))


main()
