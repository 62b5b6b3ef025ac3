"""What repair asks of physics: a policy's weights act in scenes of their own for every round."""

import jax
import numpy as np

from envs.config import World
from envs.policy import Policy
from envs.rollout import make_rollout
from envs.swarm_env import SwarmEnv, scene_keys
from gnn.checkpoint import Model
from gnn.decode import make_policy
from gnn.family import Params
from gnn.graph import graph_of_state
from repair.screen import Acted, Perform
from swarm_mjcf.errors import SpecError

BATCH = 256
"""Scenes at a time."""


def make_perform(
    model: Model,
    world: World,
    *,
    scenes: int,
    steps: int,
    seed: int,
    engine: str = "auto",
    policy: Policy | None = None,
) -> Perform:
    """`perform(weights, round) -> Acted`: scenes `round * scenes` and on of a seed, compiled once.

    `policy`: another one of the same weights, a filtered one, say. Raises SpecError for limits that are none.
    """
    for name, value in (("scenes", scenes), ("steps", steps)):
        if value < 1:
            raise SpecError(name, value, "at least 1")
    env = SwarmEnv(world.scene, engine=engine, spawn=world.spawn, horizon=steps)
    act = make_policy(model.config, model.scales, goal=world.scene.goal) if policy is None else policy
    run = make_rollout(env, act, steps=steps)

    def perform(params: Params, number: int) -> Acted:
        batch, parts = min(BATCH, scenes), []
        for first in range(0, scenes, batch):
            # The last scene fills up a short batch.
            local = np.minimum(np.arange(first, first + batch), scenes - 1)
            keys = scene_keys(seed, number * scenes + local)
            start = env.reset(keys)
            recording = jax.device_get(run(params, start, keys))
            nodes, graph = jax.device_get(graph_of_state(start, goal=world.scene.goal))
            rows, agents = recording.position.shape[1:3]
            states = np.repeat(nodes[:, None], rows, axis=1)
            states[:, :, -agents:] = np.concatenate([recording.position, recording.velocity], axis=-1)
            if recording.obstacle is not None:
                obstacles = graph.counts[1]
                states[:, :, -agents - obstacles : -agents, :2] = recording.obstacle
            acted = Acted(
                nodes=states,
                graph=graph,
                touching_agent=recording.contacts.agent_states > 0,
                touching_obstacle=(recording.contacts.obstacle_states + recording.contacts.wall_states) > 0,
            )
            parts.append(jax.tree.map(lambda x, n=scenes - first: x[:n], acted))
        return jax.tree.map(lambda *x: np.concatenate(x), *parts)

    return perform
