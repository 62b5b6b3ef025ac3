"""Many scenes as a `gymnasium.vector.VectorEnv`: one compiled call steps them all and resets those that ended."""

from typing import Any

import jax
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from envs.adapters.core import Episodes, Outcome, Stepper, SwarmCore, make_core
from envs.adapters.gym_single import check_mode, infos, render_metadata
from envs.adapters.gym_spaces import scene_spaces
from envs.adapters.scene import mean_reward
from envs.config import SEEDS
from envs.state import State
from swarm_mjcf.errors import SpecError, SwarmError


class SwarmVectorEnv(VectorEnv):
    """S scenes at once: observations (S, N, D), actions (S, N, 2) in [-1, 1], rewards (S,) as of `SwarmGymEnv`.

    `reset(seed=s)` starts the global scenes 0..S-1 of seed s; each slot i goes on with i + S, i + 2 S, .... A later
    `reset()` starts the next ones in all slots; `options={"scenes": numbers}` chooses. NEXT_STEP (Gymnasium's default)
    resets a scene in the call after its end, whose action is ignored and whose reward is 0; SAME_STEP resets at once
    and hands out `final_obs` and `final_info`.

    Raises:
      SpecError: another render or autoreset mode, malformed actions or options. SpawnError: no room for a scene.
    """

    def __init__(
        self,
        core: SwarmCore,
        num_envs: int,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        size: int = 480,
    ) -> None:
        if num_envs < 1:
            raise SpecError("num_envs", num_envs, "at least 1")
        self.core, self.num_envs, self._size = core, num_envs, size
        mode, self._step = _autoreset(core, autoreset_mode)
        self.metadata = {**render_metadata(core), "autoreset_mode": mode}
        self.render_mode = check_mode(render_mode)
        self.single_observation_space, self.single_action_space = scene_spaces(core)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._episodes: Episodes | None = None
        self._seed: int | None = None

    @property
    def state(self) -> State:
        """The state of all scenes now: what a project policy looks at."""
        return self._under_way().state

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """First observations of all scenes."""
        super().reset(seed=seed)
        scenes = np.arange(self.num_envs)
        series = self._seed
        if seed is not None or series is None:
            series = int(self.np_random.integers(SEEDS)) if seed is None else int(seed)
        elif self._episodes is not None:
            scenes = np.asarray(self._episodes.scene).astype(np.int64) + self.num_envs
        self._episodes, outcome = self.core.start(series, self._chosen(options, scenes))  # refuses what cannot be
        self._seed = series
        outcome = _own(outcome)
        return np.asarray(outcome.observation), _masked(infos(outcome), np.ones(self.num_envs, bool))

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step of all scenes."""
        checked = self.core.action(actions, (self.num_envs, self.core.spec.num_agents, 2))
        self._episodes, outcome = self._step(self._under_way(), checked)
        self.core.check(outcome)
        outcome = _own(outcome)
        terminated, truncated = np.asarray(outcome.terminated), np.asarray(outcome.truncated)
        info, over = infos(outcome), terminated | truncated
        if self._step is self.core.step_then_reset:
            info = _final(info, np.asarray(outcome.final_observation), over)
            info["present"] = np.array(self.state.agent_present)
        else:
            info = _masked(info, np.ones(self.num_envs, bool))
        return (
            np.asarray(outcome.observation),
            mean_reward(outcome.reward, outcome.present),
            terminated,
            truncated,
            info,
        )

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Every scene from above, each uint8 (size, size, 3)."""
        if self.render_mode is None:
            return None
        from envs.adapters.picture import picture

        state = jax.device_get(self.state)
        return tuple(picture(self.core.spec, state, i, size=self._size) for i in range(self.num_envs))

    def _under_way(self) -> Episodes:
        if self._episodes is None:
            raise SwarmError("step() was called before reset(): call reset() first")
        return self._episodes

    def _chosen(self, options: dict[str, Any] | None, scenes: np.ndarray) -> np.ndarray:
        options = options or {}
        if set(options) - {"scenes"}:
            raise SpecError("options", sorted(options), "scenes: which scenes of the seed to play")
        if options.get("scenes") is None:
            return scenes
        chosen = np.asarray(options["scenes"])
        if chosen.shape != (self.num_envs,) or chosen.dtype.kind not in "iu":
            raise SpecError("scenes", options["scenes"], f"{self.num_envs} whole numbers")
        return chosen


def _autoreset(core: SwarmCore, mode: AutoresetMode | str) -> tuple[AutoresetMode, Stepper]:
    steppers = {AutoresetMode.NEXT_STEP: core.reset_or_step, AutoresetMode.SAME_STEP: core.step_then_reset}
    for known, stepper in steppers.items():
        if mode in (known, known.value):
            return known, stepper
    raise SpecError("autoreset_mode", mode, "one of " + ", ".join(known.value for known in steppers))


def _own(outcome: Outcome) -> Outcome:
    """NumPy arrays that the caller may change and keep; JAX's are read-only."""
    return jax.tree.map(np.array, outcome)


def _masked(info: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Gymnasium's form: beside each key the scenes that have it."""
    return info | {f"_{key}": mask.copy() for key in info}


def _final(info: dict[str, Any], seen: np.ndarray, over: np.ndarray) -> dict[str, Any]:
    """Infos of scenes that go on; those of scenes that ended are `final_info`, with `final_obs` beside."""
    ended = np.flatnonzero(over)
    if not len(ended):
        return _masked(info, np.ones(len(over), bool))
    last = np.full(len(over), None, dtype=object)
    for i in ended:
        last[i] = seen[i]

    def of(scenes: np.ndarray) -> dict[str, Any]:
        return {key: np.where(scenes.reshape(-1, *[1] * (x.ndim - 1)), x, 0) for key, x in info.items()}

    return _masked(of(~over), np.ones(len(over), bool)) | {
        "final_obs": last,
        "_final_obs": over.copy(),
        "final_info": _masked(of(over), over),
        "_final_info": over.copy(),
    }


def make_vector(
    num_envs: int = 1,
    *,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    render_mode: str | None = None,
    size: int = 480,
    **world: Any,
) -> SwarmVectorEnv:
    """What `gymnasium.make_vec` calls; `world` are the arguments of `envs.adapters.make_core`."""
    core = make_core(**world)
    return SwarmVectorEnv(core, num_envs, autoreset_mode=autoreset_mode, render_mode=render_mode, size=size)
