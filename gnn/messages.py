"""What goes on inside a SwarmNet: its messages, and the acceleration that comes out."""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
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
    # Of all pairs, also where the network itself hears of the nearest alone: the weights are the same.
    _, state = SwarmNet(replace(swarmnet_config(model), nearest=None), model.scales).apply(
        {"params": model.params},
        jnp.asarray(history),
        graph,
        capture_intermediates=lambda module, _: module.name == "edge",
        mutable=["intermediates"],
    )
    found: Any = state["intermediates"]
    return {
        name: jnp.where(getattr(graph, name)[..., None], message, 0)
        for name, message in found["edge"]["__call__"][0].items()
    }


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
