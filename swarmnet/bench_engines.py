"""Scene-steps per second of the engines, as ratios to a bare `mujoco.batch` of the exported scene with its sensors.

The native engine steps a leaner model (`compile_physics`): nothing to draw, no stages without elements. How much of its
rate is due to that, the case `bare, lean` says: a bare batch of that model, sensors on.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch

from envs.config import clear
from envs.dynamics import limited
from envs.engines import make_engine
from envs.engines.engine import Engine
from envs.experts.registry import make_expert
from envs.state import State, make_state
from gnn.config import PRESETS
from gnn.decode import make_policy
from gnn.features import Scales
from gnn.graph import graph_of_state
from gnn.swarmnet import SwarmNet
from swarm_mjcf.build import compile_physics, compile_scene
from swarm_mjcf.index import SceneIndex
from swarm_mjcf.spec import SceneSpec

TIMESTEP = 0.01
"""Physics timestep [s]."""
SECONDS = 0.4
"""Aimed length of one timed run."""


@dataclass(frozen=True)
class Rate:
    """One cell: median scene-steps/s, and its ratio to the bare batch (median of ratios taken pair by pair)."""

    case: str
    agents: int
    substeps: int
    scenes: int
    per_second: float
    ratio: float


def bench_spec(agents: int, substeps: int) -> SceneSpec:
    """A scene of equal density for every size above 20 agents, 1 obstacle."""
    arena = 100.0 * max(1.0, (agents / 20) ** 0.5)
    return SceneSpec(num_agents=agents, dt=TIMESTEP * substeps, substeps=substeps, arena=arena)


def _start(spec: SceneSpec, scenes: int) -> State:
    rng = np.random.default_rng(0)
    shape = (scenes, spec.num_agents, 2)
    return jax.tree.map(
        jnp.asarray,
        make_state(
            position=rng.uniform(-0.8 * spec.arena, 0.8 * spec.arena, shape).astype(np.float32),
            velocity=rng.uniform(-7, 7, shape).astype(np.float32),
            goal=np.zeros((scenes, 2), np.float32),
            obstacle=rng.uniform(-20, 20, (scenes, 1, 2)).astype(np.float32),
        ),
    )


def _bare(spec: SceneSpec, start: State, compiled: Callable[[SceneSpec], mujoco.MjModel]) -> Callable[[int], None]:
    model = compiled(spec)
    index, scenes = SceneIndex.of(model, spec), start.position.shape[0]
    batch = Batch(model, scenes)
    batch.bind("sensordata")

    def run(steps: int) -> None:
        batch.qpos[:, index.qpos] = np.asarray(start.position).reshape(scenes, -1)
        batch.qvel[:, index.dof] = np.asarray(start.velocity).reshape(scenes, -1)
        batch.mocap_pos[:, index.obstacle_mocap, :2] = np.asarray(start.obstacle)
        for _ in range(steps):
            batch.step(nstep=spec.substeps)

    return run


def _loop(engine: Engine, start: State, policy) -> Callable[[int], None]:
    def step(state: State, _: None):
        if policy is None:
            acceleration = jnp.zeros_like(state.position)
        else:
            acceleration = limited(state.velocity, policy(state), engine.spec)
        state, contacts = engine.step(state, acceleration)
        return state, contacts.agent_states.sum()

    compiled = jax.jit(lambda state, steps: jax.lax.scan(step, state, None, length=steps), static_argnums=1)
    return lambda steps: jax.block_until_ready(compiled(start, steps))


def _swarmnet(spec: SceneSpec, start: State):
    config, scales = PRESETS["best"], Scales.ones()
    small = jax.tree.map(lambda x: x[:1, ...], start)
    nodes, graph = graph_of_state(small, goal=True)
    params = SwarmNet(config, scales).init(jax.random.key(0), nodes[:, None], graph)["params"]
    policy = make_policy(config, scales)
    return lambda state: policy(state, params)


def bench_engines(agents: tuple[int, ...], substeps: tuple[int, ...], *, repeats: int) -> Iterator[Rate | str]:
    """Yields the cells, row by row; a string says why a cell was left out."""
    for count in agents:
        for k in substeps:
            spec = bench_spec(count, k)
            scenes = int(np.clip(20480 // count, 16, 2048))
            start = _start(spec, scenes)
            native = make_engine(spec, "native")
            expert = make_expert(replace(clear().expert, arena=spec.arena))
            yield from _case(
                {
                    "bare": _bare(spec, start, compile_scene),
                    "bare, lean": _bare(spec, start, compile_physics),
                    "native": _loop(native, start, None),
                    "native + boids": _loop(native, start, expert),
                },
                (count, k, scenes, repeats),
            )
            # Dense messages between 1000 agents are a million per scene: fewer scenes, with a bare batch of their own.
            few = min(scenes, max(2, 200_000 // count**2))
            part = _start(spec, few)
            cases = {
                "bare": _bare(spec, part, compile_scene),
                "native + swarmnet": _loop(native, part, _swarmnet(spec, part)),
            }
            yield from (rate for rate in _case(cases, (count, k, few, repeats)) if rate.case != "bare")
            on_cpu = jax.default_backend() == "cpu"
            if count > (100 if on_cpu else 200):
                yield f"mjx, {count} agents, {k} substeps: left out, it visits all {count * (count + 1) // 2} pairs"
                continue
            few = min(scenes, max(2, 2048 * 25 // count**2)) if on_cpu else scenes
            part = _start(spec, few)
            cases = {"bare": _bare(spec, part, compile_scene), "mjx": _loop(make_engine(spec, "mjx"), part, None)}
            yield from (rate for rate in _case(cases, (count, k, few, repeats)) if rate.case != "bare")


def _case(runs: dict[str, Callable[[int], None]], shape: tuple[int, int, int, int]) -> Iterator[Rate]:
    """Times the runs in turn, A B C A B C ..., each for about `SECONDS`; the others are divided by the first."""
    count, k, scenes, repeats = shape
    steps = {}
    for name, run in runs.items():
        run(2)
        begun = time.perf_counter()
        run(2)
        steps[name] = int(np.clip(round(2 * SECONDS / (time.perf_counter() - begun)), 2, 400))
        run(steps[name])  # compiles for this length
    rates = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            begun = time.perf_counter()
            run(steps[name])
            rates[name].append(scenes * steps[name] / (time.perf_counter() - begun))
    base = np.asarray(next(iter(rates.values())))
    for name, values in rates.items():
        yield Rate(name, count, k, scenes, float(np.median(values)), float(np.median(np.asarray(values) / base)))
