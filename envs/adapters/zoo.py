"""One scene as a PettingZoo `ParallelEnv`: every agent sees, acts and earns for itself."""

from typing import Any

import gymnasium
import numpy as np
from pettingzoo import ParallelEnv

from envs.adapters.core import Outcome, SwarmCore
from envs.adapters.gym_single import check_mode, render_metadata
from envs.adapters.gym_spaces import agent_spaces
from envs.adapters.scene import OneScene, scene_option
from envs.state import State
from swarm_mjcf.errors import SpecError

Dicts = dict[str, Any]


class SwarmParallelEnv(ParallelEnv):
    """Agents `agent_0`, ..., all that are in the scene; a scene ends for all of them at once.

    Observation (D,) as `core.observation.labels` say, action (2,) in [-1, 1] times `max_acceleration` [m/s^2], reward
    the agent's own. Infos: `agent_contacts`, `solid_contacts`: substep states in contact. `state()` is the observation
    of all agents, flat. Seeds and `options={"scene": 7}` are as of `SwarmGymEnv`; other options are passed over.

    Raises:
      SpecError: another render mode, an action missing, malformed, or of an agent that is not there.
    """

    def __init__(self, core: SwarmCore, *, render_mode: str | None = None, size: int = 480) -> None:
        self.metadata = {**render_metadata(core), "name": "swarm_v0", "is_parallelizable": True}
        self.render_mode = check_mode(render_mode)
        self.core, self._scene, self._size = core, OneScene(core), size
        self.possible_agents = [f"agent_{i}" for i in range(core.spec.num_agents)]
        self.agents = []
        # One space object per agent: each draws its own random actions.
        spaces = {agent: agent_spaces(core) for agent in self.possible_agents}
        self.observation_spaces = {agent: seen for agent, (seen, _) in spaces.items()}
        self.action_spaces = {agent: action for agent, (_, action) in spaces.items()}
        low, high = (np.tile(bound, core.spec.num_agents) for bound in (core.observation.low, core.observation.high))
        self.state_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        self._rng = np.random.default_rng()
        self._seen = np.zeros(len(low), np.float32)

    @property
    def swarm_state(self) -> State:
        """The project's state now, a batch of one: what a project policy looks at."""
        return self._scene.state

    def observation_space(self, agent: str) -> gymnasium.Space:
        """The observation space of one agent, always the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.Space:
        """The action space of one agent, always the same object."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: Dicts | None = None) -> tuple[Dicts, Dicts]:
        """First observations and infos by agent."""
        outcome = self._scene.reset(seed, rng=self._rng, scene=scene_option(options, strict=False))
        here = np.flatnonzero(self._scene.state.agent_present[0])
        self.agents = [self.possible_agents[i] for i in here]
        return self._by_agent(outcome.observation), self._infos(outcome)

    def step(self, actions: Dicts) -> tuple[Dicts, Dicts, Dicts, Dicts, Dicts]:
        """One control step: observations, rewards, terminations, truncations and infos by agent."""
        if set(actions) != set(self.agents):
            raise SpecError("actions", sorted(actions), f"one for each agent in the scene: {self.agents}")
        if not self.agents:
            return {}, {}, {}, {}, {}
        together = np.zeros((len(self.possible_agents), 2), np.float32)
        for agent, action in actions.items():
            together[self._number(agent)] = self.core.action(action, (2,))
        outcome = self._scene.step(together)
        terminated, truncated = bool(outcome.terminated), bool(outcome.truncated)
        earned = {agent: float(outcome.reward[self._number(agent)]) for agent in self.agents}
        result = (
            self._by_agent(outcome.observation),
            earned,
            dict.fromkeys(self.agents, terminated),
            dict.fromkeys(self.agents, truncated),
            self._infos(outcome),
        )
        if terminated or truncated:
            self.agents = []
        return result

    def render(self) -> np.ndarray | None:
        """The scene from above, uint8 (size, size, 3)."""
        return None if self.render_mode is None else self._scene.picture(self._size)

    def state(self) -> np.ndarray:
        """What all agents see, one vector; the rows of absent agents are 0."""
        return self._seen.copy()

    def _number(self, agent: str) -> int:
        return int(agent.removeprefix("agent_"))

    def _by_agent(self, seen: Any) -> Dicts:
        self._seen = seen.reshape(-1)
        return {agent: seen[self._number(agent)].copy() for agent in self.agents}

    def _infos(self, outcome: Outcome) -> Dicts:
        return {
            agent: {
                "agent_contacts": int(outcome.agent_contacts[self._number(agent)]),
                "solid_contacts": int(outcome.solid_contacts[self._number(agent)]),
            }
            for agent in self.agents
        }
