"""One scene as a `gymnasium.Env`: one controller steers all agents, the reward is their mean."""

from typing import Any

import gymnasium
import numpy as np

from envs.adapters.core import Outcome, SwarmCore, make_core
from envs.adapters.gym_spaces import scene_spaces
from envs.adapters.scene import OneScene, mean_reward, scene_option
from envs.state import State
from swarm_mjcf.errors import SpecError

RENDER_MODES = ("rgb_array",)


class SwarmGymEnv(gymnasium.Env):
    """Observation (N, D) as `core.observation.labels` say; action (N, 2) in [-1, 1], times `max_acceleration` [m/s^2].

    `reset(seed=s)` plays scene 0 of seed s, further resets scenes 1, 2, ...; `reset(options={"scene": 7})` scene 7.
    Infos: `agent_reward` (N,), `agent_contacts` and `solid_contacts` (N,): substep states in contact, `present` (N,).

    Raises:
      SpecError: another render mode, a malformed action or option.
    """

    def __init__(self, core: SwarmCore, *, render_mode: str | None = None, size: int = 480) -> None:
        self.metadata = render_metadata(core)
        self.render_mode = check_mode(render_mode)
        self.observation_space, self.action_space = scene_spaces(core)
        self.core, self._scene, self._size = core, OneScene(core), size

    @property
    def state(self) -> State:
        """The state now, a batch of one: what a project policy looks at."""
        return self._scene.state

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """The first observation and its info."""
        super().reset(seed=seed)
        outcome = self._scene.reset(seed, rng=self.np_random, scene=scene_option(options))
        return outcome.observation, infos(outcome)  # type: ignore[return-value]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control step."""
        outcome = self._scene.step(action)
        ends = bool(outcome.terminated), bool(outcome.truncated)
        return outcome.observation, float(mean_reward(outcome.reward, outcome.present)), *ends, infos(outcome)  # type: ignore[return-value]

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """The scene from above, uint8 (size, size, 3)."""
        return None if self.render_mode is None else self._scene.picture(self._size)


def render_metadata(core: SwarmCore) -> dict[str, Any]:
    """What Gymnasium and PettingZoo want to know of pictures: modes, and frames per second of simulation."""
    return {"render_modes": list(RENDER_MODES), "render_fps": max(1, round(1 / core.spec.dt))}


def check_mode(mode: str | None) -> str | None:
    """The render mode; raises SpecError for one that is not there."""
    if mode is not None and mode not in RENDER_MODES:
        raise SpecError("render_mode", mode, "None or " + ", ".join(RENDER_MODES))
    return mode


def infos(outcome: Outcome) -> dict[str, Any]:
    """What the reward is made of, per agent."""
    return {
        "agent_reward": outcome.reward,
        "agent_contacts": outcome.agent_contacts,
        "solid_contacts": outcome.solid_contacts,
        "present": outcome.present,
    }


def make_single(*, render_mode: str | None = None, size: int = 480, **world: Any) -> SwarmGymEnv:
    """What `gymnasium.make` calls; `world` are the arguments of `envs.adapters.make_core`."""
    return SwarmGymEnv(make_core(**world), render_mode=render_mode, size=size)
