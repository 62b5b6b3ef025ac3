"""Neural relational inference (Kipf et al. 2018): edge types inferred from a window, then decoded by message passing.

The paper's settings: factorised MLP encoder (v->e, e->v, v->e; ELU, Xavier, biases 0.1), width 256, two latent types,
Gumbel-softmax at 0.5, a fixed output variance, uniform prior, predictions fed back for the whole horizon. What differs:
- Layer-norm for batch-norm: it needs no running averages, and ghosts and company in a batch stay without influence.
- The encoder sees the ten rows before the prediction, not the predicted rows themselves, so it never sees the future.
  Its edge types hold for the whole prediction.
- Positions and velocities are scaled by the data's statistics instead of their extremes.
- It knows agents alone, all connected to all; goals and obstacles keep their velocity.
Weights: `encoder/node0`, `encoder/edge0`, `encoder/node1`, `encoder/edge1`, `encoder/logits`, `decoder/edge/typeK`,
`decoder/node`.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from envs.record import Array
from gnn.baselines.config import KipfConfig
from gnn.baselines.decoder import Decoder
from gnn.baselines.rollout import closed_loop, scaled
from gnn.decode import Integrator
from gnn.family import Family, Params
from gnn.features import Scales
from gnn.graph import Graph
from gnn.losses import multi_step_loss

STATE_DIMENSIONS = 4


class Block(nn.Module):
    """Two ELU layers and a normalisation of the features, on parts that are broadcast against each other.

    The first layer of [a, b, ...] is the sum of a layer on each part, so pairs of nodes need not be built.
    """

    hidden: int

    @nn.compact
    def __call__(self, *parts: Float[Array, "..."]) -> Float[Array, "..."]:
        widths = np.cumsum([part.shape[-1] for part in parts])
        kernel = self.param("kernel", nn.initializers.xavier_normal(), (int(widths[-1]), self.hidden))
        bias = self.param("bias", nn.initializers.constant(0.1), (self.hidden,))
        rows = jnp.split(kernel, widths[:-1])
        x = nn.elu(sum(part @ weights for part, weights in zip(parts, rows, strict=True)) + bias)
        return nn.LayerNorm(name="norm")(nn.elu(_dense(self.hidden, "layer1")(x)))


class Encoder(nn.Module):
    """Agents' windows -> logits of the latent type of every (receiver, sender)."""

    hidden: int
    edge_types: int

    @nn.compact
    def __call__(self, agents: Float[Array, "B W N 4"], pairs: Bool[Array, "B N N"]) -> Float[Array, "B N N K"]:
        rows = jnp.swapaxes(agents, 1, 2)
        nodes = Block(self.hidden, name="node0")(rows.reshape(*rows.shape[:2], -1))
        edges = Block(self.hidden, name="edge0")(nodes[:, :, None], nodes[:, None])
        # As in the paper's code, incoming edges are summed and divided by the number of nodes.
        company = 1 + pairs.sum(axis=-1, keepdims=True)
        incoming = jnp.sum(jnp.where(pairs[..., None], edges, 0), axis=2) / company
        nodes = Block(self.hidden, name="node1")(incoming)
        edges = Block(self.hidden, name="edge1")(nodes[:, :, None], nodes[:, None], edges)
        return _dense(self.edge_types, "logits")(edges)


def all_pairs(graph: Graph) -> Bool[Array, "B N N"]:
    """Every present agent with every other (receiver, sender)."""
    count = graph.counts[2]
    here = graph.present[:, graph.present.shape[1] - count :]
    return here[:, :, None] & here[:, None] & ~np.eye(count, dtype=bool)


def gumbel_softmax(logits: Float[Array, "*edges K"], key: jax.Array, temperature: float) -> Float[Array, "*edges K"]:
    """Soft samples of the types: each sums to 1, and the largest entry is type k with probability softmax(logits)_k."""
    return jax.nn.softmax((logits + jax.random.gumbel(key, logits.shape)) / temperature)


def divergence_from_uniform(logits: Float[Array, "*edges K"]) -> Float[Array, "*edges"]:
    """KL(softmax(logits) || uniform) [nats] of each edge."""
    log = jax.nn.log_softmax(logits)
    return jnp.sum(jnp.exp(log) * log, axis=-1) + float(np.log(logits.shape[-1]))


def make_kipf(config: KipfConfig, scales: Scales, integrator: Integrator) -> Family:
    """NRI. Without a key edges are weighted by their probabilities, with one by a soft sample."""
    encoder, decoder = Encoder(config.hidden, config.edge_types), Decoder(config.hidden)
    types = range(int(config.skip_first), config.edge_types)

    def agents_of(states: Array, graph: Graph) -> Array:
        return states[..., states.shape[-2] - graph.counts[2] :, :]

    def logits_of(params: Params, history: Array, graph: Graph) -> Float[Array, "B N N K"]:
        agents = agents_of(scaled(history, graph.present, scales), graph)
        return jnp.asarray(encoder.apply({"params": params["encoder"]}, agents, all_pairs(graph)))

    def decoded(params: dict, agents: Float[Array, "B N 4"], edges: Float[Array, "B N N K"]) -> Array:
        senders = {f"type{k}": agents for k in types}
        weights = {f"type{k}": edges[..., k] for k in types}
        return jnp.asarray(decoder.apply({"params": params}, agents, senders, weights))

    def roll(params: Params, history: Array, graph: Graph, logits: Array, horizon: int, key: jax.Array | None) -> Array:
        edges = jax.nn.softmax(logits) if key is None else gumbel_softmax(logits, key, config.temperature)
        edges = jnp.where(all_pairs(graph)[..., None], edges, 0)

        def step(nothing: None, states: Array):
            return nothing, decoded(params["decoder"], agents_of(states, graph), edges)

        return closed_loop(step, None, history[:, -1], graph, horizon=horizon, scales=scales, integrator=integrator)

    def init(key: jax.Array, history: Array, graph: Graph) -> Params:
        of_encoder, of_decoder = jax.random.split(key)
        agents = agents_of(scaled(history, graph.present, scales), graph)
        last = agents[:, -1]
        senders = {f"type{k}": last for k in types}
        weights = dict.fromkeys(senders, jnp.zeros((*last.shape[:2], last.shape[1])))
        return {
            "encoder": dict(encoder.init(of_encoder, agents, all_pairs(graph))["params"]),
            "decoder": dict(decoder.init(of_decoder, last, senders, weights)["params"]),
        }

    def predict(
        params: Params, history: Array, graph: Graph, *, horizon: int, key: jax.Array | None = None
    ) -> Float[Array, "B h V 4"]:
        return roll(params, history, graph, logits_of(params, history, graph), horizon, key)

    def loss(params: Params, history: Array, truth: Array, mask: Array, graph: Graph, key: jax.Array) -> Array:
        """The negative ELBO per node times `2 variance / (4 h)`: the loss of everyone plus the weighted divergence.

        Errors are measured in one-step changes of the data, so the loss is of order one whatever the variance.
        """
        horizon = truth.shape[1]
        logits = logits_of(params, history, graph)
        predicted = roll(params, history, graph, logits, horizon, key)
        divergence = jnp.sum(jnp.where(all_pairs(graph), divergence_from_uniform(logits), 0))
        per_node = divergence / jnp.maximum(graph.present.sum(), 1)
        weight = 2 * config.variance / (STATE_DIMENSIONS * horizon)
        return multi_step_loss(predicted, truth, mask, scales) + weight * per_node

    return Family(init, predict, loss)


def _dense(width: int, name: str) -> nn.Dense:
    return nn.Dense(
        width,
        kernel_init=nn.initializers.xavier_normal(),
        bias_init=nn.initializers.constant(0.1),
        name=name,
    )
