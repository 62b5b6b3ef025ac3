"""Starting states, one key per scene, so that a scene depends on its own key and on nothing else in the batch."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Key

from envs.config import SpawnConfig
from envs.dynamics import clip_norm
from envs.record import Array
from envs.state import State, make_state, park
from swarm_mjcf.errors import SpecError, SwarmError
from swarm_mjcf.spec import SceneSpec

ROUNDS = 200
"""Times that overlapping agents of a scene are drawn anew before the scene counts as too dense."""
JAMMING = 0.5
"""Share of the area that random placement without overlap can fill at best (jamming is at 0.547)."""


class SpawnError(SwarmError):
    """No room: the bodies do not fit into the spawning area without overlap.

    Attributes: `failed` scenes out of `scenes`.
    """

    def __init__(self, message: str, *, failed: int, scenes: int) -> None:
        super().__init__(message)
        self.failed, self.scenes = failed, scenes


def check_spawn(spec: SceneSpec, config: SpawnConfig) -> None:
    """Raises SpecError or SpawnError for a configuration that can never be spawned."""
    if (config.min_agents or 0) > spec.num_agents:
        raise SpecError("min_agents", config.min_agents, f"at most num_agents = {spec.num_agents}")
    if (config.min_obstacles or 0) > spec.num_obstacles:
        raise SpecError("min_obstacles", config.min_obstacles, f"at most num_obstacles = {spec.num_obstacles}")
    if config.agent_range > spec.arena:
        raise SpecError("agent_range", config.agent_range, f"at most the arena's half-width of {spec.arena} m")
    disc = math.pi * (spec.agent_radius + config.clearance / 2) ** 2
    share = spec.num_agents * disc / max(2 * config.agent_range, 1e-9) ** 2
    if not config.overlap and spec.num_agents > 1 and share > JAMMING:
        raise _too_dense(spec, config, f"they would fill {share:.0%} of it, {JAMMING:.0%} is the most", 1, 1)


def too_dense(spec: SceneSpec, config: SpawnConfig, failed: int, scenes: int) -> SpawnError:
    """The error for scenes in which some agent found no room in `ROUNDS` draws."""
    return _too_dense(spec, config, f"{failed} of {scenes} scenes found no room in {ROUNDS} draws", failed, scenes)


def _too_dense(spec: SceneSpec, config: SpawnConfig, why: str, failed: int, scenes: int) -> SpawnError:
    return SpawnError(
        f"too dense: {spec.num_agents} agents of radius {spec.agent_radius} m with {config.clearance} m between them "
        f"do not fit into [-{config.agent_range}, {config.agent_range}]^2 m ({why}); take fewer or smaller agents, "
        "less clearance, or a larger agent_range",
        failed=failed,
        scenes=scenes,
    )


def spawn(keys: Key[Array, " S"], spec: SceneSpec, config: SpawnConfig) -> tuple[State, Bool[Array, " S"]]:
    """Starting states and whether each found room; pure, callable inside `jit`. Absent bodies are parked."""

    def scene(key: Key[Array, ""]):
        k_goal, k_agents, k_velocity, k_obstacles, k_counts, k_rounds = jax.random.split(key, 6)
        present, obstacle_present = _composition(k_counts, spec, config)
        goal = jax.random.uniform(k_goal, (2,), minval=-1, maxval=1) * config.goal_range * spec.goal
        position = _uniform(k_agents, spec.num_agents, config.agent_range)
        velocity = clip_norm(_uniform(k_velocity, spec.num_agents, config.speed_range), spec.max_speed)
        centre = (position * present[:, None]).sum(axis=0) / present.sum()
        obstacle = _obstacles(k_obstacles, goal, centre, spec, config)
        ok = jnp.asarray(True)
        if not config.overlap:
            position, ok = _apart(k_rounds, position, present, obstacle, obstacle_present, spec=spec, config=config)
        return position, velocity, goal, obstacle, present, obstacle_present, ok

    position, velocity, goal, obstacle, present, obstacle_present, ok = jax.vmap(scene)(keys)
    state = make_state(
        position=position,
        velocity=velocity,
        goal=goal,
        obstacle=obstacle,
        agent_present=present,
        obstacle_present=obstacle_present,
    )
    return park(state, spec), ok


def _uniform(key: Key[Array, ""], count: int, half: float) -> Float[Array, "n 2"]:
    return jax.random.uniform(key, (count, 2), minval=-half, maxval=half)


def _composition(key: Key[Array, ""], spec: SceneSpec, config: SpawnConfig) -> tuple[Array, Array]:
    k_agents, k_obstacles = jax.random.split(key)

    def draw(key: Key[Array, ""], low: int | None, high: int) -> Array:
        count = high if low is None else jax.random.randint(key, (), low, high + 1)
        return jnp.arange(high) < count

    return draw(k_agents, config.min_agents, spec.num_agents), draw(
        k_obstacles, config.min_obstacles, spec.num_obstacles
    )


def _obstacles(
    key: Key[Array, ""], goal: Array, centre: Array, spec: SceneSpec, config: SpawnConfig
) -> Float[Array, "K 2"]:
    """About the line from the goal to the mean agent: along it U(2 + r, L - r) from the goal, across it U(-2r, 2r)."""
    line = centre - goal
    length = jnp.sqrt(jnp.sum(line * line))
    along = line / jnp.maximum(length, 1e-6)
    across = jnp.stack([-along[1], along[0]])
    r = config.obstacle_radius
    u = jax.random.uniform(key, (spec.num_obstacles, 2))
    distance = (2 + r) + u[:, :1] * (length - r - (2 + r))
    return goal + distance * along + (4 * r * u[:, 1:] - 2 * r) * across


def _apart(
    key: Key[Array, ""],
    position: Array,
    present: Array,
    obstacle: Array,
    obstacle_present: Array,
    *,
    spec: SceneSpec,
    config: SpawnConfig,
) -> tuple[Array, Bool[Array, ""]]:
    """Draws agents anew that start too close to an obstacle or to an agent of lower index, at most `ROUNDS` times."""
    earlier = jnp.tril(jnp.ones((spec.num_agents, spec.num_agents), bool), -1)

    def overlapping(position: Array) -> Bool[Array, " N"]:
        apart = jnp.sum((position[:, None] - position[None]) ** 2, axis=-1)
        close = (apart < (2 * spec.agent_radius + config.clearance) ** 2) & earlier & present
        apart = jnp.sum((position[:, None] - obstacle[None]) ** 2, axis=-1)
        reach = spec.agent_radius + spec.obstacle_radius + config.clearance
        inside = (apart < reach**2) & obstacle_present
        return present & (close.any(axis=1) | inside.any(axis=1))

    def redraw(carry: tuple[Array, Array, Array]):
        position, bad, turn = carry
        new = _uniform(jax.random.fold_in(key, turn), spec.num_agents, config.agent_range)
        position = jnp.where(bad[:, None], new, position)
        return position, overlapping(position), turn + 1

    def unfinished(carry: tuple[Array, Array, Array]) -> Array:
        return carry[1].any() & (carry[2] < ROUNDS)

    position, bad, _ = jax.lax.while_loop(unfinished, redraw, (position, overlapping(position), jnp.asarray(0)))
    return position, jnp.logical_not(bad.any())
