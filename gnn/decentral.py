"""Decentralised execution: every agent runs its own copy of the network on what it perceives, and on nothing else."""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Float

from envs.experts.config import Interaction
from envs.neighbours import neighbours
from envs.policy import Policy
from envs.record import Array
from envs.state import State, make_state
from gnn.config import AnyModelConfig
from gnn.decode import acting_network
from gnn.family import Params
from gnn.features import Scales
from gnn.graph import first_receives, graph_of_state


def make_decentralised(
    config: AnyModelConfig,
    scales: Scales,
    *,
    goal: bool = True,
    nearest: int | None = None,
    radius: float | None = None,
) -> Policy:
    """The network as a policy `(state, params, key) -> acceleration (S, N, 2) [m/s^2]`, one pass for each agent.

    The weights are those of the centralised policy (`gnn.decode.make_policy`), and so are the actions where everybody
    perceives everybody (thesis, section 5.5). An agent perceives what `perceived` says; absent agents get 0.

    Args:
      goal: whether the agents have a goal, which they then know wherever they are.
      nearest: an agent perceives only this many other agents, the nearest.
      radius: an agent perceives only other agents and obstacles closer than this, centre to centre [m].

    Raises:
      SpecError: `nearest` or `radius` is no limit.
      SwarmError: the model sees a history or predicts state changes: it has no acceleration to execute.
    """
    sight = Interaction(nearest=nearest, radius=radius)
    apply = acting_network(config, scales)

    def policy(state: State, params: Params, key: object = None) -> Float[Array, "S N 2"]:
        nodes, graph = graph_of_state(perceived(state, sight), goal=goal)
        return apply(params, nodes[:, None], first_receives(graph)).reshape(state.position.shape)

    return policy


def perceived(state: State, sight: Interaction) -> State:
    """What each agent perceives, as a scene of its own: S * N scenes of 1 + M agents, agent i of scene s at s * N + i.

    The agent itself comes first, then the other present agents that it sees: the `nearest` of them, those closer than
    `radius` [m], or both (M = `nearest`, at most N - 1; M = N without it), a chaser only its targets among these. Goal
    and step are known, obstacles are seen within `radius`. All else is absent and 0; nobody perceives touching.
    """
    scenes, agents, _ = state.position.shape
    here = jnp.asarray(state.agent_present)
    index, seen = neighbours(state.position, here, radius=sight.radius, nearest=sight.nearest)
    if state.target.shape[2]:
        seen = seen & (state.target[:, :, None] == index[..., None]).any(axis=3)
    noticed = here[..., None] & state.obstacle_present[:, None]
    if sight.radius is not None:
        apart = state.obstacle[:, None] - state.position[:, :, None]
        noticed = noticed & (jnp.sum(apart * apart, axis=-1) < sight.radius**2)

    def agent(values: Float[Array, "S N 2"]) -> Float[Array, "SN M 2"]:
        others = jnp.take_along_axis(values[:, None], index[..., None], axis=2)
        return flat(jnp.concatenate([known(here[..., None], values[:, :, None]), known(seen, others)], axis=2))

    def known(mask: Array, values: Array) -> Array:
        return jnp.where(mask[..., None], values, 0)

    def flat(values: Array) -> Array:
        return values.reshape(scenes * agents, *values.shape[2:])

    alone = make_state(
        position=agent(state.position),
        velocity=agent(state.velocity),
        goal=jnp.repeat(jnp.asarray(state.goal), agents, axis=0),
        obstacle=flat(known(noticed, state.obstacle[:, None])),
        obstacle_velocity=flat(known(noticed, state.obstacle_velocity[:, None])),
        agent_present=flat(jnp.concatenate([here[..., None], seen], axis=2)),
        obstacle_present=flat(noticed),
    )
    return replace(alone, step=jnp.repeat(jnp.asarray(state.step), agents))
