"""Scales of the data, measured once and stored with the weights, so that a network sees numbers of order one."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from envs.record import Array, record
from envs.trajectories import AGENT, Trajectories


@record
class Scales:
    """One centre and isotropic scales: rotation changes nothing, and every input stays affine in the state."""

    centre: Float[Array, "2"]
    """Mean position of the agents [m]."""
    position: Float[Array, ""]
    """Standard deviation of positions [m]."""
    velocity: Float[Array, ""]
    """Root mean square velocity component [m/s]."""
    acceleration: Float[Array, ""]
    """Root mean square acceleration component [m/s^2]."""
    position_change: Float[Array, ""]
    """Root mean square change of a position component in one step [m]."""
    velocity_change: Float[Array, ""]
    """Root mean square change of a velocity component in one step [m/s]."""

    @classmethod
    def of(cls, trajectories: Trajectories) -> "Scales":
        """Measured over present agents of the training data."""
        agents = trajectories.mask & (trajectories.kind == AGENT)[:, None]
        position, velocity = trajectories.position[agents], trajectories.velocity[agents]
        pairs = agents[:, 1:] & agents[:, :-1]
        moved = np.diff(trajectories.position, axis=1)[pairs]
        turned = np.diff(trajectories.velocity, axis=1)[pairs]

        def rms(x: np.ndarray) -> Array:
            # A constant quantity has no scale; 1 leaves it as it is.
            value = float(np.sqrt(np.mean(np.square(x, dtype=np.float64)))) if x.size else 0.0
            return jnp.asarray(value if value > 1e-9 else 1.0, jnp.float32)

        centre = position.mean(axis=0, dtype=np.float64) if len(position) else np.zeros(2)
        return cls(
            centre=jnp.asarray(centre, jnp.float32),
            position=rms(position - centre),
            velocity=rms(velocity),
            acceleration=rms(turned / trajectories.dt),
            position_change=rms(moved),
            velocity_change=rms(turned),
        )

    @classmethod
    def ones(cls) -> "Scales":
        """No scaling."""
        one = jnp.ones((), jnp.float32)
        return cls(
            centre=jnp.zeros(2, jnp.float32),
            position=one,
            velocity=one,
            acceleration=one,
            position_change=one,
            velocity_change=one,
        )
