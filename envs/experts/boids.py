"""Boids (Reynolds 1999) as the thesis's author coded them: five rules, each a function, summed with weights."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Bool, Float

from envs.experts.config import BoidsConfig
from envs.policy import Policy
from envs.record import Array
from envs.state import State

Vectors = Float[Array, "S N 2"]
Present = Bool[Array, "S N"]


def boids(config: BoidsConfig) -> Policy:
    """The expert `(state, params, key) -> acceleration`; it uses neither params nor key."""

    def policy(state: State, params: object = None, key: object = None) -> Vectors:
        total = jnp.zeros_like(state.position)
        for name, rule in rules(config).items():
            weight = getattr(config, name)
            if weight:
                total = total + weight * rule(state)
        return jnp.where(state.agent_present[..., None], total, 0)

    return policy


def rules(config: BoidsConfig) -> dict[str, Callable[[State], Vectors]]:
    """The five rules by name, without their weights: `state -> (S, N, 2)`."""
    return {
        "cohesion": lambda s: cohesion(s.position, s.agent_present),
        "separation": lambda s: separation(s.position, s.agent_present, config),
        "alignment": lambda s: cohesion(s.velocity, s.agent_present),
        "obstacle": lambda s: avoidance(s, config),
        "goal": lambda s: goal_seeking(s.position, s.velocity, s.goal, config),
    }


def cohesion(quantity: Vectors, present: Present) -> Vectors:
    """Mean over the others minus own: cohesion of positions, alignment of velocities; 0 for an agent alone."""
    there = present[..., None].astype(quantity.dtype)
    others = there.sum(axis=1, keepdims=True) - there
    total = (quantity * there).sum(axis=1, keepdims=True) - quantity * there
    return jnp.where(others > 0, total / jnp.maximum(others, 1) - quantity, 0)


def separation(position: Vectors, present: Present, config: BoidsConfig) -> Vectors:
    """Sum over others in range of (p_i - p_j) / d^2, d floored at 0.01 m; divided by the others if not summed."""
    # x and y as planes (S, N, N): a trailing axis of 2 would keep XLA from using vector instructions.
    x, y = position[..., 0], position[..., 1]
    dx, dy = x[:, :, None] - x[:, None], y[:, :, None] - y[:, None]
    distance = jnp.sqrt(dx * dx + dy * dy)
    agents = position.shape[1]
    close = (distance < config.separation_range) & present[:, None] & ~jnp.eye(agents, dtype=bool)
    push = jnp.where(close, 1 / jnp.maximum(distance, 0.01) ** 2, 0)
    total = jnp.stack([jnp.sum(dx * push, axis=2), jnp.sum(dy * push, axis=2)], axis=-1)
    if config.separation_summed:
        return total
    return total / jnp.maximum(present.sum(axis=1) - 1, 1)[:, None, None].astype(position.dtype)


def avoidance(state: State, config: BoidsConfig) -> Vectors:
    """Turn away from the nearest obstacle ahead (walls too) that would be missed by less than `obstacle_range`.

    Surface distance `d = max(|o - p| - r, 0.1)`, miss distance `m = (d + r) sin - r` with the angle between velocity
    and direction; if `m < size`: unit vector of `v_hat cos - dir` times `(size - m)^2 / max(d, size)`. Exactly head-on,
    where that is 0/0, the turn is to the left.
    """
    position, velocity = state.position, state.velocity
    radius, size = config.avoided_radius, config.obstacle_range
    toward = state.obstacle[:, None] - position[:, :, None]
    centre = jnp.sqrt(jnp.sum(toward * toward, axis=-1))
    direction = toward / jnp.maximum(centre, 1e-12)[..., None]
    surface = jnp.where(state.obstacle_present[:, None], jnp.maximum(centre - radius, 0.1), jnp.inf)
    radii = jnp.full(state.obstacle.shape[1], radius, position.dtype)
    if config.walls:
        outward = jnp.asarray([[1, 0], [0, 1], [-1, 0], [0, -1]], position.dtype)
        to_wall = config.arena - position @ outward.T
        shape = (*position.shape[:2], 4, 2)
        direction = jnp.concatenate([direction, jnp.broadcast_to(outward, shape)], axis=2)
        surface = jnp.concatenate([surface, jnp.maximum(to_wall, 0.1)], axis=2)
        radii = jnp.concatenate([radii, jnp.zeros(4, position.dtype)])
    if not direction.shape[2]:
        return jnp.zeros_like(position)
    speed = jnp.sqrt(jnp.sum(velocity * velocity, axis=-1, keepdims=True))
    heading = velocity / jnp.maximum(speed, 1e-12)
    ahead = jnp.sum(heading[:, :, None] * direction, axis=-1) > 0
    nearest = jnp.argmin(jnp.where(ahead, surface, jnp.inf), axis=-1)
    direction = jnp.take_along_axis(direction, nearest[..., None, None], axis=2)[:, :, 0]
    d = jnp.take_along_axis(surface, nearest[..., None], axis=2)
    r = radii[nearest][..., None]
    cosine = jnp.sum(heading * direction, axis=-1, keepdims=True)
    cross = heading[..., :1] * direction[..., 1:] - heading[..., 1:] * direction[..., :1]
    sine = jnp.abs(cross)
    # v_hat cos - dir is v_hat turned by 90 degrees, away from the obstacle, times the sine.
    left = jnp.concatenate([-heading[..., 1:], heading[..., :1]], axis=-1)
    turn = jnp.where(cross > 0, -left, left)
    miss = (d + r) * sine - r
    strength = (size - miss) ** 2 / jnp.maximum(d, size)
    active = (miss < size) & (cosine > 0) & jnp.isfinite(d)
    return jnp.where(active, turn * jnp.where(active, strength, 0), 0)


def goal_seeking(position: Vectors, velocity: Vectors, goal: Float[Array, "S 2"], config: BoidsConfig) -> Vectors:
    """Wanted minus own velocity; wanted is toward the goal at `cruise_speed min(1, D / slowdown_distance)`."""
    toward = goal[:, None] - position
    distance = jnp.sqrt(jnp.sum(toward * toward, axis=-1, keepdims=True))
    wanted = config.cruise_speed * jnp.minimum(1, distance / config.slowdown_distance)
    return wanted * toward / jnp.maximum(distance, 1e-12) - velocity
