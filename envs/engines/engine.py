"""The protocol of a physics engine, and what all engines share: sensors at substep states -> `Contacts`."""

from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from envs.record import Array
from envs.state import Contacts, State
from swarm_mjcf.errors import SwarmError
from swarm_mjcf.index import SceneIndex
from swarm_mjcf.names import WALLS
from swarm_mjcf.spec import SceneSpec


class EngineError(SwarmError):
    """An engine cannot simulate this: it is not installed, or physics ran out of memory for contacts."""


@runtime_checkable
class Engine(Protocol):
    """Advances a batch by one control step of constant acceleration; callable inside `jit` and `lax.scan`.

    `acceleration` is (S, N, 2) [m/s^2], executed as it is (limits come before, `dynamics.limited`). The returned state
    differs in position, velocity and touching flags only, and in `obstacle` where obstacles move. Absent bodies stay
    where they are parked.
    """

    @property
    def name(self) -> str: ...

    @property
    def spec(self) -> SceneSpec: ...

    def step(self, state: State, acceleration: Array) -> tuple[State, Contacts]: ...


def obstacle_path(state: State, spec: SceneSpec) -> Float[Array, "S k1 K 2"]:
    """Where obstacles are [m] at the states 0..k of the next control step: at state j, x + v j dt / k."""
    if not spec.moving_obstacles:
        return jnp.broadcast_to(
            state.obstacle[:, None], (len(state.obstacle), spec.substeps + 1, spec.num_obstacles, 2)
        )
    velocity = jnp.where(state.obstacle_present[..., None], state.obstacle_velocity, 0)
    times = jnp.arange(spec.substeps + 1, dtype=state.obstacle.dtype) * spec.timestep
    return state.obstacle[:, None] + velocity[:, None] * times[:, None, None]


def with_obstacles_moved(state: State, path: Float[Array, "S k1 K 2"], spec: SceneSpec) -> State:
    """The state with its obstacles at the end of their path; untouched where they stand still."""
    return replace(state, obstacle=path[:, -1]) if spec.moving_obstacles else state


def read_sensors(
    xp: Any, sensors: Any, before: tuple[Any, Any, Any], index: SceneIndex, spec: SceneSpec
) -> tuple[tuple[Any, Any, Any], Any, dict[str, Any]]:
    """Sensors (S, k, M) of states 1..k -> flags at state k, agent-agent flags (S, k, N), and fields of `Contacts`.

    `xp` is `numpy` or `jax.numpy`; `before` are the touching flags of state 0 (agent, obstacle, wall). Agent-agent is
    what is left of an agent's contacts without its obstacles and walls. All fields but `agent_depth` and `saturated`.
    """
    scenes, k, _ = sensors.shape
    agents, walls = spec.num_agents, len(WALLS) * spec.walls
    touch = sensors[..., index.touch]
    obstacle = sensors[..., index.obstacle_touch].reshape(scenes, k, spec.num_obstacles, agents, 2)
    wall = sensors[..., index.wall_touch].reshape(scenes, k, walls, agents, 2)
    on_agent = touch > obstacle[..., 0].sum(axis=2) + wall[..., 0].sum(axis=2)
    on_obstacle = xp.moveaxis(obstacle[..., 0] > 0, 2, 3)
    on_wall = (wall[..., 0] > 0).any(axis=2)

    def states(flags: Any) -> Any:
        return xp.sum(flags, axis=1, dtype=np.int32)

    def onsets(flags: Any, at_0: Any) -> Any:
        earlier = xp.concatenate([at_0[:, None], flags[:, :-1]], axis=1)
        return xp.sum(flags & ~earlier, axis=1, dtype=np.int32)

    def deepest(distance: Any) -> Any:  # signed distances, 0 where nothing touches
        return xp.maximum(-distance.min(axis=(1, 2), initial=0), 0).astype(np.float32)

    fields = {
        "agent_states": states(on_agent),
        "obstacle_states": states(on_obstacle.any(axis=-1)),
        "wall_states": states(on_wall),
        "agent_events": onsets(on_agent, before[0]),
        "obstacle_events": onsets(on_obstacle, before[1]).sum(axis=-1, dtype=np.int32),
        "wall_events": onsets(on_wall, before[2]),
        "obstacle_depth": deepest(obstacle[..., 1]),
        "wall_depth": deepest(wall[..., 1]),
    }
    return (on_agent[:, -1], on_obstacle[:, -1], on_wall[:, -1]), on_agent, fields
