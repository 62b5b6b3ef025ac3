"""Starting states, one key per scene, so that a scene depends on its own key and on nothing else in the batch."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Key

from envs.config import SpawnConfig
from envs.experts.chaser import draw_targets
from envs.record import Array
from envs.starts import FAMILY, Keys, Redraw, check_family, direction
from envs.state import State, make_state, park
from swarm_mjcf.errors import SpecError, SwarmError
from swarm_mjcf.spec import SceneSpec

ROUNDS = 200
"""Times that overlapping bodies of a scene are drawn anew before the scene counts as too dense."""
_DRIFT, _GAPS, _TARGETS = 6, 7, 8
"""Numbers of the keys for obstacles' velocities and redrawn places and for targets, after the six of the split."""
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
    if config.obstacle_speed and not spec.moving_obstacles:
        raise SpecError("obstacle_speed", config.obstacle_speed, "0 in a scene without moving_obstacles")
    if spec.contacts and config.obstacle_speed > spec.max_speed:
        raise SpecError("obstacle_speed", config.obstacle_speed, f"at most max_speed = {spec.max_speed} m/s")
    check_family(spec, config)
    _, half, agents = _square(spec, config)
    disc = math.pi * (spec.agent_radius + config.clearance / 2) ** 2
    share = agents * disc / max(2 * half, 1e-9) ** 2
    if not config.overlap and agents > 1 and share > JAMMING and config.family != "circle":
        raise _too_dense(spec, config, f"they would fill {share:.0%} of it, {JAMMING:.0%} is the most", 1, 1)


def too_dense(spec: SceneSpec, config: SpawnConfig, failed: int, scenes: int) -> SpawnError:
    """The error for scenes in which some body found no room in `ROUNDS` draws."""
    return _too_dense(spec, config, f"{failed} of {scenes} scenes found no room in {ROUNDS} draws", failed, scenes)


def _too_dense(spec: SceneSpec, config: SpawnConfig, why: str, failed: int, scenes: int) -> SpawnError:
    name, half, agents = _square(spec, config)
    gap = "" if config.obstacle_gap is None else f", or obstacles with gaps of {config.obstacle_gap} m,"
    less = "clearance" if config.obstacle_gap is None else "clearance or obstacle_gap"
    place = {"published": f"into [-{half}, {half}]^2 m", "circle": f"onto a circle of radius {half} m"}.get(
        config.family, f"into a group's square of {2 * half} m"
    )
    return SpawnError(
        f"too dense: {agents} agents of radius {spec.agent_radius} m with {config.clearance} m between them{gap} "
        f"do not fit {place} ({why}); take fewer or smaller agents, less {less}, or a larger {name}",
        failed=failed,
        scenes=scenes,
    )


def _square(spec: SceneSpec, config: SpawnConfig) -> tuple[str, float, int]:
    """The field that says how large the square is in which agents start, its half-width [m], and how many share it."""
    if config.family == "published":
        return "agent_range", config.agent_range, spec.num_agents
    groups = 2 if config.family == "crossing" else 1
    return "start_range", config.start_range, -(-spec.num_agents // groups)


def spawn(keys: Key[Array, " S"], spec: SceneSpec, config: SpawnConfig) -> tuple[State, Bool[Array, " S"]]:
    """Starting states and whether each found room; pure, callable inside `jit`. Absent bodies are parked."""
    family = FAMILY[config.family]

    def scene(key: Key[Array, ""]):
        k_goal, k_agents, k_velocity, k_obstacles, k_counts, k_rounds = jax.random.split(key, 6)
        present, obstacle_present = _composition(k_counts, spec, config)
        start, redraw_agents, redraw_obstacles = family(
            Keys(k_goal, k_agents, k_velocity, k_obstacles), present, spec, config
        )
        position, obstacle, found = start.position, start.obstacle, jnp.asarray(True)
        if redraw_obstacles and config.obstacle_gap is not None and spec.num_obstacles > 1:
            close = _close(obstacle_present, 2 * spec.obstacle_radius + config.obstacle_gap)
            k_gaps = jax.random.fold_in(key, _GAPS)
            obstacle, found = _apart(k_gaps, obstacle, close, redraw_obstacles, widen=config.agent_range)
        if not config.overlap:
            close = _close(present, 2 * spec.agent_radius + config.clearance)
            reach = spec.agent_radius + spec.obstacle_radius + config.clearance

            def in_the_way(position: Array) -> Bool[Array, " N"]:
                apart = jnp.sum((position[:, None] - obstacle[None]) ** 2, axis=-1)
                inside = (apart < reach**2) & obstacle_present
                return present & (close(position) | inside.any(axis=1))

            position, ok = _apart(k_rounds, position, in_the_way, redraw_agents)
            found &= ok
        target = draw_targets(jax.random.fold_in(key, _TARGETS), present, config.targets, config.assignment)
        drift = jnp.zeros_like(obstacle)
        if config.obstacle_speed:
            each = jax.random.split(jax.random.fold_in(key, _DRIFT), spec.num_obstacles)
            drift = config.obstacle_speed * jax.vmap(direction)(each)
        return position, start.velocity, start.goal, obstacle, drift, target, present, obstacle_present, found

    position, velocity, goal, obstacle, drift, target, present, obstacle_present, found = jax.vmap(scene)(keys)
    state = make_state(
        position=position,
        velocity=velocity,
        goal=goal,
        obstacle=obstacle,
        obstacle_velocity=drift,
        target=target,
        agent_present=present,
        obstacle_present=obstacle_present,
    )
    return park(state, spec), found


def _composition(key: Key[Array, ""], spec: SceneSpec, config: SpawnConfig) -> tuple[Array, Array]:
    k_agents, k_obstacles = jax.random.split(key)

    def draw(key: Key[Array, ""], low: int | None, high: int) -> Array:
        count = high if low is None else jax.random.randint(key, (), low, high + 1)
        return jnp.arange(high) < count

    return draw(k_agents, config.min_agents, spec.num_agents), draw(
        k_obstacles, config.min_obstacles, spec.num_obstacles
    )


def _close(present: Array, reach: float) -> Callable[[Array], Bool[Array, " n"]]:
    """Which of some bodies have their centre within `reach` [m] of another of lower index."""
    earlier = jnp.tril(jnp.ones((len(present), len(present)), bool), -1)

    def close(place: Array) -> Bool[Array, " n"]:
        apart = jnp.sum((place[:, None] - place[None]) ** 2, axis=-1)
        return present & ((apart < reach**2) & earlier & present).any(axis=1)

    return close


def _apart(
    key: Key[Array, ""],
    place: Array,
    misplaced: Callable[[Array], Bool[Array, " n"]],
    draw: Redraw,
    *,
    widen: float = 0.0,
) -> tuple[Array, Bool[Array, ""]]:
    """Draws the misplaced anew, at most `ROUNDS` times, in a region that grows by up to `widen` [m] on the way."""

    def redraw(carry: tuple[Array, Array, Array]):
        place, bad, turn = carry
        new = draw(jax.random.fold_in(key, turn), widen * turn / ROUNDS)
        place = jnp.where(bad[:, None], new, place)
        return place, misplaced(place), turn + 1

    def unfinished(carry: tuple[Array, Array, Array]) -> Array:
        return carry[1].any() & (carry[2] < ROUNDS)

    place, bad, _ = jax.lax.while_loop(unfinished, redraw, (place, misplaced(place), jnp.asarray(0)))
    return place, jnp.logical_not(bad.any())
