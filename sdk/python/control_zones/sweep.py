"""A sweep on a cluster: the runs of `cz sweep`, done by Dask.

    from dask.distributed import Client
    import control_zones.sweep

    with Client("tcp://scheduler:8786") as client:
        table = control_zones.sweep.sweep(client, ["paper-none", "viable"], scenarios=["paper"], seeds=200, out="results")

`cz sweep` says which runs there are not yet, any worker does any of them, and `cz sweep` makes the table of what is kept; so it
is the same table, byte for byte, whoever did the runs, and a sweep that was interrupted goes on where it was. Workers need
this package with the programs, the same wheel as here, and no files in common with this machine.

Needs dask: `pip install "control-zones[dask]"`.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import typing
from pathlib import Path

from dask.distributed import Client, as_completed

from ._session import Error

if typing.TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

__all__ = ["sweep"]

#: A run that takes longer has failed, s.
RUN_TIMEOUT_S = 600.0


def _cz() -> str:
    """The program: of the environment of this Python, or on the path; `CZ` names another."""
    import sysconfig

    beside = Path(sysconfig.get_path("scripts")) / "cz"
    found = os.environ.get("CZ") or (str(beside) if beside.is_file() else shutil.which("cz"))
    if not found:
        raise Error("the program cz is not there; the wheel with the programs brings it, and CZ may name it")
    return found


def _run(request: str) -> str:
    """Does a run where this is called, by a process that dies alone; its answer, a line of JSON."""
    try:
        worker = subprocess.run(
            [_cz(), "sweep", "--worker"], input=request, stdout=subprocess.PIPE, text=True, timeout=RUN_TIMEOUT_S
        )
    except subprocess.TimeoutExpired as error:
        raise Error(f"no outcome within {RUN_TIMEOUT_S:.0f} s") from error
    if worker.returncode != 0 or not worker.stdout:
        raise Error(f"the worker died: exit code {worker.returncode}")
    failure = json.loads(worker.stdout).get("failure")
    if failure is not None:
        raise Error(failure)
    return worker.stdout


def _keep(runs: Path, file: str, answer: str) -> None:
    """Keeps an outcome, whole or not at all."""
    partial = runs / f"{file}.{os.getpid()}"
    partial.write_bytes(bytes.fromhex(json.loads(answer)["outcome"]))
    partial.replace(runs / file)


def sweep(
    client: Client,
    policies: Sequence[str],
    seeds: int | str = 20,
    scenarios: Iterable[str] = (),
    sets: Mapping[str, object] | Iterable[str] = (),
    out: str | os.PathLike[str] = "sweep",
    retries: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Does what is missing of a sweep and writes its table; its path.

    Args:
        client: of the cluster.
        policies, seeds, scenarios, sets: as for `cz sweep`: names of policies; how many seeds, from 1, or a range such as
            "4-23"; scenarios; keys of the scenario and their values for all policies.
        out: the directory for the table, sweep.parquet, and for what is kept of the runs.
        retries: how often a run that failed is tried again. Runs whose worker has died do not count as failed.
        progress: is told how many runs are done, of how many known so far.

    Raises:
        Error: when an argument is no good or runs failed for good; the table is there if what failed is runs.
    """
    given = [f"{key}={value}" for key, value in sets.items()] if hasattr(sets, "items") else list(sets)
    command = [_cz(), "sweep", *policies, "--seeds", str(seeds), "--out", os.fspath(out), "--retries", str(retries)]
    for scenario in scenarios:
        command += ["--scenario", scenario]
    for line in given:
        command += ["--set", line]
    failed: set[str] = set()
    done = 0
    while True:
        missing = [line for line in _said([*command, "--missing"]).splitlines() if json.loads(line)["file"] not in failed]
        if not missing:
            break
        files = {}
        for request in missing:
            # Not by what it computes: a run that failed may be asked for again.
            future = client.submit(_run, request + "\n", retries=retries, pure=False)
            files[future] = json.loads(request)["file"]
        total = done + len(files)
        # Dask says nothing of its types here.
        for future in as_completed(list(files)):  # type: ignore[no-untyped-call]
            file = files.pop(future)
            if future.status == "finished":
                _keep(Path(out) / "runs", file, future.result())
            else:
                failed.add(file)
            done += 1
            if progress is not None:
                progress(done, total)
    # Runs that failed are tried here once more, and what is wrong with them is said.
    _said(command)
    return Path(out) / "sweep.parquet"


def _said(command: list[str]) -> str:
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    if done.returncode != 0:
        raise Error(done.stderr.strip() or f"exit code {done.returncode} from {' '.join(command)}")
    return done.stdout
