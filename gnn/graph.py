"""The graph of a swarm: node states in the order goals, obstacles, agents, and typed, masked edges into the agents."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from envs.record import Array, record
from envs.state import State
from envs.trajectories import AGENT_EDGE, GOAL_EDGE, OBSTACLE_EDGE

EDGE_TYPES = {"goal": GOAL_EDGE, "obstacle": OBSTACLE_EDGE, "agent": AGENT_EDGE}
"""Edge functions by name, with the type in `Trajectories.edges`; in the order of the sender nodes."""


@record
class Graph:
    """Who sends to whom, by type. Ghosts (padding) neither send nor receive.

    Receivers are the first N of the M agents: all of them in a scene, one in the view of a single agent (`views`).
    """

    present: Bool[Array, "B V"]
    goal: Bool[Array, "B N G"]
    """Edges goal -> agent, (receiver, sender)."""
    obstacle: Bool[Array, "B N K"]
    agent: Bool[Array, "B N M"]

    @property
    def counts(self) -> tuple[int, int, int]:
        """Numbers of goals, obstacles and agents."""
        return self.goal.shape[-1], self.obstacle.shape[-1], self.agent.shape[-1]


def graph_of_edges(edges: Int[Array, "B V V"], present: Bool[Array, "B V"], counts: tuple[int, int, int]) -> Graph:
    """The graph of `Trajectories.edges` (source, target), without the edges of absent nodes."""
    goals, obstacles, _ = counts
    first = goals + obstacles
    alive = jnp.asarray(edges) * (present[:, :, None] & present[:, None])
    into_agents = jnp.swapaxes(alive[:, :, first:], 1, 2)  # (B, N, V)
    return Graph(
        present=present,
        goal=into_agents[:, :, :goals] == GOAL_EDGE,
        obstacle=into_agents[:, :, goals:first] == OBSTACLE_EDGE,
        agent=into_agents[:, :, first:] == AGENT_EDGE,
    )


def graph_of_state(state: State, *, goal: bool) -> tuple[Float[Array, "S V 4"], Graph]:
    """Node states and graph of an environment's state: every agent receives from everything present but itself.

    Of other agents, a chaser receives from its targets alone.
    """
    scenes, agents, _ = state.position.shape
    here = state.agent_present
    goals = jnp.ones((scenes, int(goal)), bool)
    obstacles = jnp.concatenate([state.obstacle, state.obstacle_velocity], axis=-1)
    steered = jnp.concatenate([state.position, state.velocity], axis=-1)
    parts = [jnp.where(state.obstacle_present[..., None], obstacles, 0), jnp.where(here[..., None], steered, 0)]
    if goal:
        parts.insert(0, jnp.concatenate([state.goal, jnp.zeros_like(state.goal)], axis=-1)[:, None])
    nodes = jnp.concatenate(parts, axis=1)
    others = ~np.eye(agents, dtype=bool)
    if state.target.shape[2]:
        others = others & (state.target[..., None] == jnp.arange(agents)).any(axis=2)
    graph = Graph(
        present=jnp.concatenate([goals, state.obstacle_present, here], axis=1),
        goal=here[:, :, None] & goals[:, None],
        obstacle=here[:, :, None] & state.obstacle_present[:, None],
        agent=here[:, :, None] & here[:, None] & others,
    )
    return nodes, graph


def views(nodes: Float[Array, "S V 4"], graph: Graph) -> tuple[Float[Array, "SN V 4"], Graph]:
    """What each agent sees, as a graph of its own with one receiver: agent i of scene s at s * N + i.

    The receiver comes first among the agents. Where only some agents count, a network on their views computes nothing
    for the others.
    """
    agents = graph.counts[2]
    first = nodes.shape[1] - agents
    order = np.array([[i, *(j for j in range(agents) if j != i)] for i in range(agents)])

    def flat(x: Array) -> Array:
        return x.reshape(-1, *x.shape[2:])

    def rolled(x: Array) -> Array:
        """Statics as they are, then the agents in each one's order; (S, V, ...) -> (S * N, V, ...)."""
        statics = jnp.broadcast_to(x[:, None, :first], (len(x), agents, first, *x.shape[2:]))
        return flat(jnp.concatenate([statics, x[:, first:][:, order]], axis=2))

    each = Graph(
        present=rolled(graph.present),
        goal=flat(graph.goal)[:, None],
        obstacle=flat(graph.obstacle)[:, None],
        agent=flat(jnp.take_along_axis(graph.agent, order[None], axis=2))[:, None],
    )
    return rolled(nodes), each


def first_receives(graph: Graph) -> Graph:
    """The same graph with edges into its first agent alone."""
    return replace(graph, goal=graph.goal[:, :1], obstacle=graph.obstacle[:, :1], agent=graph.agent[:, :1])
