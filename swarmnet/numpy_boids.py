"""The published Boids once more, for one scene, in plain NumPy: what experts are timed against and tested against."""

import numpy as np
from jaxtyping import Bool, Float

from envs.experts.config import BoidsConfig

Vectors = Float[np.ndarray, "N 2"]
WALLS = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
"""Directions to the walls."""


def numpy_boids(
    config: BoidsConfig,
    *,
    position: Vectors,
    velocity: Vectors,
    goal: Float[np.ndarray, "2"],
    obstacle: Float[np.ndarray, "K 2"],
) -> Vectors:
    """Acceleration [m/s^2] of the agents of one scene."""
    return (
        flocking(config, position, velocity, seen_by(config, position))
        + config.obstacle * _avoidance(config, position, velocity, obstacle)
        + config.goal * _goal(config, position, velocity, goal)
    )


def seen_by(config: BoidsConfig, position: Vectors) -> Bool[np.ndarray, "N N"]:
    """Which others (columns) each agent (rows) sees."""
    distance = np.linalg.norm(position[None] - position[:, None], axis=-1)
    seen = ~np.eye(len(position), dtype=bool)
    if config.interaction.radius is not None:
        seen &= distance < config.interaction.radius
    if config.interaction.nearest is not None:
        ranked = np.argsort(np.where(seen, distance, np.inf), axis=1, kind="stable")[:, : config.interaction.nearest]
        chosen = np.zeros_like(seen)
        np.put_along_axis(chosen, ranked, True, axis=1)
        seen &= chosen
    return seen


def flocking(config: BoidsConfig, position: Vectors, velocity: Vectors, seen: Bool[np.ndarray, "N N"]) -> Vectors:
    """Weighted sum of cohesion, alignment and separation."""
    apart = position[:, None] - position[None]
    distance = np.linalg.norm(apart, axis=-1)
    push = np.where(seen & (distance < config.separation_range), np.maximum(distance, 0.01) ** -2.0, 0)
    separation = np.einsum("ij,ijd->id", push, apart)
    count = seen.sum(axis=1, keepdims=True)
    share = seen / np.maximum(count, 1)
    if not config.separation_summed:
        separation /= np.maximum(count, 1)
    cohesion, alignment = (np.where(count > 0, share @ of - of, 0) for of in (position, velocity))
    return config.cohesion * cohesion + config.alignment * alignment + config.separation * separation


def _avoidance(config: BoidsConfig, position: Vectors, velocity: Vectors, obstacle: np.ndarray) -> Vectors:
    toward = obstacle[None] - position[:, None]
    centre = np.linalg.norm(toward, axis=-1)
    direction = toward / np.maximum(centre, 1e-12)[..., None]
    surface, radius = np.maximum(centre - config.avoided_radius, 0.1), np.full(len(obstacle), config.avoided_radius)
    if config.walls:
        walls = np.broadcast_to(WALLS, (len(position), 4, 2))
        direction = np.concatenate([direction, walls], axis=1)
        surface = np.concatenate([surface, np.maximum(config.arena - position @ WALLS.T, 0.1)], axis=1)
        radius = np.concatenate([radius, np.zeros(4)])
    heading = velocity / np.maximum(np.linalg.norm(velocity, axis=-1, keepdims=True), 1e-12)
    cosine = np.einsum("id,ikd->ik", heading, direction)
    surface = np.where(cosine > 0, surface, np.inf)
    rows, nearest = np.arange(len(position)), np.argmin(surface, axis=1)
    d, r, cosine, direction = surface[rows, nearest], radius[nearest], cosine[rows, nearest], direction[rows, nearest]
    active = np.isfinite(d)
    d = np.where(active, d, 1)
    miss = (d + r) * np.sqrt(np.maximum(1 - cosine**2, 0)) - r
    turn = heading * cosine[:, None] - direction
    turn /= np.maximum(np.linalg.norm(turn, axis=-1, keepdims=True), 1e-12)
    strength = (config.obstacle_range - miss) ** 2 / np.maximum(d, config.obstacle_range)
    return turn * np.where(active & (miss < config.obstacle_range), strength, 0)[:, None]


def _goal(config: BoidsConfig, position: Vectors, velocity: Vectors, goal: np.ndarray) -> Vectors:
    toward = goal - position
    distance = np.linalg.norm(toward, axis=-1, keepdims=True)
    wanted = config.cruise_speed * np.minimum(1, distance / config.slowdown_distance)
    return wanted * toward / np.maximum(distance, 1e-12) - velocity
