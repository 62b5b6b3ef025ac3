"""Joint LSTM, the baseline of Kipf et al. 2018: 2-layer MLP, LSTM, 2-layer MLP on the states of all agents at once.

The window is its burn-in, then its predictions are fed back. The hidden state is 256 wide in all; the paper's code has
256 per agent in two layers, which at five agents is 26 million weights and gets nowhere in minutes on a CPU.
Goals and obstacles are unknown to it and keep their velocity. Weights: `encoder`, `lstm`, `decoder`.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float

from envs.record import Array
from gnn.baselines.config import LSTMConfig
from gnn.baselines.joint import apart, check_size, joint, zeros
from gnn.baselines.rollout import closed_loop, scaled
from gnn.decode import Integrator
from gnn.family import Family, Params, imitation_loss
from gnn.features import Scales
from gnn.graph import Graph
from gnn.swarmnet import MLP


class JointLSTM(nn.Module):
    """One step: `(memory, joint state (B, N * 4)) -> (memory, changes (B, N * 4))`."""

    hidden: int

    @nn.compact
    def __call__(
        self, memory: tuple[Array, Array], x: Float[Array, "B n"]
    ) -> tuple[tuple[Array, Array], Float[Array, "B n"]]:
        seen = MLP((self.hidden, self.hidden), 0, name="encoder")(x)
        memory, recalled = nn.OptimizedLSTMCell(self.hidden, name="lstm")(memory, seen)
        return memory, MLP((self.hidden,), x.shape[-1], name="decoder")(recalled)


def make_lstm(config: LSTMConfig, scales: Scales, integrator: Integrator) -> Family:
    """The joint LSTM. Its prediction raises SwarmSizeError for another number of agents than it was initialised for."""
    model = JointLSTM(config.hidden)

    def init(key: jax.Array, history: Array, graph: Graph) -> Params:
        x = joint(scaled(history[:, -1], graph.present, scales), graph)
        return dict(model.init(key, zeros(len(x), config.hidden), x)["params"])

    def predict(
        params: Params, history: Array, graph: Graph, *, horizon: int, key: jax.Array | None = None
    ) -> Float[Array, "B h V 4"]:
        check_size(params["decoder"]["layer1"]["bias"], graph)

        def step(memory: tuple[Array, Array], x: Array) -> Any:
            return model.apply({"params": params}, memory, x)

        past = joint(scaled(history[:, :-1], graph.present, scales), graph)
        memory = zeros(len(history), config.hidden)
        memory, _ = jax.lax.scan(lambda m, x: (step(m, x)[0], None), memory, jnp.swapaxes(past, 0, 1))

        def advance(memory: tuple[Array, Array], states: Array):
            memory, change = step(memory, joint(states, graph))
            return memory, apart(change)

        return closed_loop(
            advance, memory, history[:, -1], graph, horizon=horizon, scales=scales, integrator=integrator
        )

    return Family(init, predict, imitation_loss(predict, scales))
