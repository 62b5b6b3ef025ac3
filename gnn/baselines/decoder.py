"""Kipf's decoder (eq. 10-12 of Kipf et al. 2018): a message MLP per edge type, their sum, a node MLP -> state change.

On a known graph it is table 3.2's ablation: "decoder" (agents alone, one edge type), "+ context" (goals and obstacles
send messages of their own types), "+ Conv1D" (SwarmNet's convolutions over the window before it). No psi, no
acceleration. As in the paper messages end in a ReLU and no layer is normalised. Weights: `conv`, `decoder/edge/TYPE`,
`decoder/node`.
"""

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float

from envs.record import Array
from gnn.baselines.config import DecoderConfig
from gnn.baselines.rollout import closed_loop, scaled
from gnn.decode import Integrator
from gnn.family import Family, Params, imitation_loss
from gnn.features import Scales
from gnn.graph import Graph
from gnn.swarmnet import MLP, Convolutions


class Messages(nn.Module):
    """f_e, one for each edge type, on [receiver, sender]; their sum over senders and types, weighted by `edges`."""

    hidden: int

    @nn.compact
    def __call__(
        self, receivers: Float[Array, "B N F"], senders: dict[str, Array], edges: dict[str, Array]
    ) -> Float[Array, "B N H"]:
        total = jnp.zeros((*receivers.shape[:2], self.hidden))
        for name, sources in senders.items():
            messages = MLP((self.hidden, self.hidden), 0, name=name)(receivers[:, :, None], sources[:, None])
            total += jnp.einsum("bnm,bnmh->bnh", edges[name], messages)
        return total


class Decoder(nn.Module):
    """Node features and weighted edges -> changes of the agents' states, in one-step changes of the data."""

    hidden: int

    @nn.compact
    def __call__(
        self, receivers: Float[Array, "B N F"], senders: dict[str, Array], edges: dict[str, Array]
    ) -> Float[Array, "B N 4"]:
        """`senders` (B, M, F) and `edges` (B, N, M), floats, by edge type."""
        aggregate = Messages(self.hidden, name="edge")(receivers, senders, edges)
        hidden = (self.hidden, self.hidden)
        return MLP(hidden, 4, name="node")(jnp.concatenate([receivers, aggregate], axis=-1))


class KnownGraph(nn.Module):
    """The decoder on the graph that the data come with."""

    filters: Sequence[int]
    hidden: int
    context: bool

    @nn.compact
    def __call__(self, window: Float[Array, "B W V 4"], graph: Graph) -> Float[Array, "B N 4"]:
        goals, obstacles, _ = graph.counts
        first = goals + obstacles
        nodes = window[:, -1]
        if self.filters:
            nodes = Convolutions(self.filters, name="conv")(jnp.swapaxes(window, 1, 2))
        senders, edges = {"agent": nodes[:, first:]}, {"agent": graph.agent}
        if self.context:
            senders |= {"goal": nodes[:, :goals], "obstacle": nodes[:, goals:first]}
            edges |= {"goal": graph.goal, "obstacle": graph.obstacle}
        senders = {name: nodes for name, nodes in senders.items() if nodes.shape[1]}
        weights = {name: edges[name].astype(nodes.dtype) for name in senders}
        return Decoder(self.hidden, name="decoder")(nodes[:, first:], senders, weights)


def make_decoder(config: DecoderConfig, scales: Scales, integrator: Integrator) -> Family:
    """Kipf's decoder on the known graph, trained by the loss of everyone."""
    model = KnownGraph(config.convolutions, config.hidden, config.context)

    def init(key: jax.Array, history: Array, graph: Graph) -> Params:
        return dict(model.init(key, scaled(history, graph.present, scales), graph)["params"])

    def predict(
        params: Params, history: Array, graph: Graph, *, horizon: int, key: jax.Array | None = None
    ) -> Float[Array, "B h V 4"]:
        def step(past: Array, states: Array):
            window = jnp.concatenate([past, states[:, None]], axis=1)
            return window[:, 1:], jnp.asarray(model.apply({"params": params}, window, graph))

        past = scaled(history[:, :-1], graph.present, scales)
        return closed_loop(step, past, history[:, -1], graph, horizon=horizon, scales=scales, integrator=integrator)

    return Family(init, predict, imitation_loss(predict, scales))
