"""Imitation: a curriculum of horizons in fixed compiled chunks, resumable to the bit.

Everything random at gradient step n is drawn from (seed, n), and training stops only between chunks that are aligned to
the global step, so weights, optimizer and n are the full state: a continued run does what an uninterrupted one would.
"""

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float, Key

from envs.plain import plain
from envs.record import Array
from envs.trajectories import Trajectories
from gnn.checkpoint import Checkpoints, Model, check_same, describe
from gnn.config import AnyModelConfig, TrainConfig, model_preset
from gnn.decode import Integrator
from gnn.evaluate import natural_change
from gnn.family import Family, Params
from gnn.features import Scales
from gnn.freeze import free_leaves, frozen, paths_of
from gnn.freeze import freeze as freezing
from gnn.graph import Graph
from gnn.metrics import Metrics
from gnn.ranges import figures_of
from gnn.registry import make_family
from gnn.windows import Dataset, check_rows, windows
from swarm_mjcf.errors import SpecError, SwarmError

Progress = Callable[[int, int, dict], None]
"""Called with (steps done, steps in all, metrics of the chunk)."""
VALIDATION_WINDOWS = 64


class TrainError(SwarmError):
    """Training cannot go on: the loss is not finite. The last good checkpoint stays."""


def train(
    config: TrainConfig,
    trajectories: Trajectories,
    folder: str | Path,
    *,
    validation: Trajectories | None = None,
    progress: Progress | None = None,
    initial: Model | None = None,
    freeze: Sequence[str] = (),
) -> Model:
    """Trains in `folder` (checkpoints/, metrics.jsonl, tensorboard/) or goes on from its newest checkpoint.

    `initial`: a model whose weights and scales are taken over (tuning); Adam starts afresh. `freeze`: patterns over the
    paths of the weights (`edge/*`); what they match stays as it is (`gnn.freeze`).

    Raises TrajectoryError for trajectories too short, SpecError for an initial model of another kind and for patterns
    that match nothing, SwarmError for an initial model of another dt, CheckpointError for a folder of other settings or
    data, TrainError when the loss diverges.
    """
    prepared = prepare(config, trajectories, validation=validation, initial=initial, freeze=freeze)
    return train_prepared(prepared, folder, progress=progress)


@dataclass(frozen=True)
class Recipe:
    """What the compiled functions of a training depend on besides arrays: equal recipes share them."""

    config: TrainConfig
    """Without what is a number to them, see `without_numbers`."""
    preset: AnyModelConfig
    integrator: Integrator
    counts: tuple[int, int, int]
    """Goals, obstacles and agents."""
    freeze: tuple[str, ...]

    @staticmethod
    def without_numbers(config: TrainConfig) -> TrainConfig:
        """The settings with the same seed, stages and pace of saving for all."""
        return replace(config, seed=0, horizons=(1,), stage_steps=(config.chunk,), checkpoint_seconds=1.0)

    def family(self, scales: Scales) -> Family:
        """The model's functions."""
        return make_family(self.preset, scales, self.integrator)

    def optimizer(self, params: Params) -> optax.GradientTransformation:
        """Adam behind a clip, for the weights that are free; `params` may be their shapes."""
        chain = optax.chain(optax.clip_by_global_norm(self.config.clip_norm), optax.scale_by_adam())
        return freezing(chain, frozen(params, self.freeze))


@dataclass(frozen=True)
class Prepared:
    """All that one training consists of but its folder. Nothing compiled depends on the number of steps."""

    config: TrainConfig
    preset: AnyModelConfig
    scales: Scales
    integrator: Integrator
    origin: dict
    """Where data and initial weights come from, and what is frozen: plain JSON."""
    data: Dataset
    start: Callable[[], dict]
    """The state before the first step: weights, optimizer, step."""
    run_chunk: Callable[..., tuple[dict, Array, Array]]
    """`(state, data, steps in all, horizon=) -> (state, mean loss, mean gradient norm)`, see `Compiled`."""
    measure: Callable[[Params], Array]
    """The validation error of weights."""

    @property
    def about(self) -> dict:
        """What is stored with the weights."""
        return {
            "preset": self.config.model,
            "train": plain(self.config) | {"checkpoint_seconds": None},  # how often to save changes nothing else
            **self.origin,
            **describe(self.preset, self.scales, self.integrator),
        }


def prepare(
    config: TrainConfig,
    trajectories: Trajectories,
    *,
    validation: Trajectories | None = None,
    initial: Model | None = None,
    freeze: Sequence[str] = (),
) -> Prepared:
    """Checks everything and makes the functions of a training; compiles nothing yet. Arguments as in `train`."""
    preset, furthest = model_preset(config.model), max(config.horizons)
    check_rows(trajectories, preset.window + furthest, f"a horizon of {furthest} steps")
    if validation is not None:
        check_rows(validation, preset.window + furthest, f"a validation of {furthest} steps")
    if initial is not None:
        if initial.config != preset:
            raise SpecError("model", config.model, f"the initial model's preset, {initial.about.get('preset')}")
        _check_step(initial, trajectories)
    scales = Scales.of(trajectories) if initial is None else initial.scales
    integrator = Integrator(
        trajectories.dt, trajectories.substeps, trajectories.max_speed, trajectories.max_acceleration
    )
    data = Dataset.of(trajectories)
    recipe = Recipe(Recipe.without_numbers(config), preset, integrator, trajectories.counts, tuple(freeze))
    first = partial(_first_weights, recipe, scales, jax.random.key(config.seed), data)
    shapes = jax.eval_shape(first)
    if initial is not None:
        _check_weights(initial.params, shapes)
    optimizer = recipe.optimizer(shapes)

    def start() -> dict:
        params = first() if initial is None else jax.tree.map(jnp.asarray, initial.params)
        state = {"params": params, "optimizer": optimizer.init(params), "step": jnp.zeros((), jnp.int32)}
        return state | ({"raw": params} if config.average else {})

    return Prepared(
        config=config,
        preset=preset,
        scales=scales,
        integrator=integrator,
        origin={
            "data": {"scenes": len(trajectories), **trajectories.provenance},
            "range": figures_of(trajectories),
            "initial": None if initial is None else {"weights": fingerprint(initial.params), **initial.about},
            "freeze": list(freeze) or None,
        },
        data=data,
        start=start,
        run_chunk=partial(compiled(recipe).run_chunk, scales, jax.random.key(config.seed + 1)),
        measure=_make_validation(recipe, scales, validation or trajectories, furthest),
    )


def train_prepared(prepared: Prepared, folder: str | Path, *, progress: Progress | None = None) -> Model:
    """`train` for what was prepared before."""
    folder, config, about = Path(folder), prepared.config, prepared.about
    checkpoints = Checkpoints(folder / "checkpoints")
    found = checkpoints.newest()
    if found is None:
        state = prepared.start()
    else:
        step, had, _ = found
        check_same(folder, had, about, model=type(prepared.preset), train=TrainConfig)
        checkpoints.drop_after(step)
        state = checkpoints.restore(step, jax.eval_shape(prepared.start))
    done = int(state["step"])
    metrics = Metrics(folder, after_step=done)
    saved_at, saved_step = time.monotonic(), done
    stage_ends = np.cumsum(config.stage_steps)
    try:
        while done < config.steps:
            stage = int(np.searchsorted(stage_ends, done, side="right"))
            horizon = config.horizons[stage]
            started = time.monotonic()
            new, loss, norm = prepared.run_chunk(state, prepared.data, config.steps, horizon=horizon)
            loss, norm = float(loss), float(norm)
            if not np.isfinite(loss + norm):
                raise TrainError(
                    f"{folder}: the loss is {loss} and its gradient {norm} after step {done}; the checkpoint of step "
                    f"{saved_step} stays. Take a smaller learning_rate than {config.learning_rate}"
                )
            state, done = new, done + config.chunk
            row = {"stage": stage, "horizon": horizon, "loss": loss, "gradient_norm": norm}
            row["validation_error"] = float(prepared.measure(state["params"]))
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
    params = jax.device_get(state["params"])
    return Model(prepared.preset, prepared.scales, prepared.integrator, params, about | {"step": done})


def split(trajectories: Trajectories, share: float) -> tuple[Trajectories, Trajectories]:
    """Scenes to train on and scenes for the validation: the first of them, `share` of all and at least one.

    Raises SpecError for a share that leaves nothing to train on.
    """
    if not 0 < share < 1:
        raise SpecError("validation", share, "a share between 0 and 1")
    kept = max(1, round(share * len(trajectories)))
    if kept >= len(trajectories):
        raise SpecError("validation", share, f"a share that leaves some of {len(trajectories)} scenes to train on")
    return trajectories.take(slice(kept, None)), trajectories.take(slice(0, kept))


def fingerprint(params: Params) -> str:
    """Short hash of weights."""
    found = hashlib.sha256()
    for path, leaf in zip(paths_of(params), jax.tree.leaves(params), strict=True):
        found.update(path.encode() + np.asarray(leaf).tobytes())
    return found.hexdigest()[:16]


def _check_step(initial: Model, trajectories: Trajectories) -> None:
    """Raises SwarmError unless the data have the control step that the weights were learned for. Substeps may differ:
    the integrator, which is the data's, turns an acceleration into what they make of it."""
    if abs(initial.integrator.dt - trajectories.dt) > 1e-6:
        raise SwarmError(
            f"the initial model was trained at dt {initial.integrator.dt:g} s, the data have rows "
            f"{trajectories.dt:g} s apart; tuning needs the same"
        )


def _check_weights(params: Params, shapes: Params) -> None:
    """Raises SpecError unless the weights fit a network for this data."""
    have = {path: np.shape(leaf) for path, leaf in zip(paths_of(params), jax.tree.leaves(params), strict=True)}
    need = {path: leaf.shape for path, leaf in zip(paths_of(shapes), jax.tree.leaves(shapes), strict=True)}
    different = sorted(path for path in have.keys() | need.keys() if have.get(path) != need.get(path))
    if different:
        raise SpecError("initial", ", ".join(different), "weights for the same kinds of nodes as in the data")


class Compiled(NamedTuple):
    """The functions of a training, compiled for each shape of what they take."""

    initial: Callable[..., Params]
    """`(scales, key, history, graph) -> weights`."""
    run_chunk: Callable[..., tuple[dict, Array, Array]]
    """`(scales, key, state, data, steps in all, horizon=) -> (state, mean loss, mean gradient norm)`: `config.chunk`
    gradient steps."""
    error: Callable[..., Array]
    """`(scales, params, history, truth, mask, graph) -> mean squared error` of agents' states."""


@lru_cache(maxsize=8)
def compiled(recipe: Recipe) -> Compiled:
    """One compile for a horizon, whatever the seed, the scales and the number of steps.

    The latest recipes are kept: a process has room for some thousands of programs, and no more.
    """
    config, counts, window = recipe.config, recipe.counts, recipe.preset.window

    def initial(scales: Scales, key: jax.Array, history: Array, graph: Graph) -> Params:
        return recipe.family(scales).init(key, history, graph)

    def run_chunk(
        scales: Scales, root: Key[Array, ""], state: dict, data: Dataset, steps: int | Array, *, horizon: int
    ) -> tuple[dict, Array, Array]:
        family = recipe.family(scales)
        optimizer, frozen_leaves = recipe.optimizer(state["params"]), frozen(state["params"], recipe.freeze)
        noise_unit = config.noise * jnp.stack(
            [scales.position_change, scales.position_change, scales.velocity_change, scales.velocity_change]
        )

        def loss_of(params: dict, key: Key[Array, ""]) -> Array:
            k_scene, k_start, k_noise, k_model = jax.random.split(key, 4)
            scenes, rows = data.states.shape[:2]
            scene = jax.random.randint(k_scene, (config.batch,), 0, scenes)
            start = jax.random.randint(k_start, (config.batch,), 0, rows - window - horizon + 1)
            history, truth, mask, graph = windows(data, scene, start, window=window, horizon=horizon, counts=counts)
            if config.noise:
                moving = graph.present & (jnp.arange(sum(counts)) >= counts[0] + counts[1])
                noise = noise_unit * jax.random.normal(k_noise, history.shape)
                history = history + jnp.where(moving[:, None, :, None], noise, 0)
            return family.loss(params, history, truth, mask, graph, k_model)

        def one(state: dict, _: None):
            step, raw = state["step"], state["raw" if config.average else "params"]
            key = jax.random.fold_in(root, step)
            loss, gradient = jax.value_and_grad(loss_of)(raw, key)
            updates, opt_state = optimizer.update(gradient, state["optimizer"], raw)
            rate = 0.5 * config.learning_rate * (1 + jnp.cos(jnp.pi * step / steps))
            raw = optax.apply_updates(raw, jax.tree.map(lambda update: -rate * update, updates))
            new = {"params": raw, "optimizer": opt_state, "step": step + 1}
            if config.average:
                # The first steps leave the initial weights behind: the mean begins short and grows.
                keep = jnp.minimum(config.average, (1 + step) / (10 + step))
                new["params"] = jax.tree.map(lambda mean, now: mean + (1 - keep) * (now - mean), state["params"], raw)
                new["raw"] = raw
            return new, (loss, optax.tree.norm(free_leaves(gradient, frozen_leaves)))

        state, (loss, norm) = jax.lax.scan(one, state, None, length=config.chunk)
        return state, loss.mean(), norm.mean()

    def error(
        scales: Scales, params: Params, history: Array, truth: Array, mask: Array, graph: Graph
    ) -> Float[Array, ""]:
        predicted = recipe.family(scales).predict(params, history, graph, horizon=truth.shape[1])
        mask = mask & (jnp.arange(mask.shape[-1]) >= sum(graph.counts[:2]))
        square = jnp.mean((predicted - truth) ** 2, axis=-1)
        return jnp.sum(jnp.where(mask, square, 0)) / jnp.maximum(mask.sum(), 1)

    return Compiled(jax.jit(initial), jax.jit(run_chunk, static_argnames="horizon"), jax.jit(error))


def _first_weights(recipe: Recipe, scales: Scales, key: jax.Array, data: Dataset) -> Params:
    zero = jnp.zeros(1, jnp.int32)
    history, _, _, graph = windows(data, zero, zero, window=recipe.preset.window, horizon=1, counts=recipe.counts)
    return compiled(recipe).initial(scales, key, history, graph)


def _make_validation(recipe: Recipe, scales: Scales, trajectories: Trajectories, horizon: int):
    """`params -> normalized error` (`agents`, see `gnn.evaluate`) over `horizon` steps of a fixed sample of windows."""
    data, counts, window = Dataset.of(trajectories), trajectories.counts, recipe.preset.window
    rng = np.random.default_rng(0)
    scene = jnp.asarray(rng.integers(0, len(trajectories), VALIDATION_WINDOWS))
    start = jnp.asarray(rng.integers(0, trajectories.position.shape[1] - window - horizon + 1, VALIDATION_WINDOWS))
    history, truth, mask, graph = windows(data, scene, start, window=window, horizon=horizon, counts=counts)
    unit, error = natural_change(trajectories)[1], compiled(recipe).error
    return lambda params: error(scales, params, history, truth, mask, graph) / unit
