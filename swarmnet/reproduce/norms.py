"""How long the vectors inside a SwarmNet are (figure 4.4): messages, messages joined, and the network's output."""

import jax
import numpy as np
from jaxtyping import Float

from envs.trajectories import Trajectories
from gnn.checkpoint import Model
from gnn.decode import network
from gnn.messages import messages, swarmnet_config
from gnn.windows import Dataset, windows

PARTS = ("message", "joined", "output")
"""Outputs of the edge functions, one per edge; messages joined and the readout, one of each per agent."""


def norms(model: Model, trajectories: Trajectories, *, count: int = 200, seed: int = 0) -> dict[str, np.ndarray]:
    """Euclidean norms of the vectors of `PARTS` at `count` random windows of the trajectories; of each, all agents.

    Messages of all senders are summed, as the thesis does, or averaged by a network that joins them by `mean` alone (or
    their maximum, by `max` alone). The output is a change of the state with preset thesis-ch3 (eq. 3.3), else an
    acceleration [m/s^2].

    Raises NoEdgeFunctionsError for a model that is no SwarmNet.
    """
    config = swarmnet_config(model)
    rng = np.random.default_rng(seed)
    scene = rng.integers(0, len(trajectories), count)
    start = rng.integers(0, trajectories.position.shape[1] - config.window, count)
    history, _, _, graph = windows(
        Dataset.of(trajectories), scene, start, window=config.window, horizon=1, counts=trajectories.counts
    )
    by_type = jax.jit(lambda history, graph: messages(model, history, graph))(history, graph)
    out = jax.jit(network(config, model.scales))(model.params, history, graph)
    message = np.concatenate([np.asarray(found, np.float64) for found in by_type.values()], axis=2)
    edge = np.concatenate([np.asarray(getattr(graph, name)) for name in by_type], axis=2)
    how = config.aggregate[0] if len(config.aggregate) == 1 else "sum"
    join = {"mean": np.nanmean, "max": np.nanmax}.get(how, np.nansum)
    agents = edge.any(axis=2)  # who hears nothing has nothing to join
    alone = np.where(edge[..., None], message, np.nan)[agents]
    return {
        "message": _length(message[edge]),
        "joined": _length(join(alone, axis=1)),
        "output": _length(np.asarray(out, np.float64)[:, -graph.counts[2] :][agents]),
    }


def _length(vectors: Float[np.ndarray, "n F"]) -> Float[np.ndarray, " n"]:
    return np.linalg.norm(vectors, axis=-1)
