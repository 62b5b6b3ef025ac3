"""Limits and free flight in closed form: what physics does between contacts and what networks decode with."""

from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Float

from envs.record import Array


@runtime_checkable
class Kinematics(Protocol):
    """The numbers of a control step; `SceneSpec` has them, and so has a checkpoint."""

    @property
    def dt(self) -> float: ...
    @property
    def substeps(self) -> int: ...
    @property
    def max_speed(self) -> float: ...
    @property
    def max_acceleration(self) -> float: ...


_SQUARABLE = 1e18
"""Far below the root of float32's largest number, far above any limit."""


def clip_norm(vector: Float[Array, "*n 2"], limit: float) -> Float[Array, "*n 2"]:
    """Vectors longer than `limit` shortened to it. Differentiable everywhere, zero included."""
    if limit == float("inf"):
        return vector
    # Squares of what a repulsive force can be overflow; whatever is shorter stays bit for bit.
    largest = jnp.maximum(jnp.abs(vector[..., :1]), jnp.abs(vector[..., 1:]))
    vector = vector * jax.lax.stop_gradient(jnp.minimum(_SQUARABLE / largest, 1))
    square = jnp.sum(vector * vector, axis=-1, keepdims=True)
    long = square > limit * limit
    return vector * jnp.where(long, limit / jnp.sqrt(jnp.where(long, square, 1)), 1)


def limited(
    velocity: Float[Array, "*n 2"], acceleration: Float[Array, "*n 2"], kinematics: Kinematics
) -> Float[Array, "*n 2"]:
    """The constant acceleration [m/s^2] that is executed: clipped in norm, then so that the speed stays in its limit.

    As published: `a = clip(a, a_max)`, `v' = clip(v + a dt, v_max)`; the executed acceleration is `(v' - v) / dt`.
    """
    acceleration = clip_norm(acceleration, kinematics.max_acceleration)
    if kinematics.max_speed == float("inf"):
        return acceleration
    after = velocity + acceleration * kinematics.dt
    return acceleration + (clip_norm(after, kinematics.max_speed) - after) / kinematics.dt


def free_flight(
    position: Float[Array, "*n 2"],
    velocity: Float[Array, "*n 2"],
    acceleration: Float[Array, "*n 2"],
    kinematics: Kinematics,
) -> tuple[Float[Array, "*n 2"], Float[Array, "*n 2"]]:
    """Position and velocity after one control step of constant acceleration u, without contacts.

    `k` semi-implicit Euler substeps sum to `v' = v + u dt`, `x' = x + v dt + u dt^2 (k + 1) / (2 k)`: k = 1 is the
    published code, k -> infinity is equation 5.28 of the thesis.
    """
    dt, k = kinematics.dt, kinematics.substeps
    new_velocity = velocity + acceleration * dt
    return position + velocity * dt + acceleration * (dt * dt * (k + 1) / (2 * k)), new_velocity
