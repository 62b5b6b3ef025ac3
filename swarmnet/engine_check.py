"""Can this machine's engines be trusted? Contact flags against sphere geometry in float64, and against each other."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from envs.engines import make_engine
from envs.state import Contacts, State, make_state, park
from swarm_mjcf.spec import SceneSpec

BORDERLINE = 1e-4
"""Pairs whose surfaces are closer to touching than this [m] are borderline: float32 cannot tell."""
BATCH = 4096
SPEC = SceneSpec(num_agents=10, num_obstacles=2, dt=0.02, substeps=1, arena=16.0, walls=True)
"""Dense enough that most scenes touch; one substep, so that the flags belong to the very state that is returned."""
SUBSTEPS = 4
"""Of the control steps whose counts are checked."""
COUNTED = 10
"""One scene in so many has its counts checked, which takes `SUBSTEPS` single steps beside the one of as many."""
DRIFT = 1e-3
"""Borderline of counts [m]: in several substeps the rounding of states in between grows where bodies are pressed."""


@dataclass
class Verdict:
    """Counts over all scenes for one engine. A flag is (agent, what: other agents | walls | obstacle k)."""

    flags: int = 0
    on: int = 0
    wrong: int = 0
    borderline: int = 0
    touching_scenes: int = 0
    scenes: int = 0
    counts: int = 0
    """Contact counts of control steps of `SUBSTEPS` substeps: (agent, field of `COUNTS`)."""
    wrong_counts: int = 0
    borderline_counts: int = 0


COUNTS = ("agent_states", "wall_states", "obstacle_states", "agent_events", "wall_events", "obstacle_events")


def random_scenes(rng: np.random.Generator, scenes: int, spec: SceneSpec = SPEC) -> tuple[State, np.ndarray]:
    """Dense random states of 1..N agents and 0..K obstacles, and accelerations (S, N, 2) [m/s^2]. Centres are anywhere
    in the arena, so that some agents are pressed into its walls."""
    agents, obstacles = spec.num_agents, spec.num_obstacles

    def uniform(half: float, count: int) -> np.ndarray:
        return rng.uniform(-half, half, (scenes, count, 2)).astype(np.float32)

    state = make_state(
        position=jnp.asarray(uniform(spec.arena, agents)),
        velocity=jnp.asarray(uniform(spec.max_speed / 2, agents)),
        goal=jnp.zeros((scenes, 2)),
        obstacle=jnp.asarray(uniform(spec.arena, obstacles)),
        agent_present=jnp.asarray(np.arange(agents) < rng.integers(1, agents + 1, (scenes, 1))),
        obstacle_present=jnp.asarray(np.arange(obstacles) < rng.integers(0, obstacles + 1, (scenes, 1))),
    )
    acceleration = uniform(spec.max_acceleration / 2, agents) * np.asarray(state.agent_present)[..., None]
    return park(state, spec), acceleration


def gaps(state: State, spec: SceneSpec) -> np.ndarray:
    """Surface distances [m] in float64 of each agent to what is nearest of the other agents, to the nearest wall (inf
    without walls) and to every obstacle: (S, N, 2 + K). With several neighbours, one just inside decides nothing when
    another is deep inside; only the nearest counts."""
    position, obstacle = np.asarray(state.position, np.float64), np.asarray(state.obstacle, np.float64)
    apart = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1) - 2 * spec.agent_radius
    apart[:, np.arange(spec.num_agents), np.arange(spec.num_agents)] = np.inf
    inside = spec.arena - np.abs(position).max(axis=-1) if spec.walls else np.full(position.shape[:2], np.inf)
    clear = np.linalg.norm(position[:, :, None] - obstacle[:, None], axis=-1) - spec.obstacle_radius
    alone = np.stack([apart.min(axis=2), inside - spec.agent_radius], axis=-1)
    return np.concatenate([alone, clear - spec.agent_radius], axis=-1)


def judge_flags(state: State, contacts: Contacts, spec: SceneSpec, verdict: Verdict) -> np.ndarray:
    """Adds one batch, after a single-substep control step, to `verdict`; returns its flags (S, N, 2 + K)."""
    distances = gaps(state, spec)
    borderline = np.abs(distances) < BORDERLINE
    of_agents, of_walls, of_obstacles = (
        np.asarray(flag) for flag in (state.touching_agent, state.touching_wall, state.touching_obstacle)
    )
    flags = np.concatenate([of_agents[..., None], of_walls[..., None], of_obstacles], axis=-1)
    present = np.asarray(state.agent_present)[..., None]
    wrong = (flags != (distances < 0)) & ~borderline
    for column, counted in enumerate((contacts.agent_states, contacts.wall_states)):
        wrong[..., column] |= flags[..., column] != (np.asarray(counted) > 0)
    verdict.flags += int(present.sum()) * flags.shape[-1]
    verdict.on += int(flags.sum())
    verdict.wrong += int((wrong & present).sum() + (flags & ~present).sum())
    verdict.borderline += int((borderline & present).sum())
    verdict.touching_scenes += int(flags.any(axis=(1, 2)).sum())
    verdict.scenes += len(flags)
    return flags


Step = Callable[[State, np.ndarray], tuple[State, Contacts]]


def judge_counts(
    one: Step, several: Step, state: State, acceleration: np.ndarray, spec: SceneSpec, verdict: Verdict
) -> None:
    """Adds what `several` counts in a control step of `SUBSTEPS` substeps, against as many steps of `one` substep."""
    found = several(state, acceleration)[1]
    expected = {name: 0 for name in COUNTS}
    borderline = np.zeros(np.shape(state.agent_present), bool)
    for _ in range(SUBSTEPS):
        state, contacts = one(state, acceleration)
        expected = {name: total + np.asarray(getattr(contacts, name)) for name, total in expected.items()}
        borderline |= (np.abs(gaps(state, spec)) < DRIFT).any(axis=-1)
    present = np.asarray(state.agent_present)
    for name, total in expected.items():
        verdict.wrong_counts += int(((np.asarray(getattr(found, name)) != total) & present & ~borderline).sum())
    verdict.counts += int(present.sum()) * len(COUNTS)
    verdict.borderline_counts += int((borderline & present).sum()) * len(COUNTS)


@dataclass
class Comparison:
    """Two engines on the same scenes: flags that differ outside the borderline, and the largest position difference."""

    flags_apart: int = 0
    position_apart: float = 0.0


def check_engines(
    names: tuple[str, ...], scenes: int, *, seed: int = 0, progress: Callable[[int, int], None] | None = None
) -> tuple[dict[str, Verdict], dict[tuple[str, str], Comparison]]:
    """Steps every engine once on the same `scenes` random scenes and judges all flags, and the counts of every
    `COUNTED`th scene over several substeps."""
    longer = replace(SPEC, dt=SUBSTEPS * SPEC.dt, substeps=SUBSTEPS)
    one, several = ({name: jax.jit(make_engine(spec, name).step) for name in names} for spec in (SPEC, longer))
    verdicts = {name: Verdict() for name in names}
    comparisons = {(names[0], other): Comparison() for other in names[1:]}
    rng = np.random.default_rng(seed)
    for first in range(0, scenes, BATCH):
        state, acceleration = random_scenes(rng, BATCH)
        size = min(BATCH, scenes - first)
        after, flags = {}, {}
        for name, step in one.items():
            result = jax.tree.map(lambda x, size=size: np.asarray(x)[:size], step(state, acceleration))
            after[name] = result[0]
            flags[name] = judge_flags(result[0], result[1], SPEC, verdicts[name])
            part = jax.tree.map(lambda x: x[: BATCH // COUNTED], state)
            judge_counts(step, several[name], part, acceleration[: BATCH // COUNTED], SPEC, verdicts[name])
        for (mine, other), comparison in comparisons.items():
            apart = (flags[mine] != flags[other]) & (np.abs(gaps(after[mine], SPEC)) >= BORDERLINE)
            comparison.flags_apart += int(apart.sum())
            moved = np.abs(after[mine].position - after[other].position).max()
            comparison.position_apart = max(comparison.position_apart, float(moved))
        if progress:
            progress(first + size, scenes)
    return verdicts, comparisons
