"""One scene as a `dm_env.Environment`: one controller steers all agents, the reward is their mean."""

import dm_env
import numpy as np
from dm_env import specs

from envs.adapters.core import SwarmCore
from envs.adapters.scene import OneScene, mean_reward
from envs.state import State


class SwarmDmEnv(dm_env.Environment):
    """Observation (N, D) as `core.observation.labels` say; action (N, 2) in [-1, 1], times `max_acceleration` [m/s^2].

    Episodes are scenes 0, 1, 2, ... of `seed`. The discount is 0 where a scene terminated and 1 where its horizon
    truncated it.
    """

    def __init__(self, core: SwarmCore, *, seed: int = 0) -> None:
        self.core, self._scene = core, OneScene(core)
        self._seed: int | None = seed
        self._over = True

    @property
    def state(self) -> State:
        """The state now, a batch of one: what a project policy looks at."""
        return self._scene.state

    def reset(self) -> dm_env.TimeStep:
        """Starts the next scene."""
        seed, self._seed, self._over = self._seed, None, False
        outcome = self._scene.reset(seed, rng=np.random.default_rng())
        return dm_env.restart(np.asarray(outcome.observation))

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """One control step; the first step of all and the step after a scene's end reset, whatever the action."""
        if self._over:
            return self.reset()
        outcome = self._scene.step(action)
        reward, seen = float(mean_reward(outcome.reward, outcome.present)), np.asarray(outcome.observation)
        self._over = bool(outcome.terminated | outcome.truncated)
        if outcome.terminated:
            return dm_env.termination(reward, seen)
        return dm_env.truncation(reward, seen, 1.0) if self._over else dm_env.transition(reward, seen, 1.0)

    def observation_spec(self) -> specs.BoundedArray:  # type: ignore[override]
        """(N, D) float32, bounds in the units of the labels."""
        return observation_spec(self.core)

    def action_spec(self) -> specs.BoundedArray:  # type: ignore[override]
        """(N, 2) float32 in [-1, 1]."""
        return specs.BoundedArray((self.core.spec.num_agents, 2), np.float32, -1.0, 1.0, name="acceleration")


def observation_spec(core: SwarmCore) -> specs.BoundedArray:
    """What all agents of a scene see."""
    low, high = core.observation.low, core.observation.high
    return specs.BoundedArray((core.spec.num_agents, len(low)), np.float32, low, high, name="observation")
