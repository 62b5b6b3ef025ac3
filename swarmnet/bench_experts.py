"""Scene-steps per second of the experts, their cost per agent relative to N = 100, and ours against plain NumPy."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from envs.dynamics import free_flight, limited
from envs.experts.chaser import draw_targets
from envs.experts.config import BoidsConfig, ChaserConfig, ExpertConfig, HelbingConfig, Interaction, VicsekConfig
from envs.experts.registry import make_expert
from envs.state import State, make_state
from envs.swarm_env import scene_keys
from swarm_mjcf.spec import SceneSpec
from swarmnet.numpy_boids import numpy_boids

DT = 0.01
"""Control step [s]: short, so that a scene keeps its density while it is timed."""
SECONDS = 0.3
"""Aimed length of one timed run."""
TARGETS = 5
"""Targets of each chaser."""
INTERACTIONS = {
    "full": Interaction(),
    "radius 30": Interaction(radius=30.0),
    "nearest 8": Interaction(nearest=8),
}
REFERENCE = "boids in NumPy"


@dataclass(frozen=True)
class ExpertRate:
    """One cell; ratios are medians of ratios taken run by run."""

    expert: str
    interaction: str
    agents: int
    scenes: int
    per_second: float
    """Scene-steps per second: the law, limits and free flight, in a compiled scan."""
    cost_per_agent: float
    """Time per agent and step, relative to that at N = 100; NaN if that was not measured."""
    numpy_ratio: float
    """Scene-steps per second relative to the same law in plain NumPy, scene by scene; NaN for other laws."""


def bench_experts(agents: tuple[int, ...] = (5, 20, 100, 1000), *, repeats: int = 5) -> Iterator[ExpertRate]:
    """Yields the cells, expert by expert; the sizes of one expert and interaction are timed in turn."""
    yield from _case(REFERENCE, "full", {n: (1, _numpy(_start(n, 1))) for n in agents}, {}, repeats)
    for name, config in _experts().items():
        for seen, interaction in INTERACTIONS.items():
            runs, references = {}, {}
            for count in agents:
                scenes = _scenes(count)
                start = _start(count, scenes)
                expert = replace(config, interaction=interaction)
                runs[count] = (scenes, _loop(expert, start))
                if isinstance(expert, BoidsConfig):
                    one = jax.tree.map(lambda leaf: leaf[:1, ...], start)
                    references[count] = _numpy(one, expert)
            yield from _case(name, seen, runs, references, repeats)


def _experts() -> dict[str, ExpertConfig]:
    return {
        "boids": BoidsConfig(),
        "helbing": HelbingConfig(),
        "chaser": ChaserConfig(),
        "vicsek": VicsekConfig(dt=DT),
    }


def _scenes(agents: int) -> int:
    return int(np.clip(20480 // agents, 16, 1024))


def _start(agents: int, scenes: int) -> State:
    """Agents spread at equal density for every size above 20, one obstacle, and targets for the chasers."""
    half = 80.0 * max(1.0, (agents / 20) ** 0.5)
    rng = np.random.default_rng(0)
    present = jnp.ones((scenes, agents), bool)
    draw = partial(draw_targets, targets=min(TARGETS, agents - 1), assignment="fixed")
    state = make_state(
        position=rng.uniform(-half, half, (scenes, agents, 2)).astype(np.float32),
        velocity=rng.uniform(-7, 7, (scenes, agents, 2)).astype(np.float32),
        goal=np.zeros((scenes, 2), np.float32),
        obstacle=rng.uniform(-20, 20, (scenes, 1, 2)).astype(np.float32),
        target=jax.jit(jax.vmap(draw))(scene_keys(0, range(scenes)), present),
    )
    return jax.tree.map(jnp.asarray, state)


def _loop(config: ExpertConfig, start: State) -> Callable[[int], None]:
    scenes, agents, _ = start.position.shape
    policy, keys = make_expert(config), scene_keys(0, range(scenes))
    spec = SceneSpec(num_agents=agents, dt=DT, substeps=1, contacts=False)

    def step(state: State, t: jax.Array) -> tuple[State, None]:
        step_keys = jax.vmap(partial(jax.random.fold_in, data=t))(keys)
        acceleration = limited(state.velocity, policy(state, None, step_keys), spec)
        position, velocity = free_flight(state.position, state.velocity, acceleration, spec)
        return replace(state, position=position, velocity=velocity), None

    compiled = jax.jit(lambda state, steps: jax.lax.scan(step, state, jnp.arange(steps))[0], static_argnums=1)
    return lambda steps: jax.block_until_ready(compiled(start, steps))


def _numpy(start: State, config: BoidsConfig | None = None) -> Callable[[int], None]:
    """One scene in float64, as people write it."""
    config = BoidsConfig() if config is None else config
    position, velocity = (np.asarray(x[0], np.float64) for x in (start.position, start.velocity))
    goal, obstacle = (np.asarray(x[0], np.float64) for x in (start.goal, start.obstacle))

    def run(steps: int) -> None:
        x, v = position, velocity
        for _ in range(steps):
            v = v + DT * numpy_boids(config, position=x, velocity=v, goal=goal, obstacle=obstacle)
            x = x + DT * v

    return run


def _case(
    expert: str,
    interaction: str,
    runs: dict[int, tuple[int, Callable[[int], None]]],
    references: dict[int, Callable[[int], None]],
    repeats: int,
) -> Iterator[ExpertRate]:
    """Times all sizes and their references in turn, A B C A B C ..., each for about `SECONDS`."""
    timed = {("ours", n): run for n, (_, run) in runs.items()} | {("numpy", n): run for n, run in references.items()}
    steps = {key: _steps(run) for key, run in timed.items()}
    seconds = {key: [] for key in timed}  # per scene and step
    for _ in range(repeats):
        for (kind, n), run in timed.items():
            begun = time.perf_counter()
            run(steps[kind, n])
            scenes = runs[n][0] if kind == "ours" else 1
            seconds[kind, n].append((time.perf_counter() - begun) / steps[kind, n] / scenes)
    for n, (scenes, _) in runs.items():
        ours = np.asarray(seconds["ours", n])
        base = np.asarray(seconds.get(("ours", 100), [np.nan] * repeats))
        reference = np.asarray(seconds.get(("numpy", n), [np.nan] * repeats))
        yield ExpertRate(
            expert,
            interaction,
            n,
            scenes,
            per_second=float(np.median(1 / ours)),
            cost_per_agent=float(np.median((ours / n) / (base / 100))),
            numpy_ratio=float(np.median(reference / ours)),
        )


def _steps(run: Callable[[int], None]) -> int:
    """How many steps fill `SECONDS`; they are compiled here."""
    run(2)
    begun = time.perf_counter()
    run(2)
    steps = int(np.clip(round(2 * SECONDS / (time.perf_counter() - begun)), 2, 400))
    run(steps)
    return steps
