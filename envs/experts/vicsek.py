"""Vicsek et al. (1995): constant speed, heading = mean heading of the neighbours and oneself, plus noise.

The thesis's counter-example to summed interactions (chapter 4, 4.1): what an agent does follows from the average of its
neighbours by design.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Float, Key

from envs.experts.config import VicsekConfig
from envs.experts.pairs import Pairs, sum_over
from envs.policy import Policy
from envs.record import Array
from envs.state import State
from swarm_mjcf.errors import SpecError


def vicsek(config: VicsekConfig) -> Policy:
    """The expert `(state, params, key) -> acceleration`: the change to the new velocity, divided by dt.

    It uses one key per scene. Raises SpecError when there is noise but no key.
    """

    def policy(state: State, params: object = None, key: Key[Array, " S"] | None = None) -> Float[Array, "S N 2"]:
        heading = mean_heading(state, config)
        if config.noise:
            if key is None:
                raise SpecError("key", None, "one key per scene, because the Vicsek expert is noisy")
            heading = _turned(heading, _angles(key, state, config.noise))
        acceleration = (config.speed * heading - state.velocity) / config.dt
        return jnp.where(state.agent_present[..., None], acceleration, 0)

    return policy


def mean_heading(state: State, config: VicsekConfig) -> Float[Array, "S N 2"]:
    """Unit vector of the summed headings of those seen and oneself; own heading where they cancel out.

    An agent at rest has no heading and adds none; alone, it heads along x.
    """
    own, moving = _unit(state.velocity)
    own = jnp.where(moving, own, 0)

    heading, exists = _unit(_summed(state, own, config))
    along_x = jnp.asarray([1, 0], own.dtype)
    return jnp.where(exists, heading, jnp.where(moving, own, along_x))


def _summed(state: State, own: Array, config: VicsekConfig) -> Array:
    """Sum of the headings of those seen and of one's own (S, N, 2)."""
    present = state.agent_present
    if config.interaction.full:
        return jnp.broadcast_to(jnp.where(present[..., None], own, 0).sum(axis=1, keepdims=True), own.shape)

    def law(pairs: Pairs) -> dict[str, Array]:
        return {"x": pairs.total(pairs.du), "y": pairs.total(pairs.dw), "count": pairs.total(1)}

    sums = sum_over(config.interaction, law, position=state.position, velocity=own, present=present)
    # Pairs hold differences of headings: adding own heading once per neighbour, and once for oneself, makes the sum.
    return jnp.stack([sums["x"], sums["y"]], axis=-1) + (sums["count"] + 1)[..., None] * own


def _unit(vector: Array) -> tuple[Array, Array]:
    """Unit vectors, and where they exist. Sums of headings that cancel out leave rounding errors of about 1e-7."""
    length = jnp.sqrt(jnp.sum(vector * vector, axis=-1, keepdims=True))
    return vector / jnp.maximum(length, 1e-6), length > 1e-6


def _angles(key: Array, state: State, width: float | int) -> Float[Array, "S N"]:
    """Noise on the headings [rad]; that of an agent depends on its scene's key and its number alone."""
    agents, dtype = state.position.shape[1], state.position.dtype
    uniform = jax.vmap(lambda k: jax.random.uniform(k, (agents,), dtype, minval=-0.5, maxval=0.5))
    return width * uniform(key)


def _turned(vector: Array, angle: Array) -> Array:
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
