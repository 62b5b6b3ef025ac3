"""Actor and critic on one network: a Gaussian around the imitated action, and a value for every agent."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from envs.record import Array
from gnn.checkpoint import Model
from gnn.config import ModelConfig
from gnn.family import Params
from gnn.graph import Graph, views
from gnn.swarmnet import MLP, SwarmNet
from swarm_mjcf.errors import SwarmError

VALUE, STD = "value", "log_std"
"""Names of the value's readout and of the exploration among the weights."""


@dataclass(frozen=True)
class ActorCritic:
    """What PPO needs of a policy. Weights are a nested dict: `log_std` (A,) and `value` beside the network's own."""

    init: Callable[[jax.Array, Any], Params]
    """`(key, observation) -> weights`."""
    apply: Callable[[Params, Any], tuple[Array, Array]]
    """`(weights, observation) -> (mean actions (S, N, A), values (S, N))`."""
    views: Callable[[Any], Any]
    """Observation of S scenes with N agents -> S * N observations with one, agent i of scene s at s * N + i: `apply`
    gives of these what it gives of the scenes."""
    unit: float
    """Size of an action: of the limit that actions are clipped to, say."""


def swarm_actor_critic(model: Model, *, gamma: float, initial_std: float, scratch: bool = False) -> ActorCritic:
    """SwarmNet with a second readout nu on the node embedding h (section 5.5), started from `model`'s weights.

    The mean of the actions is the network's own output [m/s^2]; goals and obstacles act in the graph and get none.
    Values are in units of 1 / (1 - gamma), the number of steps that count. `scratch`: random weights in place of the
    model's. Raises SwarmError for a model whose output is no acceleration from the present state.
    """
    config = model.config
    if not (isinstance(config, ModelConfig) and config.acts) or config.additive:
        raise SwarmError(
            f"preset {model.about.get('preset')} cannot be improved by PPO: it takes a network that steers from the "
            "present state and has a node embedding; use preset thesis-ch5 or best"
        )
    network, limit = SwarmNet(config, model.scales), model.integrator.max_acceleration
    readout = MLP((64, 64), 1)
    span = 1 / (1 - min(gamma, 0.999))

    def both(params: Params, nodes: Float[Array, "S V 4"], graph: Graph) -> tuple[Array, Array]:
        mean, kept = network.apply(
            {"params": {name: part for name, part in params.items() if name not in (VALUE, STD)}},
            nodes[:, None],
            graph,
            capture_intermediates=lambda module, _: module.name == "node",
            mutable=["intermediates"],
        )
        seen: Any = kept["intermediates"]
        return jnp.asarray(mean), seen["node"]["__call__"][0]

    def init(key: jax.Array, observation: tuple[Array, Graph]) -> Params:
        nodes, graph = observation
        own = network.init(key, nodes[:, None], graph)["params"] if scratch else model.params
        params = jax.tree.map(jnp.asarray, dict(own))
        _, embedding = both(params, nodes, graph)
        value = readout.init(jax.random.fold_in(key, 1), embedding)["params"]
        return params | {VALUE: value, STD: jnp.full(2, jnp.log(initial_std * limit), jnp.float32)}

    def apply(params: Params, observation: tuple[Array, Graph]) -> tuple[Array, Array]:
        mean, embedding = both(params, *observation)
        value = readout.apply({"params": params[VALUE]}, embedding)
        return mean, span * jnp.asarray(value)[..., 0]

    return ActorCritic(init, apply, lambda observation: views(*observation), limit)


def network_weights(params: Params) -> Params:
    """Without the value's readout and the exploration: what steers a swarm."""
    return {name: part for name, part in params.items() if name not in (VALUE, STD)}


def log_probability(
    mean: Float[Array, "*n A"], log_std: Float[Array, " A"], action: Float[Array, "*n A"]
) -> Float[Array, "*n"]:
    """Logarithm of the Gaussian density of an agent's action."""
    z = (action - mean) * jnp.exp(-log_std)
    return jnp.sum(-0.5 * z * z - log_std - 0.5 * jnp.log(2 * jnp.pi), axis=-1)


def entropy(log_std: Float[Array, " A"]) -> Float[Array, ""]:
    """Of an agent's action."""
    return jnp.sum(log_std + 0.5 * jnp.log(2 * jnp.pi * jnp.e))
