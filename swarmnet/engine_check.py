"""Can this machine's engines be trusted? Contact flags against sphere geometry in float64, and against each other."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from envs.engines import make_engine
from envs.engines.engine import Engine
from envs.state import Contacts, State, make_state, park
from swarm_mjcf.spec import SceneSpec

BORDERLINE = 1e-4
"""Pairs whose surfaces are closer to touching than this [m] are borderline: float32 cannot tell."""
BATCH = 4096
SPEC = SceneSpec(num_agents=10, num_obstacles=2, dt=0.02, substeps=1, arena=30.0)
"""Dense enough that most scenes touch; one substep, so that the flags belong to the very state that is returned."""


@dataclass
class Verdict:
    """Counts over all scenes for one engine. A flag is (agent, what: other agents | obstacle k)."""

    flags: int = 0
    on: int = 0
    wrong: int = 0
    borderline: int = 0
    touching_scenes: int = 0
    scenes: int = 0


def random_scenes(rng: np.random.Generator, scenes: int, spec: SceneSpec = SPEC) -> tuple[State, np.ndarray]:
    """Dense random states of 1..N agents and 0..K obstacles, and accelerations (S, N, 2) [m/s^2]."""
    agents, obstacles = spec.num_agents, spec.num_obstacles

    def uniform(half: float, count: int) -> np.ndarray:
        return rng.uniform(-half, half, (scenes, count, 2)).astype(np.float32)

    state = make_state(
        position=jnp.asarray(uniform(spec.arena / 2, agents)),
        velocity=jnp.asarray(uniform(spec.max_speed / 2, agents)),
        goal=jnp.zeros((scenes, 2)),
        obstacle=jnp.asarray(uniform(spec.arena / 2, obstacles)),
        agent_present=jnp.asarray(np.arange(agents) < rng.integers(1, agents + 1, (scenes, 1))),
        obstacle_present=jnp.asarray(np.arange(obstacles) < rng.integers(0, obstacles + 1, (scenes, 1))),
    )
    acceleration = uniform(spec.max_acceleration / 2, agents) * np.asarray(state.agent_present)[..., None]
    return park(state, spec), acceleration


def gaps(state: State, spec: SceneSpec) -> tuple[np.ndarray, np.ndarray]:
    """Surface distances [m] in float64: agent to agent (S, N, N), inf on the diagonal; agent to obstacle (S, N, K)."""
    position, obstacle = np.asarray(state.position, np.float64), np.asarray(state.obstacle, np.float64)
    apart = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1) - 2 * spec.agent_radius
    apart[:, np.arange(spec.num_agents), np.arange(spec.num_agents)] = np.inf
    clear = np.linalg.norm(position[:, :, None] - obstacle[:, None], axis=-1)
    return apart, clear - spec.agent_radius - spec.obstacle_radius


def judge_flags(state: State, contacts: Contacts, spec: SceneSpec, verdict: Verdict) -> np.ndarray:
    """Adds one batch, after a single-substep control step, to `verdict`; returns its flags (S, N, 1 + K)."""
    to_agent, to_obstacle = gaps(state, spec)
    distances = np.concatenate([to_agent.min(axis=2)[..., None], to_obstacle], axis=-1)
    borderline = np.abs(distances) < BORDERLINE
    # With several neighbours, one just inside decides nothing when another is deep inside; only the nearest counts.
    flags = np.concatenate([np.asarray(state.touching_agent)[..., None], np.asarray(state.touching_obstacle)], axis=-1)
    counted = np.asarray(contacts.agent_states) > 0
    present = np.asarray(state.agent_present)[..., None]
    wrong = (flags != (distances < 0)) & ~borderline
    wrong[..., 0] |= flags[..., 0] != counted
    verdict.flags += int(present.sum()) * flags.shape[-1]
    verdict.on += int(flags.sum())
    verdict.wrong += int((wrong & present).sum() + (flags & ~present).sum())
    verdict.borderline += int((borderline & present).sum())
    verdict.touching_scenes += int(flags.any(axis=(1, 2)).sum())
    verdict.scenes += len(flags)
    return flags


@dataclass
class Comparison:
    """Two engines on the same scenes: flags that differ outside the borderline, and the largest position difference."""

    flags_apart: int = 0
    position_apart: float = 0.0


def check_engines(
    names: tuple[str, ...], scenes: int, *, seed: int = 0, progress: Callable[[int, int], None] | None = None
) -> tuple[dict[str, Verdict], dict[tuple[str, str], Comparison]]:
    """Steps every engine once on the same `scenes` random scenes and judges all flags."""
    engines: dict[str, Engine] = {name: make_engine(SPEC, name) for name in names}
    steps = {name: jax.jit(engine.step) for name, engine in engines.items()}
    verdicts = {name: Verdict() for name in names}
    comparisons = {(names[0], other): Comparison() for other in names[1:]}
    rng = np.random.default_rng(seed)
    for first in range(0, scenes, BATCH):
        state, acceleration = random_scenes(rng, BATCH)
        size = min(BATCH, scenes - first)
        after, flags = {}, {}
        for name, step in steps.items():
            result = jax.tree.map(lambda x, size=size: np.asarray(x)[:size], step(state, acceleration))
            after[name] = result[0]
            flags[name] = judge_flags(result[0], result[1], SPEC, verdicts[name])
        for (one, other), comparison in comparisons.items():
            distances = gaps(after[one], SPEC)
            near = np.concatenate([distances[0].min(axis=2)[..., None], distances[1]], axis=-1)
            apart = (flags[one] != flags[other]) & (np.abs(near) >= BORDERLINE)
            comparison.flags_apart += int(apart.sum())
            moved = np.abs(after[one].position - after[other].position).max()
            comparison.position_apart = max(comparison.position_apart, float(moved))
        if progress:
            progress(first + size, scenes)
    return verdicts, comparisons
