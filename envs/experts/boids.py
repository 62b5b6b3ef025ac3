"""Boids (Reynolds 1999) as the thesis's author coded them: five rules, each a function, summed with weights."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Bool, Float

from envs.experts.config import BoidsConfig, Interaction
from envs.experts.goal import goal_seeking
from envs.experts.pairs import Pairs, sum_over
from envs.policy import Policy
from envs.record import Array
from envs.state import State

Vectors = Float[Array, "S N 2"]
Present = Bool[Array, "S N"]


def boids(config: BoidsConfig) -> Policy:
    """The expert `(state, params, key) -> acceleration`; it uses neither params nor key."""

    def policy(state: State, params: object = None, key: object = None) -> Vectors:
        total = jnp.zeros_like(state.position)
        flocking = flock(state, config)  # once: the three rules share their neighbour search
        for name, rule in rules(config).items():
            weight = getattr(config, name)
            if weight:
                total = total + weight * (flocking[name] if name in flocking else rule(state))
        return jnp.where(state.agent_present[..., None], total, 0)

    return policy


def rules(config: BoidsConfig) -> dict[str, Callable[[State], Vectors]]:
    """The five rules by name, without their weights: `state -> (S, N, 2)`."""
    return {
        "cohesion": lambda s: flock(s, config)["cohesion"],
        "separation": lambda s: flock(s, config)["separation"],
        "alignment": lambda s: flock(s, config)["alignment"],
        "obstacle": lambda s: avoidance(s, config),
        "goal": lambda s: goal_seeking(s, cruise_speed=config.cruise_speed, slowdown_distance=config.slowdown_distance),
    }


def flock(state: State, config: BoidsConfig) -> dict[str, Vectors]:
    """Cohesion, separation and alignment: mean position, push and mean velocity of the others seen, minus own.

    Separation is the sum over others in range of (p_i - p_j) / d^2, d floored at 0.01 m; divided by the number of
    others if not summed. An agent that sees nobody feels none of the three.
    """
    everyone = config.interaction.full
    # Whom separation acts on is near: with everyone in sight the means come from totals, and only the near are visited.
    interaction = Interaction(radius=config.separation_range) if everyone else config.interaction

    def law(pairs: Pairs) -> dict[str, Array]:
        distance = pairs.distance
        push = 1 / jnp.maximum(distance, 0.01) ** 2
        close = distance < config.separation_range
        sums = {"push x": pairs.total(-pairs.dx * push, close), "push y": pairs.total(-pairs.dy * push, close)}
        if not everyone:
            for name, plane in (("x", pairs.dx), ("y", pairs.dy), ("u", pairs.du), ("w", pairs.dw), ("count", 1)):
                sums[name] = pairs.total(plane)
        return sums

    present = state.agent_present
    sums = sum_over(interaction, law, position=state.position, velocity=state.velocity, present=present)
    push = jnp.stack([sums["push x"], sums["push y"]], axis=-1)
    if everyone:
        count = (present.sum(axis=1, keepdims=True) - present)[..., None].astype(push.dtype)
        cohesion, alignment = mean_of_others(state.position, present), mean_of_others(state.velocity, present)
    else:
        count = sums["count"][..., None]
        cohesion, alignment = (
            jnp.stack([sums[x], sums[y]], axis=-1) / jnp.maximum(count, 1) for x, y in (("x", "y"), ("u", "w"))
        )
    separation = push if config.separation_summed else push / jnp.maximum(count, 1)
    return {"cohesion": cohesion, "separation": separation, "alignment": alignment}


def mean_of_others(quantity: Vectors, present: Present) -> Vectors:
    """Mean over all others minus own, in O(N); 0 for an agent alone."""
    there = present[..., None].astype(quantity.dtype)
    others = there.sum(axis=1, keepdims=True) - there
    total = (quantity * there).sum(axis=1, keepdims=True) - quantity * there
    return jnp.where(others > 0, total / jnp.maximum(others, 1) - quantity, 0)


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
