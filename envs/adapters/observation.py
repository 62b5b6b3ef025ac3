"""What each agent perceives, as one vector of fixed length with a label, a unit and bounds for every entry."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from envs.dynamics import clip_norm
from envs.record import Array
from envs.state import State
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec


@dataclass(frozen=True, eq=False)
class Observation:
    """A view of the world, D numbers per agent. Every adapter takes one; `nearest` is the default."""

    observe: Callable[[State], Array]
    """`state -> (S, N, D)` float32, inside `jit`; rows of absent agents are 0."""
    labels: tuple[str, ...]
    """One per entry, with its unit."""
    low: Float[np.ndarray, " D"]
    high: Float[np.ndarray, " D"]

    def __post_init__(self) -> None:
        count = len(self.labels)
        if self.low.shape != (count,) or self.high.shape != (count,):
            raise SpecError("low, high", (self.low.shape, self.high.shape), f"one bound per label, shape ({count},)")


def nearest(
    spec: SceneSpec,
    *,
    neighbours: int = 8,
    obstacles: int = 4,
    sight: float | int | None = None,
) -> Observation:
    """Own velocity, the vector to the goal, and the nearest agents and obstacles, nearest first; SI units.

    Entries: present [0/1], velocity [m/s], vector to the goal [m] (shortened to `sight`, left out in a scene without
    goal), then for each of the nearest agents and obstacles: seen [0/1], position relative to own [m], velocity
    relative to own [m/s]. What is absent or farther than `sight` (default: twice the arena's half-width) is not seen:
    zeros. Relative to the world's axes, so moving everything changes nothing. Velocities that contacts drive beyond
    twice the speed limit (relative: four times) are clipped to their bounds.

    Raises:
      SpecError: a count is below 0, or `sight` is not above 0.
    """
    for field, given in (("neighbours", neighbours), ("obstacles", obstacles)):
        if given < 0:
            raise SpecError(field, given, "at least 0")
    reach = float(2 * spec.arena if sight is None else sight)
    if not reach > 0:
        raise SpecError("sight", sight, "above 0 [m]")
    agents, solids = min(neighbours, spec.num_agents - 1), min(obstacles, spec.num_obstacles)
    labels, bounds = ["present"], [(0.0, 1.0)]
    labels += [f"velocity {axis} [m/s]" for axis in "xy"]
    bounds += [(-2 * spec.max_speed, 2 * spec.max_speed)] * 2
    if spec.goal:
        labels += [f"goal {axis} [m]" for axis in "xy"]
        bounds += [(-reach, reach)] * 2
    for name in [f"agent {j}" for j in range(agents)] + [f"obstacle {k}" for k in range(solids)]:
        labels += [f"{name} seen", f"{name} x [m]", f"{name} y [m]", f"{name} vx [m/s]", f"{name} vy [m/s]"]
        bounds += [(0.0, 1.0), *[(-reach, reach)] * 2, *[(-4 * spec.max_speed, 4 * spec.max_speed)] * 2]
    low, high = np.asarray(bounds, np.float32).T

    def observe(state: State) -> Float[Array, "S N D"]:
        here = state.agent_present
        parts = [here[..., None], state.velocity]
        if spec.goal:
            parts.append(clip_norm(state.goal[:, None] - state.position, reach))
        others = here[:, None] & ~jnp.eye(here.shape[1], dtype=bool)
        parts.append(_nearest(state, (state.position, state.velocity, others), agents, reach))
        there = jnp.broadcast_to(state.obstacle_present[:, None], (*here.shape, state.obstacle.shape[1]))
        parts.append(_nearest(state, (state.obstacle, state.obstacle_velocity, there), solids, reach))
        features = jnp.concatenate([part.astype(jnp.float32) for part in parts], axis=-1)
        return jnp.where(here[..., None], jnp.clip(features, low, high), 0)

    return Observation(observe, tuple(labels), low.copy(), high.copy())


def _nearest(state: State, bodies: tuple[Array, Array, Array], count: int, reach: float) -> Float[Array, "S N F"]:
    """(seen, relative position, relative velocity) of the `count` nearest of M bodies, flat, F = 5 count.

    `bodies` are positions and velocities (S, M, 2) and who may be seen by whom (S, N, M).
    """
    place, speed, allowed = bodies
    if not count:
        return jnp.zeros((*state.position.shape[:2], 0), jnp.float32)
    # Planes (S, N, M): a trailing axis of 2 would keep XLA from using vector instructions.
    dx, dy = (place[:, None, :, axis] - state.position[:, :, None, axis] for axis in (0, 1))
    square = dx * dx + dy * dy
    seen = allowed & (square <= reach * reach)
    _, first = jax.lax.top_k(jnp.where(seen, -square, -jnp.inf), count)
    vx, vy = (speed[:, None, :, axis] - state.velocity[:, :, None, axis] for axis in (0, 1))
    planes = jnp.where(seen[..., None], jnp.stack([jnp.ones_like(dx), dx, dy, vx, vy], axis=-1), 0)
    return jnp.take_along_axis(planes, first[..., None], axis=2).reshape(*state.position.shape[:2], 5 * count)
