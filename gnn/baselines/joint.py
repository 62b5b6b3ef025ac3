"""The joint state: all agents side by side, one slot each. Such a model is of use at its own size alone."""

import jax.numpy as jnp
from jaxtyping import Float

from envs.record import Array
from gnn.graph import Graph
from swarm_mjcf.errors import SwarmError


class SwarmSizeError(SwarmError):
    """A model of the joint state was given another number of agents than it was made for.

    Attributes: `given` and `made_for`, numbers of agents, ghosts included.
    """

    def __init__(self, given: int, made_for: int) -> None:
        super().__init__(
            f"{given} agents were given to a model of the joint state of {made_for}: lstm and seq2seq have an input "
            f"for every agent and fit no other size. Train one on data of {given} agents, or take a graph network"
        )
        self.given, self.made_for = given, made_for


def joint(states: Float[Array, "B *W V 4"], graph: Graph) -> Float[Array, "B *W J"]:
    """The agents' scaled states (absent ones are 0 in their slot) as one vector."""
    count = graph.counts[2]
    agents = states[..., states.shape[-2] - count :, :]
    return agents.reshape(*agents.shape[:-2], count * 4)


def apart(changes: Float[Array, "B J"]) -> Float[Array, "B N 4"]:
    """One vector as the agents' changes."""
    return changes.reshape(changes.shape[0], -1, 4)


def check_size(bias: Float[Array, " J"], graph: Graph) -> None:
    """Raises SwarmSizeError unless the last layer, whose bias this is, answers for the graph's agents."""
    made_for = bias.shape[0] // 4
    if graph.counts[2] != made_for:
        raise SwarmSizeError(graph.counts[2], made_for)


def zeros(batch: int, hidden: int) -> tuple[Array, Array]:
    """The empty memory (cell, output) of an LSTM."""
    return jnp.zeros((batch, hidden)), jnp.zeros((batch, hidden))
