"""Control Zones as an environment to learn in, for Gymnasium and PettingZoo.

    import control_zones.env

    env = control_zones.env.ZoneEnv("two-merges", zone="merge-2", shield="on")
    observation, info = env.reset(seed=1)
    observation, reward, terminated, truncated, info = env.step(env.law(observation))

World, coordinator and the built-in law run in this process and thread, without frames in between: `reset(seed=1)` begins
the run of `cz run --seed 1`, bit for bit, and whoever commands what the law would command ends with its state hash.

An observation has a row for each of the first `capacity` vehicles of a zone in passing order, and a column for each name
in `features`; rows of nobody are 0. An action is one acceleration per row, m/s^2. Vehicles behind the last row, and in
zones that are not the environment's, are driven by the built-in law. With `shield="on"` every acceleration is projected to
what keeps the safety margins. A reward is what a step cost a zone's vehicles, negative: beta times the time they were in
the zone plus the integral of u^2/2, in m^2/s^3; the rewards of an episode add up to what its vehicles have cost.

Needs numpy, gymnasium and pettingzoo: `pip install "control-zones[env]"`.
"""

from __future__ import annotations

import ctypes
import json
import os
import typing

import gymnasium
import numpy
import pettingzoo
from gymnasium.spaces import Box, Space
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ._features import FEATURES
from ._library import load as _load
from ._session import Error

if typing.TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

__all__ = ["ZoneEnv", "ZoneVectorEnv", "ZonesEnv"]

Floats = NDArray[numpy.float64]
Info = dict[str, typing.Any]

#: Vehicles of a zone in an observation, unless told otherwise.
CAPACITY = 32
#: How a run stands after a step.
_SERVED, _OUT_OF_TIME = 1, 2


def _library() -> ctypes.CDLL:
    library = _load()
    handle, text, number = ctypes.c_void_p, ctypes.c_char_p, ctypes.c_uint32
    for name, result, arguments in (
        ("error", text, []),
        ("new", handle, [text, text, text, number, number]),
        ("describe", handle, [handle]),
        ("forget", None, [handle]),
        ("reset", ctypes.c_int, [handle, number, ctypes.c_uint64, ctypes.c_int]),
        ("step", ctypes.c_int, [handle, number, handle, handle, handle]),
        ("observe", ctypes.c_int, [handle, number, handle, handle, handle]),
        ("state_hash", ctypes.c_uint64, [handle, number]),
        ("free", None, [handle]),
    ):
        function = getattr(library, f"cz_env_{name}")
        function.restype, function.argtypes = result, arguments
    return library


class _Runs:
    """Runs of one scenario side by side, and the arrays in which they are seen."""

    def __init__(
        self,
        scenario: str | None,
        zones: Sequence[str],
        sets: Mapping[str, object] | Iterable[str],
        shield: str | None,
        capacity: int,
        count: int,
    ) -> None:
        self._handle: int | None = None
        self._library = _library()
        if not 1 <= capacity <= 10_000 or not 1 <= count <= 100_000:
            raise Error(f"capacity = {capacity}, count = {count}: expected 1 to 10000, and 1 to 100000")
        lines = [f"{key}={value}" for key, value in sets.items()] if hasattr(sets, "items") else list(sets)
        if shield is not None:
            lines.append(f"shield={shield}")
        given = None if scenario is None else os.fspath(scenario).encode()
        joined = ["\n".join(lines).encode(), "\n".join(zones).encode()]
        self._handle = self._library.cz_env_new(given, *joined, capacity, count)
        if self._handle is None:
            raise self._error()
        described = self._library.cz_env_describe(self._handle)
        self.about: dict[str, typing.Any] = json.loads(ctypes.string_at(described))
        self._library.cz_env_forget(described)
        # What is trained here drives by `control_zones.features`.
        if self.about["features"] != list(FEATURES):
            raise Error(f"{self.about['features']} are the library's features, expected those of this package: {FEATURES}")
        self.zones: list[str] = self.about["zones"]
        rows = (count, len(self.zones), capacity)
        self.count = count
        self.features: Floats = numpy.zeros((*rows, len(self.about["features"])))
        self.vehicles: NDArray[numpy.uint32] = numpy.zeros(rows, dtype=numpy.uint32)
        self.unseen: NDArray[numpy.uint32] = numpy.zeros(count, dtype=numpy.uint32)
        self.rewards: Floats = numpy.zeros(rows[:2])
        self.ends: NDArray[numpy.uint8] = numpy.zeros(count, dtype=numpy.uint8)
        self._shape = rows

    def _error(self) -> Error:
        return Error(self._library.cz_env_error().decode(errors="replace"))

    def action_space(self) -> Space[Floats]:
        """Accelerations within what the vehicles can do."""
        space = Box(self.about["u_min_mps2"], self.about["u_max_mps2"], self._shape[2:], numpy.float64)
        return typing.cast("Space[Floats]", space)

    def observation_space(self) -> Space[Floats]:
        """Rows of vehicles."""
        space = Box(-numpy.inf, numpy.inf, self.features.shape[2:], numpy.float64)
        return typing.cast("Space[Floats]", space)

    def law_column(self) -> int:
        """The feature that says what the law would do."""
        return list(self.about["features"]).index("law_mps2")

    def reset(self, index: int, seed: int | None) -> None:
        """Begins a run anew."""
        if self._library.cz_env_reset(self._open(), index, seed or 0, seed is not None) != 0:
            raise self._error()

    def observe(self) -> None:
        """Looks at all runs: `features`, `vehicles` and `unseen` are new then."""
        at = self.features.ctypes.data, self.vehicles.ctypes.data, self.unseen.ctypes.data
        if self._library.cz_env_observe(self._open(), self.count, *at) != 0:
            raise self._error()

    def step(self, actions: typing.Any) -> None:
        """One step of all runs that have not ended: `rewards` and `ends` are new then, and what is seen."""
        given = numpy.ascontiguousarray(actions, dtype=numpy.float64)
        if given.shape != self._shape:
            raise Error(f"actions have shape {given.shape}, expected {self._shape}")
        at = given.ctypes.data, self.rewards.ctypes.data, self.ends.ctypes.data
        if self._library.cz_env_step(self._open(), self.count, *at) != 0:
            raise self._error()
        self.observe()

    def state_hash(self, index: int) -> str:
        """The state hash of a run so far, as `cz run` prints it."""
        return f"{self._library.cz_env_state_hash(self._open(), index):016x}"

    def _open(self) -> int:
        if self._handle is None:
            raise Error("the environment is closed")
        return self._handle

    def close(self) -> None:
        """Ends all of it."""
        if self._handle is not None:
            self._library.cz_env_free(self._handle)
            self._handle = None

    def __del__(self) -> None:
        self.close()


def _runs_of_a_zone(
    scenario: str | None,
    zone: str | None,
    sets: Mapping[str, object] | Iterable[str],
    shield: str | None,
    capacity: int,
    count: int,
) -> tuple[_Runs, str]:
    """Runs of which one zone is driven from outside, the first unless it is named; and its name."""
    if zone is None:
        all_zones = _Runs(scenario, (), sets, shield, 1, 1)
        zone = all_zones.zones[0]
        all_zones.close()
    return _Runs(scenario, (zone,), sets, shield, capacity, count), zone


def _drawn(random: numpy.random.Generator) -> int:
    """The seed of an episode that was given none."""
    return int(random.integers(2**31))


class ZoneEnv(gymnasium.Env[Floats, Floats]):
    """One zone of a scenario for Gymnasium; the others are driven by the built-in law.

    Args:
        scenario: as on the command line of `cz run`: an embedded name or a file; None is the default.
        zone: the zone's name; None is the scenario's first.
        sets: keys of the scenario and their values, as for `--set`: a dictionary, or lines `KEY=VALUE`.
        shield: "off", "observe" or "on"; None leaves it to the scenario.
        capacity: rows of an observation.

    An episode is terminated once everybody has arrived and left, and truncated when the scenario's time is up. Without
    `seed`, `reset` draws one from those before. `info` has the seed, the vehicles' ids row by row (`NO_VEHICLE` in rows of
    nobody), the number of vehicles behind the last row, and the state hash at the end.
    """

    metadata: Info = {"render_modes": []}

    def __init__(
        self,
        scenario: str | None = None,
        zone: str | None = None,
        sets: Mapping[str, object] | Iterable[str] = (),
        shield: str | None = None,
        capacity: int = CAPACITY,
    ) -> None:
        self._runs, self.zone = _runs_of_a_zone(scenario, zone, sets, shield, capacity, 1)
        self.features: list[str] = self._runs.about["features"]
        self.action_space = self._runs.action_space()
        self.observation_space = self._runs.observation_space()
        self._seed = 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Floats, Info]:
        super().reset(seed=seed)
        self._seed = _drawn(self.np_random) if seed is None else seed
        self._runs.reset(0, self._seed)
        self._runs.ends[0] = 0
        self._runs.observe()
        return self._runs.features[0, 0].copy(), self._info()

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, Info]:
        self._runs.step(numpy.asarray(action)[None, None])
        end = self._runs.ends[0]
        reward = float(self._runs.rewards[0, 0])
        return self._runs.features[0, 0].copy(), reward, bool(end == _SERVED), bool(end == _OUT_OF_TIME), self._info()

    def law(self, observation: Floats) -> Floats:
        """What the built-in law commands where this is observed."""
        law: Floats = observation[..., self._runs.law_column()].copy()
        return law

    def _info(self) -> Info:
        info: Info = {
            "seed": self._seed,
            "vehicles": self._runs.vehicles[0, 0].copy(),
            "unseen": int(self._runs.unseen[0]),
        }
        if self._runs.ends[0]:
            info["state_hash"] = self._runs.state_hash(0)
        return info

    def close(self) -> None:
        self._runs.close()


class ZoneVectorEnv(VectorEnv[Floats, Floats, Floats]):
    """As many episodes of a `ZoneEnv` side by side, in one call per step.

    An episode that has ended begins anew in the next step, whose action does nothing and whose reward is 0.
    """

    metadata: Info = {
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int,
        scenario: str | None = None,
        zone: str | None = None,
        sets: Mapping[str, object] | Iterable[str] = (),
        shield: str | None = None,
        capacity: int = CAPACITY,
    ) -> None:
        self._runs, self.zone = _runs_of_a_zone(scenario, zone, sets, shield, capacity, num_envs)
        self.num_envs = num_envs
        self.features: list[str] = self._runs.about["features"]
        self.single_action_space = self._runs.action_space()
        self.single_observation_space = self._runs.observation_space()
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._seeds: NDArray[numpy.int64] = numpy.zeros(num_envs, dtype=numpy.int64)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Info | None = None
    ) -> tuple[Floats, Info]:
        if isinstance(seed, int) or seed is None:
            super().reset(seed=seed)
            seeds = [None if seed is None else seed + index for index in range(self.num_envs)]
        else:
            seeds = list(seed)
            if len(seeds) != self.num_envs:
                raise Error(f"{len(seeds)} seeds are given, expected {self.num_envs}")
        for index, own in enumerate(seeds):
            self._begin(index, own)
        self._runs.ends[:] = 0
        self._runs.observe()
        return self._runs.features[:, 0].copy(), self._info()

    def _begin(self, index: int, seed: int | None) -> None:
        self._seeds[index] = _drawn(self.np_random) if seed is None else seed
        self._runs.reset(index, int(self._seeds[index]))

    # Gymnasium's types have one kind of array for rewards and flags.
    def step(  # type: ignore[override]
        self, actions: Floats
    ) -> tuple[Floats, Floats, NDArray[numpy.bool_], NDArray[numpy.bool_], Info]:
        ended = numpy.flatnonzero(self._runs.ends)
        self._runs.step(numpy.asarray(actions)[:, None])
        if len(ended):
            for index in ended:
                self._begin(int(index), None)
            self._runs.ends[ended] = 0
            self._runs.observe()
        ends = self._runs.ends
        rewards = self._runs.rewards[:, 0].copy()
        return self._runs.features[:, 0].copy(), rewards, ends == _SERVED, ends == _OUT_OF_TIME, self._info()

    def law(self, observation: Floats) -> Floats:
        """What the built-in law commands where this is observed."""
        law: Floats = observation[..., self._runs.law_column()].copy()
        return law

    def state_hash(self, index: int) -> str:
        """The state hash of an episode so far."""
        return self._runs.state_hash(index)

    def _info(self) -> Info:
        return {
            "seed": self._seeds.copy(),
            "vehicles": self._runs.vehicles[:, 0].copy(),
            "unseen": self._runs.unseen.copy(),
        }

    def close_extras(self, **_: typing.Any) -> None:
        self._runs.close()


class ZonesEnv(pettingzoo.ParallelEnv[str, Floats, Floats]):
    """Zones of a scenario for PettingZoo: an agent is the controller of a zone, and is called like it.

    Args: as for `ZoneEnv`, and `zones`, their names; none of them is all.
    """

    metadata: Info = {"render_modes": [], "name": "control_zones_v0"}

    def __init__(
        self,
        scenario: str | None = None,
        zones: Sequence[str] = (),
        sets: Mapping[str, object] | Iterable[str] = (),
        shield: str | None = None,
        capacity: int = CAPACITY,
    ) -> None:
        self._runs = _Runs(scenario, zones, sets, shield, capacity, 1)
        self.possible_agents = list(self._runs.zones)
        self.agents: list[str] = []
        self.features: list[str] = self._runs.about["features"]
        self.action_spaces = {zone: self._runs.action_space() for zone in self.possible_agents}
        self.observation_spaces = {zone: self._runs.observation_space() for zone in self.possible_agents}
        self._random = numpy.random.default_rng()
        self._seed = 0

    def action_space(self, agent: str) -> Space[Floats]:
        return self.action_spaces[agent]

    def observation_space(self, agent: str) -> Space[Floats]:
        return self.observation_spaces[agent]

    def reset(
        self, seed: int | None = None, options: Info | None = None
    ) -> tuple[dict[str, Floats], dict[str, Info]]:
        if seed is not None:
            self._random = numpy.random.default_rng(seed)
        self._seed = _drawn(self._random) if seed is None else seed
        self._runs.reset(0, self._seed)
        self._runs.ends[0] = 0
        self._runs.observe()
        self.agents = list(self.possible_agents)
        return self._seen(), self._infos()

    def step(
        self, actions: dict[str, Floats]
    ) -> tuple[dict[str, Floats], dict[str, float], dict[str, bool], dict[str, bool], dict[str, Info]]:
        if not self.agents:
            return {}, {}, {}, {}, {}
        self._runs.step([[actions[zone] for zone in self.possible_agents]])
        rewards = {zone: float(reward) for zone, reward in zip(self.possible_agents, self._runs.rewards[0])}
        end = self._runs.ends[0]
        terminated = {zone: bool(end == _SERVED) for zone in self.possible_agents}
        truncated = {zone: bool(end == _OUT_OF_TIME) for zone in self.possible_agents}
        if end:
            self.agents = []
        return self._seen(), rewards, terminated, truncated, self._infos()

    def law(self, observations: dict[str, Floats]) -> dict[str, Floats]:
        """What the built-in law commands where this is observed."""
        column = self._runs.law_column()
        return {zone: observation[:, column].copy() for zone, observation in observations.items()}

    def state_hash(self) -> str:
        """The state hash of the episode so far."""
        return self._runs.state_hash(0)

    def _seen(self) -> dict[str, Floats]:
        return {zone: seen.copy() for zone, seen in zip(self.possible_agents, self._runs.features[0])}

    def _infos(self) -> dict[str, Info]:
        return {
            zone: {"seed": self._seed, "vehicles": vehicles.copy()}
            for zone, vehicles in zip(self.possible_agents, self._runs.vehicles[0])
        }

    def render(self) -> None:
        """Nothing is drawn; `cz view` shows runs."""

    def close(self) -> None:
        self._runs.close()
