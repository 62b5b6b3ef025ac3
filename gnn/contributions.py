"""The part of the predicted acceleration due to each edge type: Shapley values over the types, exact."""

from itertools import combinations
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from envs.record import Array
from envs.trajectories import Trajectories
from gnn.checkpoint import Model
from gnn.graph import Graph
from gnn.messages import acceleration, edge_kinds
from gnn.windows import Dataset, check_rows, windows

NOTHING = "nothing"
"""The part that is left when every edge is off: what an agent does by itself."""


def contributions(model: Model, history: Float[Array, "B W V 4"], graph: Graph) -> dict[str, Float[Array, "B N 2"]]:
    """Parts [m/s^2] by edge type, and `nothing`; they add up to the acceleration with all edges, before any limit.

    Shapley (1953): the mean, over all orders in which the types can be switched on, of what switching one on adds.
    """
    kinds = edge_kinds(model)
    subsets = [subset for size in range(len(kinds) + 1) for subset in combinations(kinds, size)]
    wanted = {subset: acceleration(model, history, only_edges(graph, subset)) for subset in subsets}
    parts = {NOTHING: wanted[()]}
    for kind in kinds:
        part = jnp.zeros_like(wanted[()])
        for subset in subsets:
            if kind not in subset:
                weight = factorial(len(subset)) * factorial(len(kinds) - len(subset) - 1) / factorial(len(kinds))
                joined = tuple(k for k in kinds if k in subset or k == kind)
                part = part + weight * (wanted[joined] - wanted[subset])
        parts[kind] = part
    return parts


def only_edges(graph: Graph, kinds: tuple[str, ...]) -> Graph:
    """The graph with edges of these types alone; all nodes stay present."""
    return Graph(
        present=graph.present,
        goal=graph.goal if "goal" in kinds else jnp.zeros_like(graph.goal),
        obstacle=graph.obstacle if "obstacle" in kinds else jnp.zeros_like(graph.obstacle),
        agent=graph.agent if "agent" in kinds else jnp.zeros_like(graph.agent),
    )


def along(model: Model, trajectories: Trajectories, scene: int) -> dict[str, Float[np.ndarray, "T N 2"]]:
    """Contributions at every row of a scene from row `window - 1` on. Raises TrajectoryError for too few rows."""
    window, rows = model.config.window, trajectories.position.shape[1]
    check_rows(trajectories, window, "the model's history")
    start = jnp.arange(rows - window + 1)
    data = Dataset.of(trajectories.take([scene]))
    history, _, _, graph = windows(
        data, jnp.zeros_like(start), start, window=window, horizon=0, counts=trajectories.counts
    )
    parts = jax.jit(lambda history, graph: contributions(model, history, graph))(history, graph)
    return {kind: np.asarray(part) for kind, part in parts.items()}
