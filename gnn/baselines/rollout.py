"""What all rivals share: scaled inputs, and a closed loop that adds predicted changes to the agents' states."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from envs.record import Array
from gnn.decode import Integrator
from gnn.features import Scales
from gnn.graph import Graph

Step = Callable[[Any, Array], tuple[Any, Array]]
"""`(memory, scaled states (B, V, 4)) -> (memory, changes of the agents' states (B, N, 4) in one-step changes)`."""


def scaled(states: Float[Array, "B *W V 4"], present: Bool[Array, "B V"], scales: Scales) -> Float[Array, "B *W V 4"]:
    """States as numbers of order one: positions centred and scaled, velocities scaled, absent nodes 0."""
    position = (states[..., :2] - scales.centre) / scales.position
    out = jnp.concatenate([position, states[..., 2:] / scales.velocity], axis=-1)
    here = present.reshape(present.shape[0], *(1,) * (states.ndim - 3), present.shape[1], 1)
    return jnp.where(here, out, 0)


def closed_loop(
    step: Step,
    memory: Any,
    last: Float[Array, "B V 4"],
    graph: Graph,
    *,
    horizon: int,
    scales: Scales,
    integrator: Integrator,
) -> Float[Array, "B h V 4"]:
    """`horizon` steps from the present states, each prediction fed back. Absent nodes stay as they are.

    Goals and obstacles are not predicted: they keep their velocity, as in SwarmNet's decoder.
    """
    first = last.shape[1] - graph.counts[2]
    unit = jnp.stack([scales.position_change, scales.position_change, scales.velocity_change, scales.velocity_change])

    def one(carry: tuple[Any, Array], _: None):
        memory, states = carry
        memory, change = step(memory, scaled(states, graph.present, scales))
        context = jnp.asarray(states[:, :first]).at[..., :2].add(states[:, :first, 2:] * integrator.dt)
        after = jnp.concatenate([context, states[:, first:] + change * unit], axis=1)
        after = jnp.where(graph.present[..., None], after, states)
        return (memory, after), after

    _, predicted = jax.lax.scan(one, (memory, jnp.asarray(last)), None, length=horizon)
    return jnp.swapaxes(predicted, 0, 1)
