"""One scene at a time, for interfaces that know no batch: NumPy in, NumPy out, no reset of its own accord."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from envs.adapters.core import Episodes, Outcome, SwarmCore
from envs.config import SEEDS
from envs.record import Array
from envs.state import State
from swarm_mjcf.errors import SpecError, SwarmError


class OneScene:
    """A `SwarmCore` with a batch of one. `reset` plays scene 0 of a seed, then 1, 2, ...; or the one asked for."""

    def __init__(self, core: SwarmCore) -> None:
        self.core = core
        self._episodes: Episodes | None = None
        self._next, self._seed = 0, None

    @property
    def state(self) -> State:
        """The state now, a batch of one; for experts and pictures."""
        if self._episodes is None:
            raise SwarmError("this environment has no state yet: call reset() first")
        return self._episodes.state

    def reset(self, seed: int | None, *, rng: np.random.Generator, scene: int | None = None) -> Outcome:
        """Starts the next scene; a `seed` starts its series anew, and `rng` draws one where none was ever given."""
        if seed is not None or self._seed is None:
            series, number = int(rng.integers(SEEDS) if seed is None else seed), 0
        else:
            series, number = self._seed, self._next
        number = number if scene is None else scene
        self._episodes, outcome = self.core.start(series, np.asarray([number]))  # refuses what cannot be
        self._seed, self._next = series, number + 1
        return _only(outcome)

    def step(self, action: Any) -> Outcome:
        """One control step of actions (N, 2)."""
        if self._episodes is None:
            raise SwarmError("step() was called before reset(): call reset() first")
        action = self.core.action(action, (self.core.spec.num_agents, 2))
        self._episodes, outcome = self.core.step(self._episodes, action[None])
        return _only(outcome)

    def picture(self, size: int) -> np.ndarray:
        """The scene now, seen from above, uint8 (size, size, 3)."""
        from envs.adapters.picture import picture

        return picture(self.core.spec, self.state, 0, size=size)


def _only(outcome: Outcome) -> Outcome:
    """The one scene of a batch, as NumPy arrays that the caller may change and keep."""
    return jax.tree.map(lambda x: np.array(x[0]) if x.ndim else np.asarray(x), jax.device_get(outcome))


def scene_option(options: dict[str, Any] | None, *, strict: bool = True) -> int | None:
    """`options={"scene": 7}`; raises SpecError for another option, unless they are to be passed over."""
    options = options or {}
    if strict and set(options) - {"scene"}:
        raise SpecError("options", sorted(options), "scene: which scene of the seed to play")
    scene = options.get("scene")
    if scene is not None and not isinstance(scene, int | np.integer):
        raise SpecError("scene", scene, "a whole number")
    return None if scene is None else int(scene)


def mean_reward(reward: Float[Array, "*S N"], present: Bool[Array, "*S N"]) -> Float[np.ndarray, "*S"]:
    """Mean over the agents that are there, float64: the team's reward of a scene, or of each."""
    here = np.asarray(present)
    total = np.sum(np.asarray(reward, np.float64), axis=-1, where=here)
    return np.asarray(total / np.maximum(here.sum(axis=-1), 1))
