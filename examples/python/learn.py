"""A controller that was learnt: an evolution strategy on a small network, in numpy, in minutes on two cores.

    python3 learn.py train                # writes learnt.json beside this file
    cz run paper --shield on --controller merge-1,merge-2="python3 learn.py drive"

Every vehicle is driven by the same function of what it sees. It is trained in `control_zones.env` under the shield, on random
arrivals, each zone with the other one under the paper's law, for the paper's cost; learnt.toml has it compared with others:

    cz compare paper-none learnt.toml learnt.toml:shield=on --scenario paper --seeds 4-23

To train needs `pip install "control-zones[env]"`, to drive control-zones and numpy.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import time
from pathlib import Path

import numpy

import control_zones

LEARNT = Path(__file__).with_name("learnt.json")
SCENARIO, ZONES = "paper", ("merge-1", "merge-2")
#: Reaction time of the scenario, s, and length of its approaches, m.
REACTION_S, LENGTH_M = 1.8, 200.0
#: What the vehicles of a policy see, and units of the hidden layer.
SEEN, HIDDEN = 13, 8
WEIGHTS = SEEN + SEEN * HIDDEN + HIDDEN

#: Half of the policies that are tried per round, each with its opposite; their spread; how far a round goes.
PAIRS, SPREAD, RATE = 32, 0.1, 0.06
ROUNDS = 100
#: Vehicles of an episode; rows of an observation.
VEHICLES, CAPACITY = 40, 16
#: The seeds up to 23 are those of the comparison.
FIRST_SEED = 1000


def seen(rows):
    """What a policy is given: features of about 1, from those of the environment."""
    present, _, x, v, _, remaining, in_zone, _, _, _, _, _, *partners = numpy.moveaxis(rows[..., :21], -1, 0)
    has_ahead, ahead_m, ahead_mps, ahead_mps2, has_merge, merge_m, merge_mps, merge_mps2, merge_in = partners
    of_reaction = 1.0 - merge_in / LENGTH_M
    return numpy.stack(
        [
            present,
            present * (v - 17.0) / 3.0,
            remaining / LENGTH_M,
            present * (in_zone - x / 17.0) / 3.0,
            has_ahead,
            has_ahead * ((ahead_m - REACTION_S * v) / 20.0).clip(-2.0, 2.0),
            ahead_mps / 3.0,
            ahead_mps2 / 3.0,
            has_merge,
            has_merge * ((merge_m - REACTION_S * of_reaction * v) / 20.0).clip(-2.0, 2.0),
            merge_mps / 3.0,
            merge_mps2 / 3.0,
            merge_in / LENGTH_M,
        ],
        axis=-1,
    )


def act(weights, rows):
    """Accelerations, m/s^2, of policies (first axis of both) that see these rows."""
    given = seen(rows)
    direct = weights[:, :SEEN, None]
    inner = weights[:, SEEN : SEEN + SEEN * HIDDEN].reshape(-1, SEEN, HIDDEN)
    outer = weights[:, SEEN + SEEN * HIDDEN :, None]
    return (given @ direct + numpy.tanh(given @ inner) @ outer)[..., 0].clip(-4.0, 4.0)


class Zone:
    """Episodes in a zone, as many side by side as policies are tried, and one that the paper's law drives."""

    def __init__(self, zone):
        from control_zones.env import ZoneVectorEnv

        # Whoever stands still has had enough after this.
        sets = {"end.vehicles": VEHICLES, "end.time_s": 220.0}
        self.env = ZoneVectorEnv(2 * PAIRS + 1, SCENARIO, zone=zone, sets=sets, shield="on", capacity=CAPACITY)

    def costs(self, weights, seed):
        """What the same arrivals cost each policy, and at last the law, per vehicle."""
        count = self.env.num_envs
        rows, _ = self.env.reset(seed=[seed] * count)
        costs, running = numpy.zeros(count), numpy.ones(count, dtype=bool)
        while running.any():
            actions = self.env.law(rows)
            actions[:-1] = act(weights, rows[:-1])
            rows, rewards, ended, late, _ = self.env.step(actions)
            costs -= rewards * running
            running &= ~(ended | late)
        return costs / VEHICLES


_zone = None


def costs_of(zone, weights, seed):
    """`Zone.costs` in a process that has this zone only."""
    global _zone
    _zone = _zone or Zone(zone)
    return _zone.costs(weights, seed)


def train(rounds):
    """Natural evolution of the mean of a normal distribution of weights, ranks in place of costs."""
    random = numpy.random.default_rng(1)
    mean, momentum = numpy.zeros(WEIGHTS), numpy.zeros(WEIGHTS)
    # To begin with it holds a speed: who stands still learns slowly.
    mean[1] = -1.0
    mean[SEEN : SEEN + SEEN * HIDDEN] = random.normal(0.0, 0.3, SEEN * HIDDEN)
    start = time.monotonic()
    pools = [multiprocessing.Pool(1) for _ in ZONES]
    for turn in range(rounds):
        noise = random.normal(size=(PAIRS, WEIGHTS))
        noise = numpy.concatenate([noise, -noise])
        work = (mean + SPREAD * noise, FIRST_SEED + turn)
        asked = [pool.apply_async(costs_of, (zone, *work)) for pool, zone in zip(pools, ZONES)]
        *costs, law = numpy.sum([answer.get() for answer in asked], axis=0)
        ranks = numpy.argsort(numpy.argsort(numpy.negative(costs))) / (len(costs) - 1) - 0.5
        momentum = 0.8 * momentum + ranks @ noise / len(costs)
        mean += RATE / SPREAD * momentum * (1.0 - turn / rounds)
        if turn % 10 == 9:
            minutes = (time.monotonic() - start) / 60.0
            mean_cost = sum(costs) / len(costs)
            print(f"round {turn + 1}: {mean_cost:.2f} on average, the law {law:.2f}, {minutes:.1f} min", flush=True)
    LEARNT.write_text(json.dumps([round(weight, 6) for weight in mean.tolist()]) + "\n")


def drive():
    """The controller."""
    weights = numpy.array(json.loads(LEARNT.read_text()))[None]
    control_zones.run(lambda zone: act(weights, control_zones.features(zone)[None])[0])


if __name__ == "__main__":
    if sys.argv[1:2] == ["train"]:
        train(int(sys.argv[2]) if len(sys.argv) > 2 else ROUNDS)
    elif sys.argv[1:] == ["drive"]:
        drive()
    else:
        raise SystemExit(__doc__)
