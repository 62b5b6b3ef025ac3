"""The goal term that Boids and Helbing share."""

import jax.numpy as jnp
from jaxtyping import Float

from envs.record import Array
from envs.state import State


def goal_seeking(state: State, *, cruise_speed: float | int, slowdown_distance: float | int) -> Float[Array, "S N 2"]:
    """Wanted minus own velocity [m/s]; wanted is toward the goal at `cruise_speed min(1, D / slowdown_distance)`."""
    toward = state.goal[:, None] - state.position
    distance = jnp.sqrt(jnp.sum(toward * toward, axis=-1, keepdims=True))
    wanted = cruise_speed * jnp.minimum(1, distance / slowdown_distance)
    return wanted * toward / jnp.maximum(distance, 1e-12) - state.velocity
