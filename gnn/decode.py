"""From a network's output to the next state, and from that to a horizon: the integrator is the physics engine's own."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Float

from envs.dynamics import Kinematics, free_flight, limited
from envs.policy import Policy
from envs.record import Array
from envs.state import State
from gnn.config import AnyModelConfig, ModelConfig
from gnn.family import Init, Params, Predict
from gnn.features import Scales
from gnn.graph import Graph, graph_of_state
from gnn.swarmnet import SwarmNet
from swarm_mjcf.errors import SwarmError


@dataclass(frozen=True)
class Integrator:
    """The control step a model was trained for; a checkpoint stores it."""

    dt: float
    """[s]"""
    substeps: int
    """Physics steps per control step."""
    max_speed: float
    """[m/s]"""
    max_acceleration: float
    """[m/s^2]"""


def steered(
    last: Float[Array, "B V 4"],
    acceleration: Float[Array, "B n 2"],
    graph: Graph,
    kinematics: Kinematics,
    *,
    clip: bool,
) -> Float[Array, "B V 4"]:
    """Node states one control step later. Goals stand still, obstacles keep their velocity: neither is steered.

    `clip`: within the limits of acceleration and speed.
    """
    first = last.shape[1] - acceleration.shape[1]
    position, velocity = last[:, first:, :2], last[:, first:, 2:]
    if clip:
        acceleration = limited(velocity, acceleration, kinematics)
    here = graph.present[:, first:, None]
    after = jnp.concatenate(free_flight(position, velocity, jnp.where(here, acceleration, 0), kinematics), axis=-1)
    context = jnp.asarray(last[:, :first]).at[..., :2].add(last[:, :first, 2:] * kinematics.dt)
    return jnp.concatenate([context, jnp.where(here, after, last[:, first:])], axis=1)


def network(config: ModelConfig, scales: Scales) -> Callable[..., Array]:
    """`(params, history (B, W, V, 4), graph, key=None) -> (B, n, out)`, the network's raw output.

    With a key, neurons are dropped at random (`config.dropout`); without one none is.
    """
    model = SwarmNet(config, scales)

    def apply(params: Params, history: Array, graph: Graph, key: jax.Array | None = None) -> Array:
        rngs = None if key is None else {"dropout": key}
        return jnp.asarray(model.apply({"params": params}, history, graph, rngs=rngs))

    return apply


def network_init(config: ModelConfig, scales: Scales) -> Init:
    """Initial weights of the network."""

    def init(key: jax.Array, history: Array, graph: Graph) -> Params:
        return dict(SwarmNet(config, scales).init(key, history, graph)["params"])

    return init


def make_predict(config: ModelConfig, scales: Scales, integrator: Integrator) -> Predict:
    """`predict(params, history (B, W, V, 4), graph, horizon=h) -> (B, h, V, 4)`, each state fed back as input."""
    apply = network(config, scales)

    def advance(
        params: Params, history: Float[Array, "B W V 4"], graph: Graph, key: jax.Array | None
    ) -> Float[Array, "B V 4"]:
        out = apply(params, history, graph, key)
        last = history[:, -1]
        if config.output == "state_change":
            return last + out
        return steered(last, out, graph, integrator, clip=config.clip)

    def predict(
        params: Params, history: Array, graph: Graph, *, horizon: int, key: jax.Array | None = None
    ) -> Float[Array, "B h V 4"]:
        keys = jax.random.split(key, horizon) if key is not None and config.dropout else None

        def step(history: Array, key: jax.Array | None):
            after = advance(params, history, graph, key)
            return jnp.concatenate([history[:, 1:], after[:, None]], axis=1), after

        _, states = jax.lax.scan(step, history, keys, length=horizon)
        return jnp.swapaxes(states, 0, 1)

    return predict


def acting_network(config: AnyModelConfig, scales: Scales) -> Callable[..., Array]:
    """`(weights, history (B, 1, V, 4), graph) -> accelerations (B, N, 2) [m/s^2]` of a network that steers.

    Raises SwarmError for a model that sees a history or predicts state changes: it has no acceleration to execute.
    """
    if not (isinstance(config, ModelConfig) and config.acts):
        raise SwarmError(
            "a model with a history window or a state-change output (preset thesis-ch3) predicts, it does not act: "
            "physics needs an acceleration from the present state; use preset thesis-ch5 or best"
        )
    return network(config, scales)


def make_policy(config: AnyModelConfig, scales: Scales, *, goal: bool = True) -> Policy:
    """The network as a policy `(state, params, key) -> acceleration (S, N, 2) [m/s^2]` for the environment.

    Raises SwarmError for a model that does not steer (`acting_network`).
    """
    apply = acting_network(config, scales)

    def policy(state: State, params: Params, key: object = None) -> Float[Array, "S N 2"]:
        nodes, graph = graph_of_state(state, goal=goal)
        return apply(params, nodes[:, None], graph)

    return policy
