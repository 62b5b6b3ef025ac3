"""What all adapters share: SwarmEnv with observation and reward, each call one compiled function, resets included."""

import functools
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Key, UInt

from envs.adapters.observation import Observation, nearest
from envs.config import SEEDS, RewardConfig, make_world, mixed
from envs.dynamics import clip_norm
from envs.policy import Policy
from envs.record import Array, record
from envs.reward import Collisions, by_contacts, coefficients, reward
from envs.spawn import too_dense
from envs.state import Contacts, State, no_contacts
from envs.swarm_env import SwarmEnv
from swarm_mjcf.errors import SpecError


@record
class Outcome:
    """What a reset or a step hands to a user; after a reset all but the observation is 0."""

    observation: Float[Array, "S N D"]
    reward: Float[Array, "S N"]
    """Of each agent."""
    terminated: Bool[Array, " S"]
    truncated: Bool[Array, " S"]
    agent_contacts: Int[Array, "S N"]
    """Number of the step's substep states at which the agent touched other agents."""
    solid_contacts: Int[Array, "S N"]
    """The same, obstacles and walls."""
    present: Bool[Array, "S N"]
    """Which agents earned the reward."""
    final_observation: Float[Array, "S N D"]
    """At the end of the step, before any reset."""
    no_room: Int[Array, ""]
    """Scenes that were to start in this call and found no room."""


@record
class Episodes:
    """S scenes under way. Slot i runs the global scenes i, i + S, i + 2 S, ... of its seed."""

    state: State
    key: Key[Array, ""]
    """Of the seed."""
    scene: UInt[Array, " S"]
    """Global number of the scene in each slot, as in `envs.swarm_env.scene_keys`."""
    ended: Bool[Array, " S"]
    """Scenes that the last step ended and that were not reset within it."""


Stepper = Callable[[Episodes, Array], tuple[Episodes, Outcome]]


class SwarmCore:
    """A SwarmEnv, what its agents see and what they earn. Adapters keep `Episodes` and translate.

    Actions are in [-1, 1]: accelerations in units of the scene's `max_acceleration`, each agent's clipped in norm.

    Args:
      env: the environment; its horizon truncates, and contacts terminate when it says so.
      observation: default `nearest(env.spec)`. reward: coefficients, default as published (no goal term without goal).
      collisions: what counts as a collision in the reward.

    Raises:
      SpecError: the scene has no finite acceleration limit to scale actions by.
    """

    def __init__(
        self,
        env: SwarmEnv,
        *,
        observation: Observation | None = None,
        reward: RewardConfig | None = None,
        collisions: Collisions = by_contacts,
    ) -> None:
        if not np.isfinite(env.spec.max_acceleration):
            raise SpecError("max_acceleration", env.spec.max_acceleration, "finite: actions are scaled by it")
        self.env, self.spec = env, env.spec
        self.observation = nearest(env.spec) if observation is None else observation
        self.reward = coefficients(reward, env.spec)
        self._collisions = collisions
        self._start = jax.jit(self._started)
        self.step: Stepper = jax.jit(self._step)
        """One control step; scenes that ended stay ended and go on moving: the caller resets."""
        self.step_then_reset: Stepper = jax.jit(self._same_step)
        """Scenes that end are reset within the step: Gymnasium's SAME_STEP."""
        self.reset_or_step: Stepper = jax.jit(self._next_step)
        """Scenes that ended with the step before are reset instead of stepped: Gymnasium's NEXT_STEP."""
        self.judged = jax.jit(self._judged)
        """`(state, contacts) -> (observation, reward)`."""

    def start(self, seed: int, scenes: Int[np.ndarray, " S"]) -> tuple[Episodes, Outcome]:
        """Scenes of a seed by their global numbers, at their start.

        Raises:
          SpecError: the seed or a number is not in 0..2^32 - 1.
          SpawnError: a scene has no room.
        """
        for field, given in (("seed", seed), ("scene", int(scenes.min())), ("scene", int(scenes.max()))):
            if not 0 <= given < SEEDS:
                raise SpecError(field, given, f"a whole number in 0..{SEEDS - 1}")
        episodes, outcome = self._start(jax.random.key(seed), jnp.asarray(scenes, jnp.uint32))
        self.check(outcome)
        return episodes, outcome

    def check(self, outcome: Outcome) -> None:
        """Raises SpawnError when a scene found no room."""
        failed = int(outcome.no_room)
        if failed:
            raise too_dense(self.spec, self.env.spawn_config, failed, len(outcome.reward))

    def action(self, given: Any, shape: tuple[int, ...]) -> Float[np.ndarray, "*shape"]:
        """The action as float32; raises SpecError when it has another shape or is not finite."""
        array = np.asarray(given, np.float32)
        if array.shape != shape:
            raise SpecError("action", array.shape, f"an array of shape {shape}")
        if not np.isfinite(array).all():
            raise SpecError("action", array[~np.isfinite(array)][0].item(), "finite numbers in [-1, 1]")
        return array

    def acting(self, policy: Policy, params: object = None) -> Callable[..., Array]:
        """A project policy (expert, network) as `(state, key) -> action (S, N, 2)`; `key` is for policies that draw."""
        limit = self.spec.max_acceleration

        @jax.jit
        def act(params: object, state: State, key: Array) -> Array:
            keys = jax.random.split(key, len(state.step))
            return clip_norm(policy(state, params, keys), float(limit)) / limit

        still = jax.random.key(0)
        return lambda state, key=still: act(params, state, key)

    def _judged(self, state: State, contacts: Contacts) -> tuple[Array, Array]:
        earned = reward(state, contacts, self.reward, collisions=self._collisions)
        return self.observation.observe(state), earned

    def _spawned(self, key: Array, scene: Array) -> tuple[State, Array]:
        return self.env.spawn(jax.vmap(partial(jax.random.fold_in, key))(scene))

    def _started(self, key: Array, scene: Array) -> tuple[Episodes, Outcome]:
        state, ok = self._spawned(key, scene)
        count = len(scene)
        seen, no = self.observation.observe(state), jnp.zeros(count, bool)
        nothing = no_contacts(count, self.spec.num_agents)
        outcome = Outcome(
            observation=seen,
            reward=jnp.zeros((count, self.spec.num_agents), jnp.float32),
            terminated=no,
            truncated=no,
            agent_contacts=nothing.agent_states,
            solid_contacts=nothing.obstacle_states,
            present=state.agent_present,
            final_observation=seen,
            no_room=jnp.sum(~ok),
        )
        return Episodes(state=state, key=key, scene=scene, ended=no), outcome

    def _step(self, episodes: Episodes, action: Float[Array, "S N 2"]) -> tuple[Episodes, Outcome]:
        transition = self.env.step(episodes.state, action * self.spec.max_acceleration)
        seen, earned = self._judged(transition.state, transition.contacts)
        contacts = transition.contacts
        outcome = Outcome(
            observation=seen,
            reward=earned,
            terminated=transition.terminated,
            truncated=transition.truncated,
            agent_contacts=contacts.agent_states,
            solid_contacts=contacts.obstacle_states + contacts.wall_states,
            present=transition.state.agent_present,
            final_observation=seen,
            no_room=jnp.zeros((), jnp.int32),
        )
        return replace(episodes, state=transition.state, ended=transition.terminated | transition.truncated), outcome

    def _restarted(self, episodes: Episodes, outcome: Outcome, over: Bool[Array, " S"]) -> tuple[Episodes, Outcome]:
        """Scenes that are `over` replaced by the next of their slot."""
        scene = jnp.where(over, episodes.scene + len(over), episodes.scene).astype(episodes.scene.dtype)

        def again(_: None) -> tuple[State, Array, Array]:
            fresh, ok = self._spawned(episodes.key, scene)
            state = jax.tree.map(partial(_where, over), fresh, episodes.state)
            return state, _where(over, self.observation.observe(fresh), outcome.observation), jnp.sum(over & ~ok)

        def go_on(_: None) -> tuple[State, Array, Array]:
            return episodes.state, outcome.observation, jnp.zeros((), jnp.int32)

        # Spawning costs as much as a step without contacts: only when a scene is over.
        state, seen, no_room = jax.lax.cond(over.any(), again, go_on, None)
        return replace(episodes, state=state, scene=scene, ended=episodes.ended & ~over), replace(
            outcome, observation=seen, no_room=no_room
        )

    def _same_step(self, episodes: Episodes, action: Float[Array, "S N 2"]) -> tuple[Episodes, Outcome]:
        episodes, outcome = self._step(episodes, action)
        return self._restarted(episodes, outcome, episodes.ended)

    def _next_step(self, episodes: Episodes, action: Float[Array, "S N 2"]) -> tuple[Episodes, Outcome]:
        over = episodes.ended
        episodes, outcome = self._step(episodes, action)
        episodes, outcome = self._restarted(episodes, outcome, over)
        quiet = {
            name: _where(over, jnp.zeros_like(getattr(outcome, name)), getattr(outcome, name))
            for name in ("reward", "terminated", "truncated", "agent_contacts", "solid_contacts")
        }
        return episodes, replace(outcome, present=episodes.state.agent_present, **quiet)


def _where(over: Array, new: Array, old: Array) -> Array:
    """`new` for scenes that are over, on the leading axis."""
    return jnp.where(over.reshape(-1, *[1] * (new.ndim - 1)), new, old)


@functools.lru_cache(maxsize=16)
def make_core(
    preset: str = "clear",
    *,
    num_agents: int = 5,
    num_obstacles: int | None = None,
    mixed_counts: bool = False,
    horizon: int = 60,
    terminate_on_contact: bool = True,
    engine: str = "auto",
    observation: Observation | None = None,
    reward: RewardConfig | None = None,
) -> SwarmCore:
    """A core by plain values, as `gymnasium.make` passes them; 60 steps and the end at any contact as published.

    `num_obstacles` is the preset's own by default. `mixed_counts` draws 1..num_agents agents and 0..num_obstacles
    obstacles for each scene. The same values give the same core, which holds constants only: many environments of one
    kind compile once.
    """
    world = make_world(preset, num_agents=num_agents, num_obstacles=num_obstacles)
    world = mixed(world) if mixed_counts else world
    env = SwarmEnv(
        world.scene,
        engine=engine,
        spawn=world.spawn,
        horizon=horizon,
        terminate_on_contact=terminate_on_contact,
    )
    return SwarmCore(env, observation=observation, reward=reward)
