"""What goes on inside a SwarmNet: messages, their sums, psi, and the acceleration that comes out."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from envs.record import Array
from gnn.checkpoint import Model
from gnn.config import ModelConfig
from gnn.decode import network
from gnn.graph import EDGE_TYPES, Graph
from gnn.swarmnet import SwarmNet
from swarm_mjcf.errors import SwarmError


class NoEdgeFunctionsError(SwarmError):
    """The model is a rival of SwarmNet without typed edge functions: there is nothing to look into."""


@dataclass(frozen=True)
class Norms:
    """Norms of the components' outputs where there is a present receiver (figure 4.4). In the network's own units."""

    message: dict[str, Float[np.ndarray, " P"]]
    """phi_e of every edge that is on, by type (left)."""
    summed: Float[np.ndarray, " R"]
    """Sum of a receiver's messages of all types, before psi (middle)."""
    psi: Float[np.ndarray, " R"] | None
    """Output of psi; None for a network without one."""
    output: Float[np.ndarray, " R"]
    """Output of the network for a receiver: its acceleration, or the change of its state (right)."""


def swarmnet_config(model: Model) -> ModelConfig:
    """The configuration of a model that has edge functions. Raises NoEdgeFunctionsError for one that has none."""
    if not isinstance(model.config, ModelConfig):
        raise NoEdgeFunctionsError(
            f"a {type(model.config).__name__} has no typed edge functions to look into; take a model of preset "
            "best, thesis-ch5 or thesis-ch3"
        )
    return model.config


def messages(model: Model, history: Float[Array, "B W V 4"], graph: Graph) -> dict[str, Float[Array, "B N M F"]]:
    """Outputs of the edge functions by type, (receiver, sender); 0 where the edge is off."""
    return _inside(model, history, graph)[0]


def norms(model: Model, history: Float[Array, "B W V 4"], graph: Graph) -> Norms:
    """Norms of what the parts of the network put out."""
    typed, psi, output = _inside(model, history, graph)
    agents = graph.agent.shape[-1]
    there = np.asarray(graph.present)[:, -agents:]

    def of(vectors: Array) -> np.ndarray:
        return np.linalg.norm(np.asarray(vectors)[:, -agents:], axis=-1)[there]

    summed = jnp.sum(jnp.stack([m.sum(axis=2) for m in typed.values()]), axis=0)
    return Norms(
        message={k: np.linalg.norm(np.asarray(m), axis=-1)[np.asarray(getattr(graph, k))] for k, m in typed.items()},
        summed=of(summed),
        psi=None if psi is None else of(psi),
        output=of(output),
    )


def acceleration(model: Model, history: Float[Array, "B W V 4"], graph: Graph) -> Float[Array, "B N 2"]:
    """What the network wants of the agents [m/s^2], before any limit; of a state change, that of the velocity by dt."""
    config = swarmnet_config(model)
    out = network(config, model.scales)(model.params, jnp.asarray(history), graph)
    agents = graph.agent.shape[-1]
    return out[:, -agents:, 2:] / model.integrator.dt if config.output == "state_change" else out


def edge_kinds(model: Model) -> tuple[str, ...]:
    """Edge types that the model has functions for."""
    swarmnet_config(model)
    return tuple(kind for kind in EDGE_TYPES if kind in model.params["edge"])


def _inside(model: Model, history: Array, graph: Graph) -> tuple[dict[str, Array], Array | None, Array]:
    """Messages by type, the output of psi, and the network's."""
    net = SwarmNet(swarmnet_config(model), model.scales)
    output, state = net.apply(
        {"params": model.params},
        jnp.asarray(history),
        graph,
        capture_intermediates=lambda module, _: module.name in ("edge", "psi"),
        mutable=["intermediates"],
    )
    found: Any = state["intermediates"]
    typed: dict[str, Array] = {
        name: jnp.where(getattr(graph, name)[..., None], message, 0)
        for name, message in found["edge"]["__call__"][0].items()
    }
    psi = found["psi"]["__call__"][0] if "psi" in found else None
    return typed, psi, jnp.asarray(output)
