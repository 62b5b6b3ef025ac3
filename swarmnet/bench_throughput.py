"""Scenes a machine steps per second with everything on: random actions, contacts, fresh scenes at every reset."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp

from envs.config import SpawnConfig
from envs.swarm_env import SwarmEnv, scene_keys
from swarm_mjcf.spec import SceneSpec

AGENTS, OBSTACLES = 10, 5
EPISODE = 20
"""Control steps between resets."""
TIMESTEP = 0.01
"""Physics timestep [s]."""


@dataclass(frozen=True)
class Throughput:
    """One batch size: rates over whole episodes, resets included."""

    engine: str
    scenes: int
    substeps: int
    control_steps_per_second: float
    """Control steps of single scenes per second [1/s]; times `substeps` for physics steps."""
    compile_seconds: float
    contact_states: int
    """Agent-states in contact during the timed run: shows that bodies do collide."""
    saturated: int
    """Scene-states at which an engine's room for contacts was full, so that some may be missing."""
    peak_memory: int | None
    """Most device memory in use so far [bytes]; None where the device does not tell (CPUs)."""


def throughput_spec(substeps: int) -> SceneSpec:
    """10 agents and 5 obstacles; the spawning area is small, so that bodies meet."""
    return SceneSpec(num_agents=AGENTS, num_obstacles=OBSTACLES, dt=TIMESTEP * substeps, substeps=substeps, arena=60.0)


def bench_throughput(
    engines: tuple[str, ...], scenes: tuple[int, ...], substeps: tuple[int, ...], *, episodes: int, seed: int = 0
) -> Iterator[Throughput]:
    """Yields one row per engine, number of substeps and batch size."""
    spawn = SpawnConfig(goal_range=20.0, agent_range=40.0, obstacle_radius=7.0)
    for engine in engines:
        for k in substeps:
            env = SwarmEnv(throughput_spec(k), engine=engine, spawn=spawn, horizon=EPISODE)
            for batch in scenes:
                yield _measure(env, batch, episodes, seed)


def _measure(env: SwarmEnv, scenes: int, episodes: int, seed: int) -> Throughput:
    def episode(total, number):
        keys = jax.vmap(partial(jax.random.fold_in, data=number))(scene_keys(seed, range(scenes)))
        state, _ = env.spawn(keys)

        def step(carry, t):
            state, total = carry
            # Uniform in the square of the acceleration limit; the environment clips it to the disc.
            limit = env.spec.max_acceleration
            action = jax.random.uniform(
                jax.random.fold_in(keys[0], t), state.position.shape, minval=-limit, maxval=limit
            )
            transition = env.step(state, action)
            contacts = transition.contacts
            now = jnp.stack([(contacts.agent_states + contacts.obstacle_states).sum(), contacts.saturated.sum()])
            return (transition.state, total + now), None

        (_, total), _ = jax.lax.scan(step, (state, total), jnp.arange(EPISODE))
        return total, None

    def run(first):
        return jax.lax.scan(episode, jnp.zeros(2, jnp.int32), first + jnp.arange(episodes))[0]

    begun = time.perf_counter()
    compiled = jax.jit(run).lower(jnp.int32(0)).compile()
    compile_seconds = time.perf_counter() - begun
    jax.block_until_ready(compiled(jnp.int32(0)))
    begun = time.perf_counter()
    touched, saturated = jax.block_until_ready(compiled(jnp.int32(episodes)))
    seconds = time.perf_counter() - begun
    memory = jax.devices()[0].memory_stats()
    return Throughput(
        engine=env.engine.name,
        scenes=scenes,
        substeps=env.spec.substeps,
        control_steps_per_second=scenes * EPISODE * episodes / seconds,
        compile_seconds=compile_seconds,
        contact_states=int(touched),
        saturated=int(saturated),
        peak_memory=memory.get("peak_bytes_in_use") if memory else None,
    )
