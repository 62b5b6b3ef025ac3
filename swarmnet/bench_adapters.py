"""Scene-steps per second through each adapter, as ratios to the environment's own in the same run."""

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import jax
import numpy as np

from envs.adapters import SwarmDmEnv, SwarmGymEnv, SwarmParallelEnv, SwarmVectorEnv, control_environment, make_core
from envs.adapters.core import SwarmCore
from envs.config import make_world
from envs.experts.registry import make_expert
from envs.swarm_env import scene_keys

Act = Callable[..., np.ndarray]
"""`state -> action (S, N, 2)` in [-1, 1]."""
Play = Iterator[None]
"""Each `next` is one step, with the resets that it brings."""
_DRAWN = 16


@dataclass(frozen=True)
class AdapterRate:
    """One cell: median scene-steps/s, and its ratio to `environment` with the same policy and number of scenes."""

    adapter: str
    policy: str
    scenes: int
    per_second: float
    ratio: float
    """Median of ratios taken pair by pair; 1 for the environment itself."""


def bench_adapters(
    *,
    scenes: int = 1024,
    num_agents: int = 5,
    num_obstacles: int = 1,
    turns: int = 15,
    seconds: float = 0.2,
    engine: str = "auto",
) -> Iterator[AdapterRate]:
    """Rows for a random and an expert policy, in the preset `clear` with episodes that end at contacts or 60 steps.

    The yardstick, `environment`, is the jitted `SwarmEnv.step` called from Python step by step with as many scenes and
    the same policy, its ends fetched each step; it sees, earns and resets nothing. The adapters do all that. `scenes`
    is the batch of the vector environment; the others play one scene, and so does their yardstick. All play in turn,
    about `seconds` at a time, so that what else the machine does hits all alike.
    """
    core = make_core(num_agents=num_agents, num_obstacles=num_obstacles, engine=engine)
    expert = make_world("clear", num_agents=num_agents, num_obstacles=num_obstacles).expert
    acting = core.acting(make_expert(expert))
    for policy in ("random", "expert"):

        def act(count: int, policy: str = policy) -> Act:
            return _random(core, count) if policy == "random" else lambda state: np.asarray(acting(state))

        batched = {
            "environment": _own(core, scenes, act(scenes)),
            "gymnasium vector": _vector(core, scenes, act(scenes)),
        }
        alone = {
            "environment": _own(core, 1, act(1)),
            "gymnasium": _gymnasium(core, act(1)),
            "pettingzoo": _pettingzoo(core, act(1)),
            "dm_env": _dm_env(core, act(1)),
            "dm_control": _dm_control(core, act(1)),
        }
        for count, plays in ((scenes, batched), (1, alone)):
            yield from _timed(plays, policy, count, turns=turns, seconds=seconds)


def _random(core: SwarmCore, scenes: int) -> Act:
    shape = (_DRAWN, scenes, core.spec.num_agents, 2)
    drawn = itertools.cycle(np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32))
    return lambda state: next(drawn)


def _own(core: SwarmCore, scenes: int, act: Act) -> Play:
    step = jax.jit(lambda state, action: core.env.step(state, action * core.spec.max_acceleration))
    state = core.env.reset(scene_keys(0, range(scenes)))
    while True:
        transition = step(state, act(state))
        jax.device_get((transition.terminated, transition.truncated))
        state = transition.state
        yield


def _vector(core: SwarmCore, scenes: int, act: Act) -> Play:
    env = SwarmVectorEnv(core, scenes)
    env.reset(seed=0)
    while True:
        env.step(act(env.state))
        yield


def _gymnasium(core: SwarmCore, act: Act) -> Play:
    env = SwarmGymEnv(core)
    env.reset(seed=0)
    while True:
        _, _, terminated, truncated, _ = env.step(act(env.state)[0])
        if terminated or truncated:
            env.reset()
        yield


def _pettingzoo(core: SwarmCore, act: Act) -> Play:
    env = SwarmParallelEnv(core)
    env.reset(seed=0)
    while True:
        env.step(dict(zip(env.agents, act(env.swarm_state)[0], strict=True)))
        if not env.agents:
            env.reset()
        yield


def _dm_env(core: SwarmCore, act: Act) -> Play:
    env = SwarmDmEnv(core)
    env.reset()
    while True:
        if env.step(act(env.state)[0]).last():
            env.reset()
        yield


def _dm_control(core: SwarmCore, act: Act) -> Play:
    env = control_environment(core)
    env.reset()
    while True:
        if env.step(act(env.task.state)[0]).last():
            env.reset()
        yield


def _timed(plays: dict[str, Play], policy: str, scenes: int, *, turns: int, seconds: float) -> Iterator[AdapterRate]:
    """The plays in turn, A B C A B C ...; the others are divided by the first."""

    def timed(play: Play, steps: int) -> float:
        begun = time.perf_counter()
        for _ in range(steps):
            next(play)
        return (time.perf_counter() - begun) / steps

    steps = {}
    for name, play in plays.items():
        timed(play, 3)  # compiles
        steps[name] = int(np.clip(round(seconds / timed(play, 3)), 1, 5000))
    each = {name: [] for name in plays}
    for _ in range(turns):
        for name, play in plays.items():
            each[name].append(timed(play, steps[name]))
    base = np.asarray(next(iter(each.values())))
    for name, values in each.items():
        ratio = float(np.median(base / np.asarray(values)))
        yield AdapterRate(name, policy, scenes, scenes / float(np.median(values)), ratio)
