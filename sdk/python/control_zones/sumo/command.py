"""`cz sumo`: SUMO as the world of a run."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import sys
import tempfile
import time
import typing

from .. import world
from .._session import Error
from .periods import period

if typing.TYPE_CHECKING:
    from collections.abc import Sequence

    from .simulation import Simulation


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        return command(given)
    except Error as error:
        print(f"cz sumo: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


def command(given: Sequence[str]) -> int:
    """Reads the arguments and does what they ask for."""
    parser = argparse.ArgumentParser(prog="cz sumo", description="SUMO as the world of a run.")
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="junctions of a SUMO configuration as control zones")
    run.add_argument("config", metavar="CONFIG.sumocfg")
    run.add_argument("--zone", action="append", default=[], metavar="JUNCTION[+JUNCTION…]", help="one, or several as one zone; may be repeated; default: all with conflicts, roundabouts as one")
    run.add_argument("--approach", type=float, default=150.0, metavar="M", help="so much of incoming lanes at most [150]")
    run.add_argument("--cav", action="append", default=[], metavar="TYPE", help="vehicle types that are automated [all]")
    run.add_argument("--lights", choices=["off", "keep"], default="off", help="traffic lights of zones in which somebody is automated, who does not obey them [off: SUMO's drivers have the right of way of the network there]")
    run.add_argument("--scenario-out", metavar="FILE", help="keep the scenario that was made of the junctions")
    run.add_argument("--end", type=float, metavar="S", help="the run ends here [the configuration's end, or 3600]")
    again = commands.add_parser("scenario", help="a scenario of ours with SUMO as its world")
    again.add_argument("scenario", nargs="?", help="as for `cz run`")
    again.add_argument("--junctions", default="priority", metavar="TYPE", help="how SUMO rules them: priority, zipper, traffic_light, …")
    again.add_argument("--net-out", metavar="FILE", help="keep the network")
    imported = commands.add_parser("import", help="a SUMO network as a scenario for our own world")
    imported.add_argument("net", metavar="NET.xml")
    imported.add_argument("--rou", action="append", default=[], metavar="ROU.xml", help="vehicles and flows; their rates by road are kept")
    imported.add_argument("--zone", action="append", default=[], metavar="JUNCTION[+JUNCTION…]", help="one, or several as one zone; may be repeated; default: all with conflicts, roundabouts as one")
    imported.add_argument("--approach", type=float, default=150.0, metavar="M", help="so much of incoming lanes at most [150]")
    imported.add_argument("--rate", type=float, default=200.0, metavar="VPH", help="vehicles an hour and lane without --rou [200]")
    imported.add_argument("--out", required=True, metavar="FILE.toml")
    arrivals = commands.add_parser("arrivals", help="an arrival trace of SUMO's human drivers")
    arrivals.add_argument("--road", action="append", default=[], metavar="NAME", help="may be repeated [main1, merge1, merge2]")
    arrivals.add_argument("--rate", action="append", default=[], type=period, metavar="[UNTIL_S:]VPH", help="vehicles an hour and road; periods in order may be repeated [2000:400]")
    arrivals.add_argument("--seed", type=int, default=1, metavar="N", help="of SUMO [1]")
    arrivals.add_argument("--vehicles", type=int, metavar="N", help="only so many [all]")
    arrivals.add_argument("--out", required=True, metavar="FILE.csv")
    costs = commands.add_parser("cost", help="whose the time of a step is: grids of all sizes, in one process and in several")
    costs.add_argument("--vehicles", type=counts, default=[30, 300, 3000], metavar="N,N,…", help="at once [30,300,3000]")
    costs.add_argument("--seed", type=int, default=1, metavar="N", help="of the vehicles' ways, and of SUMO [1]")
    costs.add_argument("--cz", metavar="PROGRAM", default=os.environ.get("CZ_PROGRAM") or shutil.which("cz"), help="starts the several processes [the one this is started by, or cz on the path]")
    beside = commands.add_parser("compare", help="scenarios of ours in our world and in SUMO's, over several seeds")
    beside.add_argument("scenario", nargs="*", help="as for `cz run` [two-merges intersection roundabout]")
    beside.add_argument("--seeds", type=int, default=5, metavar="N", help="1 to N [5]")
    beside.add_argument("--rules", type=words, default=["priority", "zipper", "traffic_light"], metavar="TYPE,…", help="of junctions where SUMO's drivers decide")
    beside.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as for `cz run`")
    shares = commands.add_parser("penetration", help="SUMO's drivers and automated vehicles at every share of these, as tables and figures")
    shares.add_argument("scenario", nargs="*", help="as for `cz run` [two-merges intersection roundabout]")
    shares.add_argument("--rules", type=words, metavar="TYPE,…", help="of junctions where SUMO's drivers decide, at every share [priority; others without automated vehicles]")
    shares.add_argument("--shares", type=percents, default=list(range(0, 101, 10)), metavar="PERCENT,…", help="automated [0,10,…,100]")
    shares.add_argument("--seeds", type=seeds, default=list(range(4, 14)), metavar="A-B", help="of the scenario, of SUMO and of who is automated [4-13]")
    shares.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as for `cz run`, beside those of the study")
    shares.add_argument("--out", metavar="DIR", help="penetration.json, penetration.md and a figure for each scenario")
    shares.add_argument("--cache", metavar="DIR", help="runs that it holds are not made again, those made are put there")
    shares.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="runs at a time [one for each core]")
    beside.add_argument("--cz", metavar="PROGRAM", default=os.environ.get("CZ_PROGRAM") or shutil.which("cz"), help="runs our own world [the one this is started by, or cz on the path]")
    for one in (run, again):
        one.add_argument("--penetration", type=float, default=1.0, metavar="P", help="share of automated vehicles [1]")
        one.add_argument("--seed", type=int, metavar="N", help="of SUMO and of the scenario")
        one.add_argument("--step-length", type=float, default=0.1, metavar="S", help="of SUMO and of the scenario [0.1]")
        one.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as for `cz run`")
        one.add_argument("--record", metavar="FILE", help="as for `cz run`")
        one.add_argument("--shield", metavar="MODE", help="as for `cz run`")
        one.add_argument("--json", metavar="FILE|-", help="the summary, with SUMO's as `sumo`")
        one.add_argument("--sumo", action="append", default=[], metavar="OPTION", help="for SUMO, such as --sumo=--tripinfo-output=FILE")
        one.add_argument("--processes", metavar="NAME", help=argparse.SUPPRESS)
    # `cz run --world` adds the arguments of `cz world` behind ours.
    own, behind = (list(given), None)
    if "world" in own[1:]:
        at = own.index("world", 1)
        own, behind = own[:at], own[at:]
    args = parser.parse_args(own)
    # Says what is missing where SUMO is not installed.
    from . import simulation as _

    if args.command == "import":
        from .importing import write

        write(args)
        return 0
    if args.command == "arrivals":
        from .arrivals import write as write_arrivals

        with tempfile.TemporaryDirectory(prefix=f"cz-sumo-{os.getpid()}-") as folder:
            write_arrivals(args, folder)
        return 0
    if args.command == "cost":
        from .cost import main as cost

        cost(args)
        return 0
    if args.command == "compare":
        from .compare import main as compare

        compare(args)
        return 0
    if args.command == "penetration":
        from .penetration import main as penetration

        penetration(args)
        return 0
    if not 0.0 <= args.penetration <= 1.0:
        raise Error(f"--penetration is {args.penetration}, expected 0 to 1")
    with tempfile.TemporaryDirectory(prefix=f"cz-sumo-{os.getpid()}-") as folder:
        traffic, simulation, run_arguments = replica(args, folder) if args.command == "scenario" else junctions(args, folder)
        return conduct(args, traffic, simulation, behind or run_arguments, folder)


def counts(text: str) -> list[int]:
    """Numbers of vehicles, as an argument has them."""
    found = [int(one) for one in text.split(",")]
    if not all(1 <= one <= 20_000 for one in found):
        raise ValueError(text)
    return found


def percents(text: str) -> list[float]:
    """Shares in per cent, as an argument has them."""
    found = [float(one) for one in text.split(",")]
    if not all(0.0 <= one <= 100.0 for one in found):
        raise ValueError(text)
    return sorted(set(found))


def seeds(text: str) -> list[int]:
    """A range of seeds, `A-B`, or one seed, as an argument has it."""
    first, _, last = text.partition("-")
    found = list(range(int(first), int(last or first) + 1))
    if not found:
        raise ValueError(text)
    return found


def words(text: str) -> list[str]:
    """Words between commas."""
    return [word for word in text.split(",") if word]


def replica(args: argparse.Namespace, folder: str) -> tuple[world.Traffic, Simulation, list[str]]:
    """A scenario's traffic."""
    from . import replica, simulation

    sets = [*args.set, *([f"seed={args.seed}"] if args.seed is not None else [])]
    described = world.describe(args.scenario, sets)
    made = replica.Replica(described)
    net = made.write(folder, args.junctions)
    if args.net_out:
        with open(net) as source, open(args.net_out, "w") as kept:
            kept.write(source.read())
    dt_s = described["scenario"]["dt_ns"] * 1e-9
    seed = int(described["scenario"]["seed"])
    started = simulation.Simulation(["-n", net, "--time-to-teleport", "-1", *args.sumo], dt_s, seed)
    traffic = replica.ReplicaTraffic(made, described["scenario"], started, args.penetration)
    name = [args.scenario] if args.scenario else []
    return traffic, started, ["run", *name, "--in-process", *(f"--set={one}" for one in sets)]


def junctions(args: argparse.Namespace, folder: str) -> tuple[world.Traffic, Simulation, list[str]]:
    """The traffic of a SUMO configuration."""
    from . import junctions as made

    return made.prepare(args, folder)


@contextlib.contextmanager
def quiet(is_quiet: bool) -> typing.Iterator[None]:
    """Keeps the run's table off stdout, where only JSON is wanted."""
    if not is_quiet:
        yield
        return
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def conduct(
    args: argparse.Namespace, traffic: world.Traffic, simulation: Simulation, run: list[str], folder: str
) -> int:
    """Makes the run, and says what SUMO has to say of it."""
    summary = os.path.join(folder, "summary.json")
    if run[0] == "run":
        run = [*run, "--json", summary]
        run += [f"--shield={args.shield}"] if args.shield else []
        run += [f"--record={args.record}"] if args.record else []
    began = time.perf_counter()
    simulation.time_calls(traffic)
    try:
        with quiet(args.json == "-" and run[0] == "run"):
            code = world.run(traffic, run)
    finally:
        simulation.close()
    totals, wall_s = simulation.totals, time.perf_counter() - began
    said = {
        "departed": totals.departed,
        "arrived": totals.arrived,
        "mean_travel_s": totals.travel_s / totals.arrived if totals.arrived else None,
        "collisions": totals.collisions,
        "collided_pairs": len(totals.pairs),
        "collided_pairs_automated": sum(count > 0 for count in totals.pairs.values()),
        "teleports": totals.teleports,
        "vehicle_steps": totals.vehicle_steps,
        "sumo_s": totals.sumo_s,
        "adapter_s": totals.adapter_s,
        "wall_s": wall_s,
    }
    if run[0] == "run" and os.path.exists(summary):
        with open(summary) as file:
            all_of_it = {**json.load(file), "sumo": said}
        if args.json == "-":
            print(json.dumps(all_of_it, indent=2))
        elif args.json:
            try:
                with open(args.json, "w") as file:
                    json.dump(all_of_it, file, indent=2)
            except OSError as error:
                raise Error(f"--json {args.json}: {error.strerror}") from error
    if code != 0:
        return code  # It has said why.
    automated = f" ({said['collided_pairs_automated']} with one that was commanded)" if totals.pairs else ""
    pairs = "pair" if len(totals.pairs) == 1 else "pairs"
    mean = f", mean travel time {said['mean_travel_s']:.2f} s" if totals.arrived else ""
    print(
        f"SUMO: {totals.departed} departed, {totals.arrived} arrived{mean}; {len(totals.pairs)} {pairs} collided{automated}, "
        f"{totals.teleports} teleports; of {wall_s:.2f} s {totals.sumo_s:.2f} were SUMO's own steps, "
        f"{totals.adapter_s:.2f} this package's, for {totals.vehicle_steps} vehicle-steps",
        file=sys.stderr,
    )
    begins = {sample.split(": ", 1)[1]: sample for sample in reversed(totals.collisions)}
    for collision in list(reversed(begins.values()))[:3]:
        print(f"SUMO: collision at {collision}", file=sys.stderr)
    return code


