"""What PPO learns on: scenes that start, are observed and stepped. `SwarmTask` is the swarm with its reward."""

import math
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Key

from envs.config import RewardConfig
from envs.record import Array, record
from envs.reward import coefficients, reward_terms
from envs.state import State
from envs.swarm_env import SwarmEnv
from gnn.graph import Graph, graph_of_state
from swarm_mjcf.errors import SpecError

World = Any
"""State of S scenes: a tree of arrays with the scenes first."""
Observation = Any
"""What networks get of a world; a tree of arrays with the scenes first."""


@record
class Outcome:
    """What a control step brought."""

    world: World
    reward: Float[Array, "S N"]
    terminated: Bool[Array, " S"]
    truncated: Bool[Array, " S"]
    diverged: Bool[Array, " S"]
    """Scenes whose state is no longer finite."""
    measures: dict[str, Float[Array, "S N"]]
    """What is worth watching, by name; 0 for absent agents."""


@runtime_checkable
class Task(Protocol):
    """Scenes with up to N agents; all functions are pure and callable inside `jit`."""

    def start(self, keys: Key[Array, " S"]) -> tuple[World, Bool[Array, " S"]]:
        """Starting worlds, a key per scene, and whether each could be made."""
        ...

    def observe(self, world: World) -> Observation:
        """What the networks get."""
        ...

    def present(self, world: World) -> Bool[Array, "S N"]:
        """Which agents are there."""
        ...

    def step(self, world: World, action: Float[Array, "S N A"]) -> Outcome:
        """One control step."""
        ...


class SwarmTask:
    """A `SwarmEnv` with the reward of eq. 5.26-5.27, contacts by physics. Actions are accelerations [m/s^2].

    Raises:
      SpecError: the world has no finite acceleration limit, or collisions have a price and its contacts are off.
    """

    def __init__(self, env: SwarmEnv, reward: RewardConfig | None = None) -> None:
        self.env, self.reward = env, coefficients(reward, env.spec)
        if not math.isfinite(env.spec.max_acceleration):
            raise SpecError("max_acceleration", env.spec.max_acceleration, "finite: exploration is scaled by it")
        if self.reward.collision and not env.spec.contacts:
            raise SpecError(
                "contacts", False, "on, as in preset clear: physics counts the collisions that have a price "
                "(reward.collision); 0 leaves them out",
            )  # fmt: skip

    def start(self, keys: Key[Array, " S"]) -> tuple[State, Bool[Array, " S"]]:
        """See `SwarmEnv.spawn`."""
        return self.env.spawn(keys)

    def observe(self, world: State) -> tuple[Float[Array, "S V 4"], Graph]:
        """Node states and graph."""
        return graph_of_state(world, goal=self.env.spec.goal)

    def present(self, world: State) -> Bool[Array, "S N"]:
        """Which agents are there."""
        return world.agent_present

    def step(self, world: State, action: Float[Array, "S N 2"]) -> Outcome:
        """A control step with its reward; measures are the reward's terms, contact events and distance to the goal."""
        transition = self.env.step(world, action)
        after, contacts = transition.state, transition.contacts
        terms = reward_terms(after, contacts, self.reward)
        here = world.agent_present
        away = jnp.linalg.norm(after.position - after.goal[:, None], axis=-1)
        measures = {f"reward_{name}": value for name, value in vars(terms).items()}
        measures["contact_events"] = contacts.agent_events + contacts.obstacle_events + contacts.wall_events
        measures["goal_distance"] = away
        finite = jnp.isfinite(after.position).all((1, 2)) & jnp.isfinite(after.velocity).all((1, 2))
        return Outcome(
            world=after,
            reward=terms.total,
            terminated=transition.terminated,
            truncated=transition.truncated,
            diverged=~finite,
            measures=jax.tree.map(lambda x: jnp.where(here, x, 0).astype(jnp.float32), measures),
        )
