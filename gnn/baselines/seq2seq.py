"""Seq2Seq (Sutskever et al. 2014) on the joint state: an LSTM reads the window, another continues it.

The decoder starts from the encoder's memory and the present state, and its own output is its next input. The paper has
four layers of 1000 cells for whole languages; two of 256 are chosen here. It also reverses its input, to bring the
beginnings of two sentences together; in a trajectory the last rows matter most, and they come last.
Goals and obstacles are unknown to it and keep their velocity. Weights: `encoder`, `decoder`, `readout`.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float

from envs.record import Array
from gnn.baselines.config import Seq2SeqConfig
from gnn.baselines.joint import apart, check_size, joint, zeros
from gnn.baselines.rollout import closed_loop, scaled
from gnn.decode import Integrator
from gnn.family import Family, Params, imitation_loss
from gnn.features import Scales
from gnn.graph import Graph

Memory = tuple[tuple[Array, Array], ...]
"""(cell, output) of every layer."""


class StackedLSTM(nn.Module):
    """Layers of LSTM cells, each reading the one before."""

    hidden: int
    layers: int

    @nn.compact
    def __call__(self, memory: Memory, x: Float[Array, "B n"]) -> tuple[Memory, Float[Array, "B H"]]:
        after = []
        for depth, state in enumerate(memory):
            state, x = nn.OptimizedLSTMCell(self.hidden, name=f"layer{depth}")(state, x)
            after.append(state)
        return tuple(after), x


class Seq2Seq(nn.Module):
    """`encode` and `decode` one row each; `__call__` is both, for initial weights."""

    hidden: int
    layers: int
    outputs: int

    def setup(self) -> None:
        self.encoder = StackedLSTM(self.hidden, self.layers)
        self.decoder = StackedLSTM(self.hidden, self.layers)
        self.readout = nn.Dense(self.outputs)

    def encode(self, memory: Memory, x: Float[Array, "B n"]) -> Memory:
        """The memory after one more row."""
        return self.encoder(memory, x)[0]

    def decode(self, memory: Memory, x: Float[Array, "B n"]) -> tuple[Memory, Float[Array, "B n"]]:
        """The memory after, and the changes of the joint state."""
        memory, recalled = self.decoder(memory, x)
        return memory, self.readout(recalled)

    def __call__(self, memory: Memory, x: Float[Array, "B n"]) -> tuple[Memory, Float[Array, "B n"]]:
        return self.decode(self.encode(memory, x), x)


def make_seq2seq(config: Seq2SeqConfig, scales: Scales, integrator: Integrator) -> Family:
    """Seq2Seq. Its prediction raises SwarmSizeError for another number of agents than it was initialised for."""

    def model(graph: Graph) -> Seq2Seq:
        return Seq2Seq(config.hidden, config.layers, graph.counts[2] * 4)

    def nothing(batch: int) -> Memory:
        return (zeros(batch, config.hidden),) * config.layers

    def init(key: jax.Array, history: Array, graph: Graph) -> Params:
        x = joint(scaled(history[:, -1], graph.present, scales), graph)
        return dict(model(graph).init(key, nothing(len(x)), x)["params"])

    def predict(
        params: Params, history: Array, graph: Graph, *, horizon: int, key: jax.Array | None = None
    ) -> Float[Array, "B h V 4"]:
        check_size(params["readout"]["bias"], graph)
        network = model(graph)

        def run(method: str, memory: Memory, x: Array) -> Any:
            return network.apply({"params": params}, memory, x, method=method)

        rows = joint(scaled(history, graph.present, scales), graph)
        memory, _ = jax.lax.scan(lambda m, x: (run("encode", m, x), None), nothing(len(rows)), jnp.swapaxes(rows, 0, 1))

        def advance(memory: Memory, states: Array):
            memory, change = run("decode", memory, joint(states, graph))
            return memory, apart(change)

        return closed_loop(
            advance, memory, history[:, -1], graph, horizon=horizon, scales=scales, integrator=integrator
        )

    return Family(init, predict, imitation_loss(predict, scales))
