"""Checks that a sweep through Dask, a worker of which is killed half-way, makes the table that `cz sweep` makes.

Usage: python3 sdk/python/check_sweep.py [SEEDS [POLICY...]]   (20 seeds of two policies by default)

`CZ` names the program; the one of this Python's environment, or on the path, by default.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from dask.distributed import Client, LocalCluster

from control_zones.sweep import _cz, sweep

SCENARIO = "paper"


def main() -> None:
    """Both sweeps, and what they make."""
    seeds = sys.argv[1] if len(sys.argv) > 1 else "20"
    policies = sys.argv[2:] or ["paper-none", "paper-fixed-17"]
    with tempfile.TemporaryDirectory(prefix="cz-sweep-") as place:
        start = time.monotonic()
        command = [_cz(), "sweep", *policies, "--scenario", SCENARIO, "--seeds", seeds, "--out", f"{place}/here"]
        print(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.strip())
        print(f"{time.monotonic() - start:7.1f} s  cz sweep")
        start, killed = time.monotonic(), []

        with (
            LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, local_directory=place) as cluster,
            Client(cluster) as client,
        ):

            def progress(done: int, total: int) -> None:
                if not killed and 2 * done >= total > 4:
                    victim = next(iter(client.run(os.getpid).values()))
                    killed.append(victim)
                    os.kill(victim, signal.SIGKILL)
                    print(f"worker {victim} is killed after {done} of {total} runs")

            table = sweep(client, policies, seeds, [SCENARIO], out=f"{place}/dask", progress=progress)
        print(f"{time.monotonic() - start:7.1f} s  through Dask, two workers")
        if not killed:
            raise SystemExit("no worker was killed")
        ours, theirs = Path(f"{place}/here/sweep.parquet").read_bytes(), table.read_bytes()
        if ours != theirs:
            raise SystemExit(f"the tables differ: {len(ours)} and {len(theirs)} bytes")
        print(f"the same table, {len(ours)} bytes")


if __name__ == "__main__":
    main()
