"""Trajectories on the device and windows of them: histories to predict from and the rows that follow."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from envs.record import Array, record
from envs.trajectories import Trajectories, TrajectoryError
from gnn.graph import Graph, graph_of_edges


@record
class Dataset:
    """Trajectories as two device arrays and their graphs."""

    states: Float[Array, "S T V 4"]
    """Position and velocity of every node."""
    mask: Bool[Array, "S T V"]
    edges: Int[Array, "S V V"]

    @classmethod
    def of(cls, trajectories: Trajectories) -> "Dataset":
        """The arrays that learning needs."""
        states = np.concatenate([trajectories.position, trajectories.velocity], axis=-1)
        return cls(
            states=jnp.asarray(states), mask=jnp.asarray(trajectories.mask), edges=jnp.asarray(trajectories.edges)
        )


def check_rows(trajectories: Trajectories, rows: int, why: str) -> None:
    """Raises TrajectoryError when trajectories are shorter than `rows`."""
    have = trajectories.position.shape[1]
    if have < rows:
        raise TrajectoryError(f"trajectories have {have} rows, {why} needs at least {rows}")


@partial(jax.jit, static_argnames=("window", "horizon", "counts"))
def windows(
    data: Dataset,
    scene: Int[Array, " B"],
    start: Int[Array, " B"],
    *,
    window: int,
    horizon: int,
    counts: tuple[int, int, int],
) -> tuple[Float[Array, "B W V 4"], Float[Array, "B h V 4"], Bool[Array, "B h V"], Graph]:
    """Histories of `window` rows from `start`, the `horizon` rows after them with their masks, and the graphs.

    A node belongs to a window's graph when it is there in every row of the history.
    """
    rows = start[:, None] + jnp.arange(window + horizon)
    states, mask = data.states[scene[:, None], rows], data.mask[scene[:, None], rows]
    present = mask[:, :window].all(axis=1)
    graph = graph_of_edges(data.edges[scene], present, counts)
    future = mask[:, window:] & present[:, None]
    return states[:, :window], states[:, window:], future, graph
