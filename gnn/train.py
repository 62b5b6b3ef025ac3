"""Imitation: a curriculum of horizons in fixed compiled chunks, resumable to the bit.

Everything random at gradient step n is drawn from (seed, n), and training stops only between chunks that are aligned to
the global step, so weights, optimizer and n are the full state: a continued run does what an uninterrupted one would.
"""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Key

from envs.plain import plain
from envs.record import Array
from envs.trajectories import Trajectories
from gnn.checkpoint import CheckpointError, Checkpoints, Model, describe
from gnn.config import TrainConfig, model_preset
from gnn.decode import Integrator, Predict, make_predict
from gnn.evaluate import natural_change
from gnn.features import Scales
from gnn.graph import Graph
from gnn.losses import multi_step_loss
from gnn.metrics import Metrics
from gnn.swarmnet import SwarmNet
from gnn.windows import Dataset, check_rows, windows
from swarm_mjcf.errors import SwarmError

Progress = Callable[[int, int, dict], None]
"""Called with (steps done, steps in all, metrics of the chunk)."""
VALIDATION_WINDOWS = 256


class TrainError(SwarmError):
    """Training cannot go on: the loss is not finite. The last good checkpoint stays."""


def train(
    config: TrainConfig,
    trajectories: Trajectories,
    folder: str | Path,
    *,
    validation: Trajectories | None = None,
    progress: Progress | None = None,
) -> Model:
    """Trains in `folder` (checkpoints/, metrics.jsonl, tensorboard/) or goes on from its newest checkpoint.

    Raises TrajectoryError for trajectories too short, CheckpointError for a folder of other settings or data,
    TrainError when the loss diverges.
    """
    folder, preset = Path(folder), model_preset(config.model)
    check_rows(trajectories, preset.window + max(config.horizons), f"a horizon of {max(config.horizons)} steps")
    if validation is not None:
        check_rows(validation, preset.window + max(config.horizons), f"a validation of {max(config.horizons)} steps")
    scales = Scales.of(trajectories) if preset.normalise else _loss_scales(trajectories)
    integrator = Integrator(
        trajectories.dt, trajectories.substeps, trajectories.max_speed, trajectories.max_acceleration
    )
    about = {
        "preset": config.model,
        "train": plain(config) | {"checkpoint_seconds": None},  # how often to save changes nothing else
        "data": {"scenes": len(trajectories), **trajectories.provenance},
        **describe(preset, scales, integrator),
    }
    predict = make_predict(preset, scales, integrator)
    optimizer = optax.chain(
        optax.clip_by_global_norm(config.clip_norm),
        optax.adam(optax.cosine_decay_schedule(config.learning_rate, config.steps)),
    )
    data, counts = Dataset.of(trajectories), trajectories.counts
    start = partial(_initial, config, data, counts, scales, optimizer)

    checkpoints = Checkpoints(folder / "checkpoints")
    found = checkpoints.newest()
    if found is None:
        state = start()
    else:
        step, had, _ = found
        different = [key for key in about if had.get(key) != about[key]]
        if different:
            raise CheckpointError(
                f"{folder}: holds a run with other settings ({', '.join(different)} differ); take another run name"
            )
        checkpoints.drop_after(step)
        state = checkpoints.restore(step, jax.eval_shape(start))
    done = int(state["step"])
    run_chunk = _make_chunk(config, predict, scales, optimizer, counts)
    measure = _make_validation(predict, validation or trajectories, preset.window, max(config.horizons))
    metrics = Metrics(folder, after_step=done)
    saved_at, saved_step = time.monotonic(), done
    stage_ends = np.cumsum(config.stage_steps)
    try:
        while done < config.steps:
            stage = int(np.searchsorted(stage_ends, done, side="right"))
            started = time.monotonic()
            new, loss, norm = run_chunk(state, data, horizon=config.horizons[stage])
            loss = float(loss)
            if not np.isfinite(loss):
                raise TrainError(
                    f"{folder}: the loss is {loss} after step {done}; the checkpoint of step {saved_step} stays. Take "
                    f"a smaller learning_rate than {config.learning_rate}"
                )
            state, done = new, done + config.chunk
            row = {"stage": stage, "horizon": config.horizons[stage], "loss": loss, "gradient_norm": float(norm)}
            row["validation_error"] = float(measure(state["params"]))
            row["steps_per_second"] = config.chunk / (time.monotonic() - started)
            metrics.write(done, **row)
            due = time.monotonic() - saved_at + 2 * (time.monotonic() - started) > config.checkpoint_seconds
            if due or done in stage_ends:
                checkpoints.save(done, state, about)
                saved_at, saved_step = time.monotonic(), done
            if progress:
                progress(done, config.steps, row)
    finally:
        metrics.close()
        checkpoints.close()
    return Model(preset, scales, integrator, jax.device_get(state["params"]), about | {"step": done})


def _loss_scales(trajectories: Trajectories) -> Scales:
    """No scaling of inputs, but the loss still has the data's units."""
    measured, ones = Scales.of(trajectories), vars(Scales.ones())
    return Scales(**ones | {"position_change": measured.position_change, "velocity_change": measured.velocity_change})


def _initial(config: TrainConfig, data: Dataset, counts: tuple, scales: Scales, optimizer) -> dict:
    preset = model_preset(config.model)
    zero = jnp.zeros(1, jnp.int32)
    history, _, _, graph = windows(data, zero, zero, window=preset.window, horizon=1, counts=counts)

    @jax.jit  # otherwise every layer's draw compiles for itself
    def initial(key: Key[jax.Array, ""], history: Array, graph: Graph) -> dict:
        params = SwarmNet(preset, scales).init(key, history, graph)["params"]
        return {"params": params, "optimizer": optimizer.init(params), "step": jnp.zeros((), jnp.int32)}

    return initial(jax.random.key(config.seed), history, graph)


def _make_chunk(config: TrainConfig, predict: Predict, scales: Scales, optimizer, counts: tuple[int, int, int]):
    """`(state, data, horizon=) -> (state, mean loss, mean gradient norm)`; one compile per horizon."""
    window = model_preset(config.model).window
    noise_unit = config.noise * jnp.stack(
        [scales.position_change, scales.position_change, scales.velocity_change, scales.velocity_change]
    )

    def loss_of(params: dict, data: Dataset, key: Key[Array, ""], horizon: int) -> Array:
        k_scene, k_start, k_noise = jax.random.split(key, 3)
        scenes, rows = data.states.shape[:2]
        scene = jax.random.randint(k_scene, (config.batch,), 0, scenes)
        start = jax.random.randint(k_start, (config.batch,), 0, rows - window - horizon + 1)
        history, truth, mask, graph = windows(data, scene, start, window=window, horizon=horizon, counts=counts)
        if config.noise:
            moving = graph.present & (jnp.arange(sum(counts)) >= counts[0] + counts[1])
            noise = noise_unit * jax.random.normal(k_noise, history.shape)
            history = history + jnp.where(moving[:, None, :, None], noise, 0)
        return multi_step_loss(predict(params, history, graph, horizon=horizon), truth, mask, scales)

    @partial(jax.jit, static_argnames="horizon")
    def run_chunk(state: dict, data: Dataset, *, horizon: int):
        def one(state: dict, _: None):
            key = jax.random.fold_in(jax.random.key(config.seed + 1), state["step"])
            loss, gradient = jax.value_and_grad(loss_of)(state["params"], data, key, horizon)
            updates, opt_state = optimizer.update(gradient, state["optimizer"], state["params"])
            new = {
                "params": optax.apply_updates(state["params"], updates),
                "optimizer": opt_state,
                "step": state["step"] + 1,
            }
            return new, (loss, optax.tree.norm(gradient))

        state, (loss, norm) = jax.lax.scan(one, state, None, length=config.chunk)
        return state, loss.mean(), norm.mean()

    return run_chunk


def _make_validation(predict: Predict, trajectories: Trajectories, window: int, horizon: int):
    """`params -> normalized error` (`agents`, see `gnn.evaluate`) over `horizon` steps of a fixed sample of windows."""
    data, counts = Dataset.of(trajectories), trajectories.counts
    rng = np.random.default_rng(0)
    scene = jnp.asarray(rng.integers(0, len(trajectories), VALIDATION_WINDOWS))
    start = jnp.asarray(rng.integers(0, trajectories.position.shape[1] - window - horizon + 1, VALIDATION_WINDOWS))
    history, truth, mask, graph = windows(data, scene, start, window=window, horizon=horizon, counts=counts)
    mask = mask & (jnp.arange(sum(counts)) >= counts[0] + counts[1])
    unit = natural_change(trajectories)[1]

    @jax.jit
    def measure(params: dict) -> Array:
        square = jnp.mean((predict(params, history, graph, horizon=horizon) - truth) ** 2, axis=-1)
        return jnp.sum(jnp.where(mask, square, 0)) / jnp.maximum(mask.sum(), 1) / unit

    return measure
