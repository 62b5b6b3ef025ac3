"""Training speed: windows per second, the share of time in the compiled step, and one core against Keras.

The comparison trains the same sizes (thesis-ch3: Conv1D over 5 rows, edge functions and node function 64-64, batch 128,
one predicted step) on the same windows, each in a process of its own that is bound to one core. Beside it stands what
the core's rate of matrix products would allow for the gradient alone.
"""

import importlib
import importlib.util
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.config import SimulateConfig
from envs.simulate import simulate_in_memory
from envs.trajectories import Trajectories
from gnn.config import PRESETS, TrainConfig
from gnn.decode import network
from gnn.train import prepare, train_prepared
from gnn.windows import windows
from swarmnet.arithmetic import matrix_rate, operations

WINDOW, BATCH, WIDTH = 5, 128, 64
SCENES, SECONDS = 200, 10.0
"""Of the comparison: scenes to draw windows from, and how long each side trains."""

BOUND = """
import os, runpy
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
runpy.run_module("swarmnet.bench_train", run_name="__main__")
"""
"""Runs one side of the comparison. Bound before anything is imported, so that no library sees more than one core."""


@dataclass(frozen=True)
class TrainRate:
    """One measured training."""

    case: str
    windows_per_second: float
    """Windows learned from per second of wall time, without compilation [1/s]."""
    compiled_share: float | None = None
    """Share of the wall time inside the compiled chunks; the rest is validation, metrics, checkpoints and Python."""


def bench_loop(config: TrainConfig, trajectories: Trajectories) -> TrainRate:
    """A whole training, as `swarmnet train` does it, after everything has been compiled."""
    prepared = prepare(config, trajectories)
    state = prepared.start()
    for horizon in config.horizons:
        prepared.run_chunk(state, prepared.data, config.steps, horizon=horizon)
    jax.block_until_ready(prepared.measure(state["params"]))
    inside = 0.0

    def timed(*arguments, **options):
        nonlocal inside
        begun = time.perf_counter()
        result = jax.block_until_ready(prepared.run_chunk(*arguments, **options))
        inside += time.perf_counter() - begun
        return result

    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        train_prepared(replace(prepared, run_chunk=timed), folder)
        total = time.perf_counter() - begun
    return TrainRate(config.model, config.steps * config.batch / total, inside / total)


def bench_one_core(seed: int = 0) -> Iterator[TrainRate | str]:
    """What arithmetic allows, ours and Keras's on one core each. Where Keras is not installed, a line that says so."""
    for case in ("arithmetic", "swarmnet", "keras"):
        if case == "keras" and importlib.util.find_spec("keras") is None:
            yield "keras is not installed: `pip install tensorflow-cpu` to compare with it"
            return
        command = [sys.executable, "-c", BOUND, case, str(seed)]
        found = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        yield TrainRate(f"{case}, one core", float(json.loads(found.stdout.splitlines()[-1])))


def demonstrations(seed: int) -> Trajectories:
    """Published Boids for the comparison."""
    return simulate_in_memory(SimulateConfig(preset="published", scenes=SCENES, seed=seed))


def swarmnet_rate(trajectories: Trajectories) -> float:
    """Windows per second of preset thesis-ch3 at one predicted step."""
    config = TrainConfig(model="thesis-ch3", horizons=(1,), stage_steps=(100,), batch=BATCH)
    prepared = prepare(config, trajectories)
    state, chunks = prepared.start(), 0
    state, _, _ = jax.block_until_ready(prepared.run_chunk(state, prepared.data, config.steps, horizon=1))
    begun = time.perf_counter()
    while time.perf_counter() - begun < SECONDS:
        state, _, _ = jax.block_until_ready(prepared.run_chunk(state, prepared.data, config.steps, horizon=1))
        chunks += 1
    return chunks * config.chunk * BATCH / (time.perf_counter() - begun)


def arithmetic_rate(trajectories: Trajectories) -> float:
    """Windows per second at which the core would do the floating-point operations of the gradient, and nothing else."""
    model, prepared = PRESETS["thesis-ch3"], prepare(TrainConfig(model="thesis-ch3"), trajectories)
    params, zero = prepared.start()["params"], jnp.zeros(BATCH, jnp.int32)
    counts = trajectories.counts
    history, _, _, graph = windows(prepared.data, zero, zero, window=model.window, horizon=1, counts=counts)
    apply = network(model, prepared.scales)
    gradient = jax.grad(lambda params: jnp.sum(apply(params, history, graph) ** 2))
    return BATCH * matrix_rate() / operations(gradient, params)


def keras_rate(trajectories: Trajectories) -> float:
    """Windows per second of the same network in Keras, by `fit` on arrays in memory."""
    model, (history, after) = keras_model(trajectories.counts), windows_of(trajectories)
    model.compile(optimizer="adam", loss="mse")

    def epoch(count: int) -> None:
        model.fit(history[:count], after[:count], batch_size=BATCH, epochs=1, verbose=0)

    epoch(2 * BATCH)  # traces and compiles
    done, begun = 0, time.perf_counter()
    count = len(history) // BATCH * BATCH
    while time.perf_counter() - begun < SECONDS:
        epoch(count)
        done += count
    return done / (time.perf_counter() - begun)


def windows_of(trajectories: Trajectories) -> tuple[np.ndarray, np.ndarray]:
    """Every history of 5 rows (n, 5, V, 4) and the row that follows it (n, V, 4)."""
    states = np.concatenate([trajectories.position, trajectories.velocity], axis=-1)
    starts = range(states.shape[1] - WINDOW)
    history = np.concatenate([states[:, start : start + WINDOW] for start in starts])
    return history, np.concatenate([states[:, start + WINDOW] for start in starts])


def keras_model(counts: tuple[int, int, int]) -> Any:
    """Chapter 3 in Keras: Conv1D over each node's rows, an edge MLP for each type, sum, psi, node function, change."""
    keras: Any = importlib.import_module("keras")  # in no extra of ours
    layers, ops = keras.layers, keras.ops
    goals, obstacles, agents = counts
    first, nodes = goals + obstacles, sum(counts)

    def mlp(sizes: tuple[int, ...], out: int) -> Any:
        return keras.Sequential([*(layers.Dense(size, activation="relu") for size in sizes), layers.Dense(out)])

    history = keras.Input((WINDOW, nodes, 4))
    rows = ops.reshape(ops.transpose(history, (0, 2, 1, 3)), (-1, WINDOW, 4))
    for filters in (32, WIDTH):
        rows = layers.Conv1D(filters, 3, activation="relu")(rows)
    state = ops.reshape(rows, (-1, nodes, WIDTH))
    receivers, total = state[:, first:], 0
    for begin, end in ((0, goals), (goals, first), (first, nodes)):
        count = end - begin
        if not count:
            continue
        to = ops.repeat(receivers[:, :, None], count, axis=2)
        of = ops.repeat(state[:, None, begin:end], agents, axis=1)
        message = mlp((WIDTH, WIDTH), WIDTH)(ops.concatenate([to, of], axis=-1))
        heard = 1 - np.eye(agents) if begin == first else np.ones((agents, count))
        total = total + ops.sum(message * heard[..., None].astype("float32"), axis=2)
    total = ops.concatenate([ops.zeros_like(state[:, :first]), total], axis=1)
    total = mlp((WIDTH,), WIDTH)(total)
    hidden = ops.concatenate([state, total], axis=-1)
    for _ in range(2):
        hidden = layers.Dense(WIDTH, activation="relu")(hidden)
    return keras.Model(history, history[:, -1] + layers.Dense(4)(hidden))


if __name__ == "__main__":
    rate = {"arithmetic": arithmetic_rate, "swarmnet": swarmnet_rate, "keras": keras_rate}[sys.argv[1]]
    print(json.dumps(rate(demonstrations(int(sys.argv[2])))))
