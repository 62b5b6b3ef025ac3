"""Noise on what a policy perceives and on what it does, as wrappers for any expert or policy (thesis, section 3.2.4).

A wrapper splits the scene's key and hands the policy a key of its own, so noise is never correlated with the policy's
draws. The noise of a scene depends on its key alone, and that of an agent not on how many agents come after it.
"""

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Float, Key

from envs.policy import Policy
from envs.record import Array
from envs.state import State
from swarm_mjcf.errors import SpecError


@dataclass(frozen=True, kw_only=True)
class PerceptionNoise:
    """Standard deviations of normal noise on every dimension of every node's state; the thesis's N(0, 1) by default."""

    position: float = 1.0
    """Of x and y of agents, goal and obstacles, each by itself [m], in the world's frame."""
    velocity: float = 1.0
    """Of both components of the velocities of agents and obstacles, each by itself [m/s]."""

    def __post_init__(self) -> None:
        _check(self, position="m", velocity="m/s")


@dataclass(frozen=True, kw_only=True)
class ActuationNoise:
    """What is done instead of an acceleration a: nothing with probability `dropout`, else a plus normal noise."""

    std: float = 0.0
    """Standard deviation of what is added to both components, in the world's frame [m/s^2]."""
    relative: float = 0.0
    """The same in units of |a| [1]."""
    dropout: float = 0.0
    """Probability that an agent's command is lost and it coasts for a control step [1]."""

    def __post_init__(self) -> None:
        _check(self, std="m/s^2", relative="1", dropout="1")
        if self.dropout > 1:
            raise SpecError("dropout", self.dropout, "from 0 to 1")


def with_perception_noise(policy: Policy, config: PerceptionNoise) -> Policy:
    """The policy sees a noisy state, drawn anew at every control step; physics goes on from the true one.

    As in the thesis, where noise is added to the network's input, there is one draw for each node: all agents see the
    same displaced neighbour, and themselves displaced too. Absent bodies stay where they are parked.
    """
    if not (config.position or config.velocity):
        return policy

    def noisy(state: State, params: object, key: Key[Array, " S"]) -> Float[Array, "S N 2"]:
        key, own = _split(key)
        k_position, k_velocity, k_goal, k_obstacle, k_drift = (_fold(own, number) for number in range(5))
        agents, obstacles = state.agent_present[..., None], state.obstacle_present[..., None]
        seen = replace(
            state,
            position=state.position + config.position * jnp.where(agents, _normal(k_position, state.position), 0),
            velocity=state.velocity + config.velocity * jnp.where(agents, _normal(k_velocity, state.velocity), 0),
            goal=state.goal + config.position * _normal(k_goal, state.goal),
            obstacle=state.obstacle + config.position * jnp.where(obstacles, _normal(k_obstacle, state.obstacle), 0),
            obstacle_velocity=state.obstacle_velocity
            + config.velocity * jnp.where(obstacles, _normal(k_drift, state.obstacle_velocity), 0),
        )
        return policy(seen, params, key)

    return noisy


def with_actuation_noise(policy: Policy, config: ActuationNoise) -> Policy:
    """The policy's accelerations are done badly; the scene's limits are clips that come after it.

    The thesis drops neurons of its network at test time for this; here it is the command that suffers, so that the
    wrapper fits any policy.
    """
    if not (config.std or config.relative or config.dropout):
        return policy

    def noisy(state: State, params: object, key: Key[Array, " S"]) -> Float[Array, "S N 2"]:
        key, own = _split(key)
        wanted = policy(state, params, key)
        size = jnp.sqrt(jnp.sum(wanted * wanted, axis=-1, keepdims=True))
        done = wanted + config.std * _normal(_fold(own, 0), wanted)
        done = done + config.relative * size * _normal(_fold(own, 1), wanted)
        lost = jax.vmap(lambda k: jax.random.bernoulli(k, config.dropout, wanted.shape[1:2]))(_fold(own, 2))
        return jnp.where(state.agent_present[..., None] & ~lost[..., None], done, 0)

    return noisy


def _split(keys: Key[Array, " S"]) -> tuple[Key[Array, " S"], Key[Array, " S"]]:
    """Each scene's key as one for the policy and one for the noise."""
    both = jax.vmap(jax.random.split)(keys)
    return both[:, 0], both[:, 1]


def _fold(keys: Key[Array, " S"], number: int) -> Key[Array, " S"]:
    return jax.vmap(lambda key: jax.random.fold_in(key, number))(keys)


def _normal(keys: Key[Array, " S"], like: Array) -> Array:
    """Standard normal numbers in the shape of `like`, each scene's from its own key."""
    return jax.vmap(lambda key: jax.random.normal(key, like.shape[1:], like.dtype))(keys)


def _check(config: PerceptionNoise | ActuationNoise, **units: str) -> None:
    for field, unit in units.items():
        if not 0 <= getattr(config, field) < math.inf:
            raise SpecError(field, getattr(config, field), f"a finite number of at least 0 [{unit}]")
