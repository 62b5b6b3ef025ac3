"""Families of starting states of one scene: where goal, agents and obstacles lie before `envs.spawn` moves them apart.

Every family takes the scene's four keys and draws from nothing else, so that a scene depends on its own key alone.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Key

from envs.config import SpawnConfig
from envs.dynamics import clip_norm
from envs.experts.chaser import circle_start
from envs.record import Array, record
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec

REACH = 0.6
"""corridor, crossing: distance of a group from the arena's centre, and of the corridor's goal, in half-widths of it."""


class Keys(NamedTuple):
    """One key for each thing that is drawn."""

    goal: Key[Array, ""]
    agents: Key[Array, ""]
    velocity: Key[Array, ""]
    obstacles: Key[Array, ""]


@record
class Start:
    """What was drawn for a scene."""

    goal: Float[Array, "2"]
    """[m]"""
    position: Float[Array, "N 2"]
    """[m]"""
    velocity: Float[Array, "N 2"]
    """[m/s]"""
    obstacle: Float[Array, "K 2"]
    """[m]"""


Redraw = Callable[[Key[Array, ""], Array], Array]
"""`(key, spread) -> places [m]` for what was misplaced; `spread` [m] widens the region where obstacles may lie."""
Drawn = tuple[Start, Redraw, Redraw | None]
"""A start, and how agents and obstacles are drawn anew (None: obstacles stay where they are)."""
Family = Callable[[Keys, Bool[Array, " N"], SceneSpec, SpawnConfig], Drawn]
"""`(keys, present, spec, config) -> drawn`."""


def published(keys: Keys, present: Bool[Array, " N"], spec: SceneSpec, config: SpawnConfig) -> Drawn:
    """The author's: goal and agents uniform in squares, obstacles about the line from the goal to the mean agent."""
    goal = jax.random.uniform(keys.goal, (2,), minval=-1, maxval=1) * config.goal_range * spec.goal

    def agents(key: Key[Array, ""], spread: Array | float = 0.0) -> Float[Array, "N 2"]:
        return uniform(key, spec.num_agents, config.agent_range)

    position = agents(keys.agents)
    centre = (position * present[:, None]).sum(axis=0) / present.sum()
    from_where = jnp.broadcast_to(centre, (spec.num_obstacles, 2))

    def obstacles(key: Key[Array, ""], spread: Array | float = 0.0) -> Float[Array, "K 2"]:
        return on_the_way(key, goal, from_where, config.obstacle_radius, spread)

    velocity = published_velocity(keys.velocity, spec, config)
    start = Start(goal=goal, position=position, velocity=velocity, obstacle=obstacles(keys.obstacles))
    return start, agents, obstacles


def circle(keys: Keys, present: Bool[Array, " N"], spec: SceneSpec, config: SpawnConfig) -> Drawn:
    """Agents at uniform angles on a circle of radius `start_range` [m], as published chasers; the rest: `published`."""
    start, _, obstacles = published(keys, present, spec, config)

    def agents(key: Key[Array, ""], spread: Array | float = 0.0) -> Float[Array, "N 2"]:
        return circle_start(key, spec.num_agents, radius=config.start_range)[0]

    return replace(start, position=agents(keys.agents)), agents, obstacles


def corridor(keys: Keys, present: Bool[Array, " N"], spec: SceneSpec, config: SpawnConfig) -> Drawn:
    """A group on one side of the arena, the goal on the other, and between them two staggered rows of obstacles.

    The straight way of the group's middle leads through the corridor between the rows, `corridor_width` [m] wide. No
    agent slips through a row, but nothing keeps it from going round: with six obstacles the row parts a swarm of Boids,
    about half goes through. The direction is uniform, the corridor is shifted sideways by up to a quarter of its width,
    and obstacles lie in the rows by turns. Velocities as published. Needs room along the way (`check_family`).
    """
    axis = direction(keys.goal)
    aside = jnp.stack([-axis[1], axis[0]])
    goal = REACH * spec.arena * axis * spec.goal

    def agents(key: Key[Array, ""], spread: Array | float = 0.0) -> Float[Array, "N 2"]:
        offset = uniform(key, spec.num_agents, config.start_range)
        return -REACH * spec.arena * axis + offset[:, :1] * axis + offset[:, 1:] * aside

    k_shift, k_side = jax.random.split(keys.obstacles)
    shift = jax.random.uniform(k_shift, (), minval=-0.25, maxval=0.25) * config.corridor_width
    first = jnp.where(jax.random.bernoulli(k_side), 1.0, -1.0)
    number = jnp.arange(spec.num_obstacles)
    low, high = corridor_room(spec, config)
    along = (low + high) / 2 + (number - (spec.num_obstacles - 1) / 2) * corridor_pitch(spec)
    across = shift + first * jnp.where(number % 2, -1, 1) * (config.corridor_width / 2 + spec.obstacle_radius)
    obstacle = along[:, None] * axis + across[:, None] * aside
    start = Start(
        goal=goal,
        position=agents(keys.agents),
        velocity=published_velocity(keys.velocity, spec, config),
        obstacle=obstacle,
    )
    return start, agents, None


def crossing(keys: Keys, present: Bool[Array, " N"], spec: SceneSpec, config: SpawnConfig) -> Drawn:
    """Two groups whose directions from the centre differ by 90 to 180 degrees (uniform), each heading for the goal.

    What crosses are their ways: the scene's one goal lies in the middle (within a tenth of the arena), both groups come
    to it at the same time and from different sides, and meet there; a law that knows the goal does not send them on to
    the far side. Agents belong to the groups by turns, and obstacles lie on the two ways by turns.
    """
    k_goal, k_side, k_angle = jax.random.split(keys.goal, 3)
    goal = jax.random.uniform(k_goal, (2,), minval=-0.1, maxval=0.1) * spec.arena * spec.goal
    one, angle = direction(k_side), jax.random.uniform(k_angle, (), minval=math.pi / 2, maxval=math.pi)
    turned = jnp.stack(
        [jnp.cos(angle) * one[0] - jnp.sin(angle) * one[1], jnp.sin(angle) * one[0] + jnp.cos(angle) * one[1]]
    )
    groups = REACH * spec.arena * jnp.stack([one, turned])
    home = groups[jnp.arange(spec.num_agents) % 2]

    def agents(key: Key[Array, ""], spread: Array | float = 0.0) -> Float[Array, "N 2"]:
        return home + uniform(key, spec.num_agents, config.start_range)

    def obstacles(key: Key[Array, ""], spread: Array | float = 0.0) -> Float[Array, "K 2"]:
        return on_the_way(key, goal, groups[jnp.arange(spec.num_obstacles) % 2], config.obstacle_radius, spread)

    toward = goal - home
    velocity = toward / jnp.linalg.norm(toward, axis=-1, keepdims=True) * min(config.speed_range, spec.max_speed)
    start = Start(goal=goal, position=agents(keys.agents), velocity=velocity, obstacle=obstacles(keys.obstacles))
    return start, agents, obstacles


FAMILY: dict[str, Family] = {"published": published, "circle": circle, "corridor": corridor, "crossing": crossing}


def uniform(key: Key[Array, ""], count: int, half: float) -> Float[Array, "n 2"]:
    """Places in [-half, half]^2 [m]."""
    return jax.random.uniform(key, (count, 2), minval=-half, maxval=half)


def direction(key: Key[Array, ""]) -> Float[Array, "2"]:
    """A unit vector, uniform on the circle."""
    angle = jax.random.uniform(key, (), maxval=2 * math.pi)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def published_velocity(key: Key[Array, ""], spec: SceneSpec, config: SpawnConfig) -> Float[Array, "N 2"]:
    """Uniform in a square, then clipped to the speed limit [m/s]."""
    return clip_norm(uniform(key, spec.num_agents, config.speed_range), spec.max_speed)


def on_the_way(
    key: Key[Array, ""], goal: Float[Array, "2"], centre: Float[Array, "K 2"], r: float, spread: Array | float = 0.0
) -> Float[Array, "K 2"]:
    """About the line from the goal to a group's centre: along it U(2 + r, L - r) from the goal, across it U(-2r, 2r).

    `spread` [m] makes the line longer behind the centre and the strip wider on both sides.
    """
    line = centre - goal
    length = jnp.sqrt(jnp.sum(line * line, axis=-1, keepdims=True))
    along = line / jnp.maximum(length, 1e-6)
    across = jnp.stack([-along[:, 1], along[:, 0]], axis=-1)
    u = jax.random.uniform(key, (centre.shape[0], 2))
    distance = (2 + r) + u[:, :1] * (length - r - (2 + r) + spread)
    return goal + distance * along + ((4 * r + 2 * spread) * u[:, 1:] - (2 * r + spread)) * across


def corridor_pitch(spec: SceneSpec) -> float:
    """Distance along the corridor from one obstacle to the next, which is in the other row [m].

    Two of them are a row's spacing: its gaps are an agent's radius, so that no agent slips through.
    """
    return spec.obstacle_radius + spec.agent_radius / 2


def corridor_room(spec: SceneSpec, config: SpawnConfig) -> tuple[float, float]:
    """Where along the way the centres of a corridor's obstacles may lie [m]: beyond the start, 2 m before the goal."""
    before = spec.obstacle_radius + spec.agent_radius + config.clearance
    return -REACH * spec.arena + config.start_range + before, REACH * spec.arena - spec.obstacle_radius - 2


def check_family(spec: SceneSpec, config: SpawnConfig) -> None:
    """Raises SpecError when a corridor or a crossing does not fit into the arena."""
    if config.family in ("published", "circle"):
        if config.family == "circle" and config.start_range > spec.arena:
            raise SpecError("start_range", config.start_range, f"at most the arena's half-width of {spec.arena} m")
        return
    most = spec.arena * (math.sqrt(2 - REACH**2) - REACH) / 2  # (REACH + s)^2 + s^2 = 1, the farthest corner's place
    if config.start_range > most:
        raise SpecError("start_range", config.start_range, f"at most {most:.1f} m in an arena of {spec.arena} m")
    if config.family == "corridor":
        low, high = corridor_room(spec, config)
        fitting = 1 + math.floor((high - low) / corridor_pitch(spec)) if high >= low else 0
        if spec.num_obstacles > fitting:
            raise SpecError("num_obstacles", spec.num_obstacles, f"at most {fitting} in a corridor of this arena")
        # The corridor may lie in any direction and up to a quarter of its width aside: its farthest obstacle stays in.
        along = abs(low + high) / 2 + max(spec.num_obstacles - 1, 0) / 2 * corridor_pitch(spec)
        aside = math.sqrt(max((spec.arena - spec.obstacle_radius) ** 2 - along**2, 0.0)) - spec.obstacle_radius
        if spec.num_obstacles and config.corridor_width > aside / 0.75:
            allowed = f"at most {aside / 0.75:.1f} m with {spec.num_obstacles} obstacles in an arena of {spec.arena} m"
            raise SpecError("corridor_width", config.corridor_width, allowed)
