"""Judging a model's prediction on recorded trajectories, imported or simulated: no physics, no expert."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from envs.record import Array
from envs.storage import load, save
from envs.trajectories import AGENT, Trajectories, concatenate
from gnn.checkpoint import Model
from gnn.evaluate import HORIZONS, PredictionError, constant_velocity, persistence, prediction_error
from gnn.graph import Graph
from gnn.windows import Dataset, check_rows, windows
from swarm_mjcf.errors import SwarmError
from swarmnet.out_of_range import out_of_range
from swarmnet.policies import PolicyError, Source
from swarmnet.progress import progress

SHOWN = 4
"""Windows that are drawn."""
_LOOKED = 256
"""Scenes among which they are chosen."""


def predictions(source: Source, truth: Trajectories, label: str = "") -> dict[str, PredictionError]:
    """Prediction error of a model and, beside it, of constant velocity and persistence."""
    model = source.model
    assert model is not None
    predictors = {
        source.name: (model.predict, model.params),
        "constant velocity": (constant_velocity(truth.dt), {}),
        "persistence": (persistence, {}),
    }
    found = {}
    for row, (predict, params) in predictors.items():
        with progress(f"{label}predict, {row}") as update:
            found[row] = prediction_error(
                predict, params, truth, window=model.config.window, progress=lambda a, b, update=update: update(a, b)
            )
    return found


def holdout_of(source: Source, data: Path) -> tuple[Trajectories, list[str]]:
    """Trajectories to judge a model on, and what is to be said of them: out of range, or its own training data.

    Raises:
      PolicyError: the source is no trained model, or learned from other kinds of nodes.
      SwarmError: the file cannot be read, its rows are too few or not the model's time step apart.
    """
    model, trajectories = source.model, load(data)
    if model is None:
        raise PolicyError(f"policy {source.given!r}: predicts nothing; --data needs a run folder with a trained model")
    trained = model.integrator
    if abs(trained.dt - trajectories.dt) > 1e-6 or trained.substeps != trajectories.substeps:
        raise SwarmError(
            f"the model was trained at dt {trained.dt:g} s with {trained.substeps} substeps, {data} has rows "
            f"{trajectories.dt:g} s apart with {trajectories.substeps}; import the recording with --dt {trained.dt:g}"
        )
    check_data(model, trajectories, data)
    said = [out_of_range(model.seen, trajectories), _own(model, trajectories, data)]
    return trajectories, [line for line in said if line]


def check_data(model: Model, trajectories: Trajectories, data: Path) -> None:
    """Raises TrajectoryError for rows too few to predict, PolicyError for other kinds of nodes than the model's."""
    check_rows(trajectories, model.config.window + 1, f"a prediction of 1 step from {model.config.window}")
    one, zero = trajectories.take([0]), jnp.zeros(1, jnp.int32)
    history, _, _, graph = windows(
        Dataset.of(one), zero, zero, window=model.config.window, horizon=1, counts=trajectories.counts
    )
    check_nodes(model, history, graph, str(data))


def check_nodes(model: Model, history: Float[Array, "B W V 4"], graph: Graph, where: str) -> None:
    """Raises PolicyError where the model's weights are for other kinds of nodes than those of `where`."""
    try:
        jax.eval_shape(lambda p: model.predict(p, history, graph, horizon=1), model.params)
    except Exception as error:
        goals, obstacles, agents = graph.counts
        raise PolicyError(
            f"{where}: has up to {goals} goals, {obstacles} obstacles and {agents} agents, and the model learned from "
            f"other kinds of nodes ({str(error).strip().splitlines()[0]})"
        ) from error


def _own(model: Model, trajectories: Trajectories, data: Path) -> str | None:
    """Whether a model saw these very trajectories."""

    def which(about: dict) -> tuple:
        simulated = about.get("simulate") or {}
        return (
            about.get("fingerprint"),
            about.get("import", {}).get("part"),
            simulated.get("seed"),
            simulated.get("preset"),
        )

    known = which(trajectories.provenance)
    if any(value is not None for value in known) and known in map(which, model.trained_on):
        return f"{data} is what the model was trained on: its error says little about anybody else"
    return None


def sample_windows(model: Model, trajectories: Trajectories, folder: Path) -> None:
    """Writes rollouts/truth.h5 and rollouts/predicted.h5: up to `SHOWN` windows that do not overlap, with a horizon of
    40 steps or what fits; those in which most agents stay, in the order of the recording."""
    window = model.config.window
    horizon = max((h for h in HORIZONS if window + h <= trajectories.position.shape[1]), default=1)
    rows = window + horizon
    agents = (trajectories.mask & (trajectories.kind == AGENT)[:, None])[:_LOOKED]
    views = np.lib.stride_tricks.sliding_window_view(agents, rows, axis=1)  # (S, starts, V, rows)
    staying = views.all(axis=-1).sum(axis=-1)
    chosen: list[tuple[int, int]] = []
    while len(chosen) < SHOWN and (staying.any() or not chosen):
        scene, start = (int(i) for i in np.unravel_index(np.argmax(staying), staying.shape))
        chosen.append((scene, start))
        staying[scene, max(0, start - rows + 1) : start + rows] = 0
    chosen.sort()
    truth = replace(
        concatenate([trajectories.take([scene]).rows(start, rows) for scene, start in chosen]),
        provenance=trajectories.provenance | {"policy": "recorded"},
    )
    history, _, mask, graph = windows(
        Dataset.of(truth), jnp.arange(len(truth)), jnp.zeros(len(truth), jnp.int32),
        window=window, horizon=horizon, counts=truth.counts,
    )  # fmt: skip
    future = jax.device_get(jax.jit(lambda p: model.predict(p, history, graph, horizon=horizon))(model.params))
    states = np.concatenate([history, future], axis=1)
    sound = np.logical_and.accumulate(np.isfinite(states).all(axis=-1), axis=1)  # not after an overflow
    there = np.concatenate([truth.mask[:, :window], np.asarray(mask)], axis=1) & sound
    states = np.where(there[..., None], states, 0).astype(np.float32)
    predicted = replace(
        truth,
        position=states[..., :2],
        velocity=states[..., 2:],
        mask=there,
        provenance=truth.provenance | {"policy": "prediction"},
    )
    save(folder / "rollouts" / "truth.h5", truth)
    save(folder / "rollouts" / "predicted.h5", predicted)
