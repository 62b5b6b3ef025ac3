"""PPO's speed: engine alone, rollout, update and whole iterations, beside what the arithmetic alone would take.

The floor is the floating-point operations of the networks of one env-step (one pass forward while acting; forward and
backward, three passes, in every epoch), as XLA counts them, by the machine's rate of matrix products measured in this
run; physics is in no floor. Every graph has the room of the largest: `floor` counts ghosts too, as they are computed
while acting, `lean_floor` only agents that are there, on which the update runs (their ghost senders are counted).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp

from envs.config import make_world, mixed
from envs.swarm_env import SwarmEnv, scene_keys
from gnn.checkpoint import Model
from gnn.config import PRESETS, ModelConfig
from gnn.decode import Integrator, network_init
from gnn.features import Scales
from gnn.freeze import frozen
from rl.actor_critic import swarm_actor_critic
from rl.collect import collect
from rl.config import PPOConfig
from rl.ppo import make_optimizer, make_samples, update
from rl.task import SwarmTask
from rl.train import make_learner
from swarmnet.arithmetic import matrix_rate, operations, seconds_of

SIZES: dict[str, ModelConfig] = {
    "thesis-ch5": PRESETS["thesis-ch5"],
    "published sizes": replace(PRESETS["thesis-ch5"], edge_hidden=(128,), message=128),
}
"""Networks: the preset, and that of the published code, whose edge functions have two layers of 128."""
PUBLISHED_RATE = 46.0
"""Env-steps per CPU-second of the author's PPO, learning included, on one core like the one it was measured on."""


@dataclass(frozen=True)
class Speed:
    """One network and number of scenes; env-steps are control steps of single scenes."""

    network: str
    scenes: int
    engine: float
    """Env-steps per second of physics and resets under random actions [1/s]."""
    rollout: float
    """With the policy [1/s]."""
    update: float
    """Env-steps learned from per second, without rolling out [1/s]."""
    training: float
    """Both, as trained [1/s]."""
    floor: float
    """What the arithmetic alone would allow [1/s]."""
    lean_floor: float
    """Without that of ghosts [1/s]."""
    operations: float
    """Floating-point operations of the networks per env-step [1]."""


def bench_rl(scenes: tuple[int, ...], *, engine: str = "auto", seed: int = 0) -> Iterator[Speed]:
    """1..5 agents and 0..3 obstacles in one batch, contacts on, 32 control steps between updates, 4 epochs."""
    rate = matrix_rate()
    for name, config in SIZES.items():
        for count in scenes:
            yield _measure(name, config, PPOConfig(scenes=count, steps=32, warmup=0, epochs=4, seed=seed), engine, rate)


def _measure(name: str, network: ModelConfig, config: PPOConfig, engine: str, rate: float) -> Speed:
    world = mixed(make_world("clear", num_agents=5, num_obstacles=3))
    env = SwarmEnv(world.scene, engine=engine, spawn=world.spawn, horizon=60)
    task, model = SwarmTask(env), untrained(env, network)
    actor = swarm_actor_critic(model, gamma=config.gamma, initial_std=config.initial_std)
    learner = make_learner(task, actor, config)
    state = learner.start()
    per_call = config.scenes * config.steps

    still = replace(actor, apply=lambda params, seen: _nothing(seen[1].agent))
    alone = jax.jit(lambda runner: collect(task, still, state["params"], runner, config, jnp.int32(0))[1].reward)
    rolled = jax.jit(lambda runner: collect(task, actor, state["params"], runner, config, jnp.int32(0)))
    _, rollout = rolled(state["runner"])
    samples = make_samples(rollout, rollout.mean, config)
    mask = frozen(state["params"], ())
    learned = jax.jit(
        lambda params: update(
            actor, make_optimizer(mask, config), params, state["optimizer"], samples, replace(config, target_kl=1e9),
            iteration=jnp.int32(0), mask=mask,
        )
    )  # fmt: skip
    seen = jax.tree.map(lambda x: x[0], rollout.observation)
    per_step = operations(actor.apply, state["params"], seen) / config.scenes * (1 + 3 * config.epochs)
    return Speed(
        network=name,
        scenes=config.scenes,
        engine=per_call / seconds_of(lambda: alone(state["runner"])),
        rollout=per_call / seconds_of(lambda: rolled(state["runner"])),
        update=per_call / seconds_of(lambda: learned(state["params"])),
        training=per_call / seconds_of(lambda: learner.iterate(state)),
        floor=rate / per_step,
        lean_floor=rate / per_step / float(samples.counts.mean()),
        operations=per_step,
    )


def untrained(env: SwarmEnv, config: ModelConfig) -> Model:
    """A network with random weights for the environment's scenes."""
    unit = jnp.ones((), jnp.float32)
    scales = Scales(
        centre=jnp.zeros(2, jnp.float32), position=40 * unit, velocity=5 * unit, acceleration=5 * unit,
        position_change=unit, velocity_change=unit,
    )  # fmt: skip
    task, spec = SwarmTask(env), env.spec
    state, _ = env.spawn(scene_keys(0, range(1)))
    nodes, graph = task.observe(state)
    params = network_init(config, scales)(jax.random.key(0), nodes[:, None], graph)
    integrator = Integrator(spec.dt, spec.substeps, spec.max_speed, spec.max_acceleration)
    return Model(config, scales, integrator, params, {"preset": "thesis-ch5"})


def _nothing(edges: jax.Array) -> tuple[jax.Array, jax.Array]:
    zero = jnp.zeros(edges.shape[:2], jnp.float32)
    return jnp.stack([zero, zero], axis=-1), zero
