"""Prediction error by horizon, in the thesis's normalisation and in metres, beside two baselines that learn nothing."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from envs.record import Array
from envs.trajectories import AGENT, Trajectories
from gnn.family import Params, Predict
from gnn.graph import Graph
from gnn.windows import Dataset, check_rows, windows

HORIZONS = (1, 5, 10, 40)


@dataclass(frozen=True)
class PredictionError:
    """Normalized errors of one predictor. Index: horizon.

    `published` = MSE over all predicted steps up to the horizon, all present nodes and all 4 dimensions, divided by the
    mean squared one-step change of the same nodes over the whole data (eq. 3.4 without its factor 1/2, as coded).
    `agents` = the same over agent nodes alone. Mean and median over all windows of all trajectories.

    `ade` and `fde` are what is usual for pedestrians: distance between predicted and true position, mean over the steps
    up to the horizon and at the horizon, mean over all paths: agents of a window that are there at every one of these
    steps.
    """

    horizons: tuple[int, ...]
    published_mean: tuple[float, ...]
    published_median: tuple[float, ...]
    agents_mean: tuple[float, ...]
    agents_median: tuple[float, ...]
    by_step: Float[np.ndarray, " H"]
    """`agents` error of each single step 1..H, mean over windows."""
    windows: tuple[int, ...]
    """Number of windows at each horizon."""
    ade: tuple[float, ...]
    """Average displacement error [m]; NaN where no agent stays that long."""
    fde: tuple[float, ...]
    """Final displacement error [m]."""
    paths: tuple[int, ...]
    """Number of paths at each horizon."""
    displacement: Float[np.ndarray, " H"]
    """Final displacement error [m] of each step 1..H."""


def persistence(params: Params, history: Array, graph: Graph, *, horizon: int, key: jax.Array | None = None) -> Array:
    """Nothing changes."""
    return jnp.broadcast_to(history[:, -1:], (history.shape[0], horizon, *history.shape[2:]))


def constant_velocity(dt: float) -> Predict:
    """Everybody keeps its velocity."""

    def predict(params: Params, history: Array, graph: Graph, *, horizon: int, key: jax.Array | None = None) -> Array:
        last = history[:, -1:]
        ahead = dt * jnp.arange(1, horizon + 1)[None, :, None, None]
        return jnp.concatenate([last[..., :2] + ahead * last[..., 2:], last[..., 2:].repeat(horizon, 1)], axis=-1)

    return predict


def prediction_error(
    predict: Predict,
    params: Params,
    trajectories: Trajectories,
    *,
    window: int,
    horizons: tuple[int, ...] = HORIZONS,
    scenes_per_batch: int = 32,
    progress: Callable[[int, int], None] | None = None,
) -> PredictionError:
    """Errors of `predict` from every row that has a history before it and enough rows after it.

    Horizons longer than the trajectories are left out. Raises TrajectoryError when even the shortest does not fit.
    """
    rows = trajectories.position.shape[1]
    horizons = tuple(h for h in sorted(horizons) if window + h <= rows) or (min(horizons),)
    check_rows(trajectories, window + horizons[0], f"a prediction of {horizons[0]} steps from {window}")
    longest = horizons[-1]
    data, counts = jax.tree.map(np.asarray, Dataset.of(trajectories)), trajectories.counts
    # Every start that fits the shortest horizon; what lies beyond the end of a trajectory is masked.
    starts = rows - window - horizons[0] + 1
    padded = longest + starts - 1 + window - rows
    run = _compiled(predict, window, longest, counts, starts)
    first_agent = counts[0] + counts[1]
    sums, moved = [], np.zeros((3, longest))
    for first in range(0, len(trajectories), scenes_per_batch):
        chosen = np.arange(first, first + scenes_per_batch).clip(max=len(trajectories) - 1)
        batch = jax.tree.map(lambda x, chosen=chosen: x[chosen], data)
        batch = Dataset(
            states=np.pad(batch.states, ((0, 0), (0, padded), (0, 0), (0, 0))),
            mask=np.pad(batch.mask, ((0, 0), (0, padded), (0, 0))),
            edges=batch.edges,
        )
        square, count, displaced = (np.asarray(x, np.float64) for x in run(params, batch))
        real = min(scenes_per_batch, len(trajectories) - first)
        sums.append((square[: real * starts], count[: real * starts]))
        moved += displaced[: real * starts].sum(axis=0)
        if progress:
            progress(first + real, len(trajectories))
    square, count = (np.concatenate(part) for part in zip(*sums, strict=True))  # (windows, longest, V)
    norm_all, norm_agents = natural_change(trajectories)
    results: dict[str, list[float]] = {name: [] for name in ("pm", "pd", "am", "ad")}
    used = []
    row = np.tile(np.arange(starts), len(trajectories))
    for horizon in horizons:
        fits = row + window + horizon <= rows
        used.append(int(fits.sum()))
        for key, nodes, norm in (("p", slice(None), norm_all), ("a", slice(first_agent, None), norm_agents)):
            errors = _mean(square[fits, :horizon, nodes], count[fits, :horizon, nodes]) / norm
            errors = errors[np.isfinite(errors)] if np.isnan(errors).any() and not np.isnan(square).any() else errors
            results[key + "m"].append(float(errors.mean()) if len(errors) else float("nan"))
            results[key + "d"].append(float(np.median(errors)) if len(errors) else float("nan"))
    total = count[:, :, first_agent:].sum(axis=(0, 2))
    steps = square[:, :, first_agent:].sum(axis=(0, 2)) / np.maximum(4 * total, 1) / norm_agents
    average, final = np.divide(moved[:2], moved[2], out=np.full((2, longest), np.nan), where=moved[2] > 0)
    at = np.asarray(horizons) - 1
    return PredictionError(
        horizons,
        *(tuple(results[key]) for key in ("pm", "pd", "am", "ad")),
        by_step=steps,
        windows=tuple(used),
        ade=tuple(average[at].tolist()),
        fde=tuple(final[at].tolist()),
        paths=tuple(moved[2][at].astype(int).tolist()),
        displacement=final,
    )


def natural_change(trajectories: Trajectories) -> tuple[float, float]:
    """Mean squared one-step change over all present nodes and 4 dimensions, and over agents alone."""
    states = np.concatenate([trajectories.position, trajectories.velocity], axis=-1).astype(np.float64)
    change = (np.diff(states, axis=1) ** 2).mean(axis=-1)
    there = trajectories.mask[:, 1:] & trajectories.mask[:, :-1]
    agents = there & (trajectories.kind == AGENT)[:, None]
    return float(change[there].mean()), float(change[agents].mean())


def _mean(square: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Mean over steps, nodes and 4 dimensions, per window; NaN where nothing is present."""
    total = count.sum(axis=(1, 2))
    return np.divide(square.sum(axis=(1, 2)), 4 * total, out=np.full(len(total), np.nan), where=total > 0)


@lru_cache(maxsize=16)
def _compiled(predict: Predict, window: int, horizon: int, counts: tuple[int, int, int], starts: int):
    """`_batch_errors` of a predictor, for all data of one shape."""
    return jax.jit(partial(_batch_errors, predict, window=window, horizon=horizon, counts=counts, starts=starts))


def _batch_errors(
    predict: Predict,
    params: Params,
    data: Dataset,
    *,
    window: int,
    horizon: int,
    counts: tuple[int, int, int],
    starts: int,
) -> tuple[Array, Array, Array]:
    """Of every window, one start at a time: squared errors summed over 4 dimensions (windows, horizon, V), where they
    count, and for each step (windows, 3, horizon) sums over the agents there up to it: mean displacement so far [m],
    displacement at it [m], and their number."""
    scenes = data.states.shape[0]
    number = jnp.arange(1, horizon + 1)[:, None]

    def one_start(_: None, start: Array):
        history, truth, mask, graph = windows(
            data, jnp.arange(scenes), jnp.full(scenes, start), window=window, horizon=horizon, counts=counts
        )
        predicted = predict(params, history, graph, horizon=horizon)
        wrong = (predicted - truth) ** 2
        stays = jnp.cumprod(mask[:, :, sum(counts[:2]) :], axis=1)
        apart = jnp.sqrt(jnp.sum(wrong[:, :, sum(counts[:2]) :, :2], axis=-1))
        sofar = jnp.cumsum(jnp.where(stays, apart, 0), axis=1) / number
        displaced = jnp.stack([jnp.where(stays, x, 0).sum(axis=-1) for x in (sofar, apart, 1.0)], axis=1)
        return None, (jnp.where(mask, wrong.sum(axis=-1), 0), mask, displaced)

    _, found = jax.lax.scan(one_start, None, jnp.arange(starts))
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1).reshape(scenes * starts, *x.shape[2:]), found)
