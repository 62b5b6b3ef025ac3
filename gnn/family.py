"""What every predictor is to training and to evaluation: initial weights, a prediction, a loss.

SwarmNet and its rivals are families of models; a preset (`gnn.config.model_preset`) is one member, as plain data, and
`gnn.registry.make_family` makes its functions.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax

from envs.record import Array
from gnn.features import Scales
from gnn.graph import Graph
from gnn.losses import multi_step_loss

Params = dict
"""Nested dict of weights; its paths name the parts."""
Init = Callable[[jax.Array, Array, Graph], Params]
"""`init(key, history (B, W, V, 4), graph) -> params`."""
Predict = Callable[..., Array]
"""`predict(params, history (B, W, V, 4), graph, horizon=h, key=None) -> (B, h, V, 4)`; with a key stochastic models
draw, without one they give their mean."""
Loss = Callable[[Params, Array, Array, Array, Graph, jax.Array], Array]
"""`loss(params, history (B, W, V, 4), truth (B, h, V, 4), mask (B, h, V), graph, key) -> scalar`."""


@dataclass(frozen=True)
class Family:
    """One model. `history` holds the last `config.window` rows of every node, the present one last."""

    init: Init
    predict: Predict
    loss: Loss


def imitation_loss(predict: Predict, scales: Scales) -> Loss:
    """The multi-step loss of a predictor: the same for everyone who has no objective of its own."""

    def loss(params: Params, history: Array, truth: Array, mask: Array, graph: Graph, key: jax.Array) -> Array:
        predicted = predict(params, history, graph, horizon=truth.shape[1], key=key)
        return multi_step_loss(predicted, truth, mask, scales)

    return loss
