"""The ReLU SwarmNet as repair sees it: one agent's decision as a function of its own situation, in any precision.

Runs on NumPy arrays in float64, which is how repairs are verified, and on JAX arrays, which is how they are linearised.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from envs.record import Array, record
from envs.state import State
from gnn.checkpoint import Model
from gnn.config import ModelConfig
from gnn.family import Params
from gnn.features import Scales
from gnn.graph import EDGE_TYPES, Graph, graph_of_state
from repair.errors import NotEncodable


@record
class Situations:
    """R agents that decide, each in a situation of its own. Node states are positions [m] and velocities [m/s]."""

    own: Float[Array, "R 4"]
    senders: dict[str, Float[Array, "R _ 4"]]
    """What acts on the agent, by edge type: `goal`, `obstacle`, `agent`."""
    present: dict[str, Bool[Array, "R _"]]
    """Which of these places are filled."""

    def __len__(self) -> int:
        return len(self.own)

    def take(self, rows: Any) -> "Situations":
        """Some of the rows: an index, a slice or a mask."""
        return jax.tree.map(lambda x: x[rows], self)


def situations_of(nodes: Float[Array, "B V 4"], graph: Graph) -> Situations:
    """Every agent of B graphs, agent i of graph b in row b * N + i; absent ones too, with nothing around them."""
    goals, obstacles, agents = graph.counts
    nodes = np.asarray(nodes, np.float64)
    parts = dict(zip(EDGE_TYPES, np.split(nodes, [goals, goals + obstacles], axis=1), strict=True))
    masks = {"goal": graph.goal, "obstacle": graph.obstacle, "agent": graph.agent}
    return Situations(
        own=parts["agent"].reshape(-1, 4),
        senders={name: np.repeat(part, agents, axis=0) for name, part in parts.items()},
        present={name: np.asarray(mask).reshape(len(nodes) * agents, -1) for name, mask in masks.items()},
    )


def situations_of_state(state: State, *, goal: bool = True) -> Situations:
    """Every agent of S scenes, agent i of scene s in row s * N + i."""
    return situations_of(*graph_of_state(state, goal=goal))


def concatenate(parts: list[Situations]) -> Situations:
    """Rows of several, which have the same places."""
    return jax.tree.map(lambda *xs: np.concatenate(xs), *parts)


def fitted(situations: Situations, like: Situations) -> Situations:
    """The same situations with as many places for senders as `like` has: empty ones are added.

    Raises NotEncodable where there are more filled places than that.
    """
    senders, present = {}, {}
    for name, places in like.senders.items():
        room = places.shape[1]
        of, here = situations.senders.get(name), situations.present.get(name)
        senders[name] = np.zeros((len(situations), room, 4))
        present[name] = np.zeros((len(situations), room), bool)
        if of is None or here is None:
            continue
        if np.asarray(here)[:, room:].any():
            raise NotEncodable(f"situations with more than {room} places of type {name} do not fit these scenes")
        kept = min(room, of.shape[1])
        senders[name][:, :kept], present[name][:, :kept] = of[:, :kept], here[:, :kept]
    return Situations(own=np.asarray(situations.own, np.float64), senders=senders, present=present)


def check_encodable(model: Model) -> ModelConfig:
    """The configuration of a network that repair understands.

    Raises NotEncodable, naming the preset, for one whose inputs are not linear in the state (a turned frame), which
    joins messages by anything but a sum, or which does not act from the present state.
    """
    config, preset = model.config, model.about.get("preset")
    reasons = []
    if not isinstance(config, ModelConfig) or not config.acts:
        reasons.append("it gives no acceleration from the present state")
    else:
        reasons += ["its inputs are not linear in the state (frame)"] * config.frame
        reasons += ["it joins messages by " + ", ".join(config.aggregate)] * (config.aggregate != ("sum",))
        reasons += ["it sees only the nearest"] * (config.nearest is not None)
        reasons += ["it has a psi or linear paths beside its layers"] * (config.psi or config.skip)
        reasons += ["its edge functions have no biases"] * (not config.edge_bias)
        reasons += ["it sees no goals and obstacles (context)"] * (not config.context)
    if reasons:
        raise NotEncodable(f"preset {preset} cannot be repaired: {'; '.join(reasons)}. Use preset thesis-ch5")
    assert isinstance(config, ModelConfig)
    return config


def actions(params: Params, scales: Scales, situations: Situations, *, normalise: bool = True) -> Float[Array, "R 2"]:
    """The network's accelerations [m/s^2] (eq. 5.22-5.25), before the limits; 0 is not put in for anyone.

    In the arithmetic of `situations`: float64 NumPy arrays give float64 from the very float32 weights.
    """
    _, embedding = messages_and_embedding(params, scales, situations, normalise=normalise)
    out = linear(params["readout"]["layer0"], embedding)
    return out * float(scales.acceleration) if normalise else out


def messages_and_embedding(
    params: Params, scales: Scales, situations: Situations, *, normalise: bool = True
) -> tuple[Float[Array, "R F"], Float[Array, "R H"]]:
    """The sum of an agent's messages (eq. 5.23) and the node embedding h (eq. 5.24)."""
    own = scaled(situations.own, scales, normalise)
    xp = own.__array_namespace__()
    total: Any = 0.0
    for name, senders in situations.senders.items():
        if not senders.shape[1] or name not in params["edge"]:
            continue
        of = scaled(senders, scales, normalise)
        pair = xp.concatenate([xp.broadcast_to(own[:, None], of.shape), of], axis=-1)
        message = mlp(params["edge"][name], pair)
        total = total + xp.sum(xp.where(situations.present[name][..., None], message, 0), axis=1)
    node = xp.concatenate([own, total], axis=-1)
    for layer in layers(params["node"]):
        node = xp.maximum(linear(layer, node), 0)
    return total, node


def scaled(nodes: Float[Array, "*n 4"], scales: Scales, normalise: bool) -> Float[Array, "*n 4"]:
    """Node states as the network's inputs."""
    if not normalise:
        return nodes
    xp = nodes.__array_namespace__()
    centre, position, velocity = (np.asarray(x, np.float64) for x in (scales.centre, scales.position, scales.velocity))
    shift = xp.asarray(np.concatenate([centre, [0, 0]]), dtype=nodes.dtype)
    size = xp.asarray(np.array([position, position, velocity, velocity]), dtype=nodes.dtype)
    return (nodes - shift) / size


def layers(part: Params) -> list[Params]:
    """Layers of an MLP in their order."""
    return [part[f"layer{i}"] for i in range(len(part))]


def linear(layer: Params, x: Float[Array, "*n I"]) -> Float[Array, "*n O"]:
    """One affine layer, in the arithmetic of its input."""
    xp = x.__array_namespace__()
    return x @ xp.asarray(layer["kernel"], dtype=x.dtype) + xp.asarray(layer["bias"], dtype=x.dtype)


def mlp(part: Params, x: Float[Array, "*n I"]) -> Float[Array, "*n O"]:
    """ReLU between layers, the last one linear."""
    xp = x.__array_namespace__()
    *hidden, last = layers(part)
    for layer in hidden:
        x = xp.maximum(linear(layer, x), 0)
    return linear(last, x)
