"""Checks `control_zones.env` as Gymnasium and PettingZoo ask for, and against `cz run`.

Usage: python3 sdk/python/check_env.py [CZ]   (the program `cz`; the one on the path by default)
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import gymnasium
import numpy
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test, parallel_seed_test

from control_zones import Error
from control_zones.env import ZoneEnv, ZonesEnv, ZoneVectorEnv


def run_by(cz: str, *arguments: str) -> dict[str, object]:
    """The summary of a run."""
    command = [cz, "run", *arguments, "--in-process", "--json", "-"]
    found: dict[str, object] = json.loads(subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout)
    return found


def as_the_law(cz: str) -> None:
    """Whoever commands what the law would has the run of `cz run`."""
    for scenario, shield, seed in (("two-merges", "off", 1), ("two-merges", "on", 3), ("intersection", "off", 1)):
        expected = run_by(cz, scenario, "--seed", str(seed), "--shield", shield)["state_hash"]
        env = ZoneEnv(scenario, shield=shield)
        observation, info = env.reset(seed=seed)
        ended = False
        while not ended:
            observation, _, terminated, truncated, info = env.step(env.law(observation))
            ended = terminated or truncated
        if info["state_hash"] != expected:
            raise SystemExit(f"{scenario}, shield {shield}: state hash {info['state_hash']}, expected {expected}")
        zones = ZonesEnv(scenario, shield=shield)
        seen, _ = zones.reset(seed=seed)
        while zones.agents:
            seen, _, _, _, _ = zones.step(zones.law(seen))
        if zones.state_hash() != expected:
            raise SystemExit(f"{scenario}, shield {shield}, all zones: {zones.state_hash()}, expected {expected}")
        print(f"{scenario}, shield {shield}, seed {seed}: {expected}, as by cz run")


#: Holds 15 m/s, and writes down what it sees.
CONTROLLER = """
import pickle, control_zones
with open("seen", "wb") as file:
    def cruise(zone):
        pickle.dump((zone.step, zone.name, control_zones.features(zone)), file)
        return (15.0 - zone.v).clip(-2.0, 2.0)
    control_zones.run(cruise)
"""


def as_a_controller(cz: str) -> None:
    """A controller sees what an environment shows, and has the same run."""
    sets = {"end.vehicles": 10}
    for scenario in ("paper", "two-merges"):
        seen = {}
        with tempfile.TemporaryDirectory(prefix="cz-env-") as place:
            (Path(place) / "cruise.py").write_text(CONTROLLER)
            command = [os.path.abspath(cz) if os.path.dirname(cz) else cz, "run", scenario, "--json", "-", "--shield", "on"]
            command += ["--controller", f"merge-1,merge-2={sys.executable} cruise.py"]
            command += [f"--set={key}={value}" for key, value in sets.items()]
            run = json.loads(subprocess.run(command, stdout=subprocess.PIPE, check=True, cwd=place).stdout)
            with (Path(place) / "seen").open("rb") as file:
                while True:
                    try:
                        step, name, rows = pickle.load(file)
                    except EOFError:
                        break
                    seen[step, name] = rows
        env = ZonesEnv(scenario, sets=sets, shield="on")
        shown, _ = env.reset(seed=1)
        step = 0
        while env.agents:
            for name, rows in shown.items():
                there = rows[rows[:, 0] > 0]
                if len(there) and not numpy.allclose(there[:, :-1], seen[step, name][:, :-1], rtol=0, atol=1e-9):
                    raise SystemExit(f"{scenario}, step {step}, {name}: a controller sees what the environment does not show")
            speeds = {name: rows[:, env.features.index("v_mps")] for name, rows in shown.items()}
            actions = {name: (15.0 - v).clip(-2.0, 2.0) for name, v in speeds.items()}
            shown, *_ = env.step(actions)
            step += 1
        if env.state_hash() != run["state_hash"]:
            raise SystemExit(f"{scenario}: {env.state_hash()} in the environment, {run['state_hash']} by a controller")
        print(f"{scenario}: a controller sees what the environment shows, {len(seen)} views, and has the same run")


def side_by_side() -> None:
    """Episodes side by side are those alone, and begin anew after their end."""
    settings = {"end.vehicles": 10}
    many = ZoneVectorEnv(3, "two-merges", sets=settings)
    observations, info = many.reset(seed=5)
    alone = [ZoneEnv("two-merges", sets=settings) for _ in range(3)]
    firsts = [env.reset(seed=5 + index)[0] for index, env in enumerate(alone)]
    ended = [False] * 3
    episodes = 0
    random = numpy.random.default_rng(1)
    for _ in range(2000):
        actions = random.uniform(-1, 1, observations.shape[:2])
        observations, rewards, terminated, truncated, info = many.step(actions)
        for index, env in enumerate(alone):
            if ended[index]:
                if rewards[index] != 0 or terminated[index] or truncated[index]:
                    raise SystemExit("the step in which an episode begins anew has a reward or an end")
                seed = int(info["seed"][index])
                firsts[index], ended[index] = env.reset(seed=seed)[0], False
                episodes += 1
            else:
                firsts[index], reward, over, late, _ = env.step(actions[index])
                if (reward, over, late) != (rewards[index], terminated[index], truncated[index]):
                    raise SystemExit(f"episode {index} side by side: {rewards[index]}, alone: {reward}")
                ended[index] = over or late
            if not numpy.array_equal(firsts[index], observations[index]):
                raise SystemExit(f"episode {index} looks different side by side and alone")
    if episodes < 3:
        raise SystemExit(f"only {episodes} episodes ended")
    print(f"three side by side are those alone, through {episodes} new beginnings")


def mistakes() -> None:
    """What is said of them."""
    for make, words in (
        (lambda: ZoneEnv("two-merges", zone="merge-3"), "expected one of merge-1, merge-2"),
        (lambda: ZoneEnv("no-such-scenario"), "no-such-scenario"),
        (lambda: ZoneEnv(sets={"shield": "perhaps"}), "shield"),
    ):
        try:
            make()
        except Error as error:
            if words not in str(error):
                raise SystemExit(f"{error}: expected {words}") from error
        else:
            raise SystemExit(f"no error; expected one with {words}")


def speed() -> None:
    """Steps per second; the law drives."""
    env = ZoneEnv("two-merges")
    observation, _ = env.reset(seed=1)
    start, steps = time.perf_counter(), 20_000
    for _ in range(steps):
        observation, _, terminated, truncated, _ = env.step(env.law(observation))
        if terminated or truncated:
            observation, _ = env.reset(seed=1)
    print(f"one: {steps / (time.perf_counter() - start):.0f} steps/s")
    many = ZoneVectorEnv(64, "two-merges")
    observations, _ = many.reset(seed=1)
    start, steps = time.perf_counter(), 1_000
    for _ in range(steps):
        observations, _, _, _, _ = many.step(many.law(observations))
    print(f"64 in a batch: {64 * steps / (time.perf_counter() - start):.0f} steps/s")


def main() -> None:
    """All of it."""
    cz = sys.argv[1] if len(sys.argv) > 1 else "cz"
    warnings.simplefilter("error")
    # Two things Gymnasium suggests: bounds of observations, and actions between -1 and 1.
    warnings.filterwarnings("ignore", message=".*(minimum|maximum) value is -?infinity.*")
    warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
    check_env(ZoneEnv("two-merges"), skip_render_check=True)
    check_env(ZoneEnv("intersection", shield="on"), skip_render_check=True)
    print("gymnasium's check_env: passed")
    parallel_api_test(ZonesEnv("two-merges"), num_cycles=5000)
    parallel_seed_test(lambda: ZonesEnv("two-merges"), num_cycles=500)
    print("pettingzoo's parallel_api_test and parallel_seed_test: passed")
    as_the_law(cz)
    as_a_controller(cz)
    side_by_side()
    mistakes()
    speed()


main()
