"""What `test_devices.py` runs in processes of their own: PPO on several devices, and with a partner.

python two_processes.py devices FOLDER             1, 2 and 4 devices of one process
python two_processes.py pair FOLDER HOST:PORT 0|1  one of two processes with a device each
"""

import logging
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import jax
import numpy as np
from learning import initial, scales, tiny

import rl.train
from envs.config import make_world
from envs.swarm_env import SwarmEnv
from gnn.checkpoint import Model
from gnn.decode import Integrator
from rl.actor_critic import swarm_actor_critic
from rl.config import MODES, PPOConfig
from rl.devices import SHARED, device_mesh, initialise
from rl.task import SwarmTask
from rl.train import make_learner
from swarm_mjcf.errors import SwarmError

CONFIG = PPOConfig(
    scenes=8,
    steps=4,
    iterations=2,
    warmup=0,
    epochs=2,
    minibatches=2,
    target_kl=10.0,
    imitation_weight=0.1,
    freeze=MODES[2],
    checkpoint_seconds=1e-9,
)
"""A checkpoint after each of two iterations; an anchor and frozen parts, so that all that a run may have is there."""


@cache
def task() -> SwarmTask:
    """Three agents and an obstacle in a small square, for three steps: contacts and fresh starts in every rollout."""
    world = make_world("clear", num_agents=3, num_obstacles=1)
    spawn = replace(world.spawn, agent_range=14.0, goal_range=5.0, clearance=1.0)
    return SwarmTask(SwarmEnv(world.scene, engine="native", spawn=spawn, horizon=3))


@cache
def model() -> Model:
    """Preset thesis-ch5 with few, random weights."""
    spec = task().env.spec
    integrator = Integrator(spec.dt, spec.substeps, spec.max_speed, spec.max_acceleration)
    few = replace(tiny("thesis-ch5"), edge_hidden=(8,), node_hidden=(8,))
    nodes, graph = jax.eval_shape(
        lambda keys: task().observe(task().start(keys)[0]), jax.random.split(jax.random.key(0))
    )
    params = initial(few, scales(), jax.ShapeDtypeStruct((2, 1, *nodes.shape[1:]), nodes.dtype), graph)
    return Model(few, scales(), integrator, params, {"preset": "thesis-ch5"})


def run(folder: Path, *iterations: int, devices: int | None = None) -> None:
    """Trains up to so many iterations, each time as if started anew."""
    for number in iterations:
        config = replace(CONFIG, iterations=number)
        rl.train.train(config, task(), model(), folder, mesh=device_mesh(devices))


def compile_once() -> None:
    """Every `train` makes functions of its own; from here on those for the same devices are made once."""
    made = {}

    def known(*given, mesh):
        if mesh not in made:
            made[mesh] = make_learner(*given, mesh=mesh)
        return made[mesh]

    rl.train.make_learner = known


def on_devices(folder: Path) -> None:
    """Runs on 1 and 4 devices; one that was stopped, and one that was moved from 4 devices to 1."""
    for devices in (1, 4):
        run(folder / str(devices), 2, devices=devices)
    run(folder / "stopped", 1, 2, devices=4)
    run(folder / "moved", 1, devices=4)
    run(folder / "moved", 2, devices=1)
    actor = swarm_actor_critic(model(), gamma=CONFIG.gamma, initial_std=CONFIG.initial_std)
    learner = rl.train.make_learner(task(), actor, CONFIG, mesh=device_mesh(4))
    state, _ = learner.iterate(learner.start())
    slots = {tuple(np.asarray(shard.data)) for shard in state.pop(SHARED).slot.addressable_shards}
    assert slots == {(0, 1), (2, 3), (4, 5), (6, 7)}, slots
    for leaf in jax.tree.leaves(state):
        copies = [np.asarray(shard.data) for shard in leaf.addressable_shards]
        assert len(copies) == 4
        for copy in copies:
            np.testing.assert_array_equal(copy, copies[0])
    refused(lambda: make_learner(task(), actor, replace(CONFIG, scenes=6), mesh=device_mesh(4)))
    refused(lambda: device_mesh(5))
    refused(lambda: initialise("127.0.0.1:1", 2, 1))


def refused(what: Callable) -> None:
    """Writes the error."""
    try:
        what()
    except SwarmError as error:
        print(f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    what, *given = sys.argv[1:]
    if what == "devices":
        compile_once()
        on_devices(Path(given[0]))
    else:
        initialise(given[1], 2, int(given[2]), patience=60)
        compile_once()
        run(Path(given[0]), 1, 2)
