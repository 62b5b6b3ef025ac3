"""What the engines inside XLA share: all scenes through one scene's substeps, and contacts from what they saw."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from envs.engines.engine import obstacle_path, read_sensors, with_obstacles_moved
from envs.record import Array, record
from envs.state import Contacts, State, no_contacts
from swarm_mjcf.index import SceneIndex
from swarm_mjcf.spec import SceneSpec


@record
class Seen:
    """One scene's states 1..k of a control step."""

    position: Float[Array, "k N 2"]
    """Agents' positions [m]."""
    velocity: Float[Array, "N 2"]
    """Agents' velocities [m/s] at state k."""
    sensors: Float[Array, "k M"]
    """Contact sensors."""
    full: Bool[Array, " k"]
    """Whether the engine's room for contacts was full, so that some may be missing."""


Advance = Callable[[Array, Array, Array, Array], Seen]
"""`(position (N, 2), velocity (N, 2), obstacle path (k + 1, K, 2), acceleration (N, 2)) -> Seen`, for one scene."""


def step_in_xla(
    advance: Advance, state: State, acceleration: Float[Array, "S N 2"], *, index: SceneIndex, spec: SceneSpec
) -> tuple[State, Contacts]:
    """One control step of all scenes; contacts of states 1..k."""
    path = obstacle_path(state, spec)
    seen = jax.vmap(advance)(state.position, state.velocity, path, acceleration)
    state = with_obstacles_moved(state, path, spec)
    state = replace(state, position=seen.position[:, -1], velocity=seen.velocity)
    if not can_touch(spec):
        return state, no_contacts(*state.position.shape[:2])
    before = (state.touching_agent, state.touching_obstacle, state.touching_wall)
    (agent, obstacle, wall), on_agent, fields = read_sensors(jnp, seen.sensors, before, index, spec)
    state = replace(state, touching_agent=agent, touching_obstacle=obstacle, touching_wall=wall)
    depth = _agent_depth(on_agent, seen.position, spec.agent_radius)
    return state, Contacts(**fields, agent_depth=depth, saturated=seen.full.sum(axis=1, dtype=jnp.int32))


def can_touch(spec: SceneSpec) -> bool:
    """Whether any two bodies of the scene can ever be in contact."""
    return spec.contacts and (spec.num_agents > 1 or spec.num_obstacles > 0 or spec.walls)


def _agent_depth(
    on_agent: Bool[Array, "S k N"], position: Float[Array, "S k N 2"], radius: float | int
) -> Float[Array, "S N"]:
    """Deepest agent-agent penetration [m], from geometry at the flagged states, one at a time."""
    scenes, _, agents = on_agent.shape
    itself = jnp.where(jnp.eye(agents, dtype=bool), jnp.inf, 0)

    def deeper(depth: Array, now: tuple[Array, Array]):
        flag, position = now
        apart = position[:, :, None] - position[:, None]
        distance = (jnp.sqrt(jnp.sum(apart * apart, axis=-1)) + itself).min(axis=-1)
        return jnp.maximum(depth, jnp.where(flag, 2 * radius - distance, 0)), None

    states = (jnp.moveaxis(on_agent, 1, 0), jnp.moveaxis(position, 1, 0))
    return jax.lax.scan(deeper, jnp.zeros((scenes, agents), jnp.float32), states)[0]
