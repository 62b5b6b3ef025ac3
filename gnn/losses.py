"""The imitation loss: squared error of predicted states over a horizon, in units of the data's own one-step change."""

import jax.numpy as jnp
from jaxtyping import Bool, Float

from envs.record import Array
from gnn.features import Scales


def multi_step_loss(
    predicted: Float[Array, "B h V 4"], truth: Float[Array, "B h V 4"], mask: Bool[Array, "B h V"], scales: Scales
) -> Float[Array, ""]:
    """Mean over present nodes, steps and dimensions of (error / root mean square one-step change)^2.

    Positions and velocities are scaled apart, so that an error in acceleration counts although it moves a body little.
    """
    unit = jnp.stack([scales.position_change, scales.position_change, scales.velocity_change, scales.velocity_change])
    square = jnp.mean(((predicted - truth) / unit) ** 2, axis=-1)
    return jnp.sum(jnp.where(mask, square, 0)) / jnp.maximum(mask.sum(), 1)
