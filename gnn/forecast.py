"""Scenes as a network predicts them from their first rows alone, never corrected."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from envs.trajectories import Trajectories
from gnn.checkpoint import Model
from gnn.windows import Dataset, check_rows, windows


def forecast(model: Model, truth: Trajectories) -> Trajectories:
    """The first `window` rows of every scene, then predictions from these alone; agents that overflow are absent then.

    `provenance["given"]` is the number of rows that the model was given. Raises TrajectoryError where nothing is left
    to predict.
    """
    given, rows = model.config.window, truth.position.shape[1]
    check_rows(truth, given + 1, "a prediction")
    scene, zero = jnp.arange(len(truth)), jnp.zeros(len(truth), jnp.int32)
    history, _, _, graph = windows(
        Dataset.of(truth), scene, zero, window=given, horizon=rows - given, counts=truth.counts
    )
    run = jax.jit(model.predict, static_argnames="horizon")
    states = np.concatenate([history, run(model.params, history, graph, horizon=rows - given)], axis=1)
    sound = np.logical_and.accumulate(np.isfinite(states).all(axis=-1), axis=1)
    mask = truth.mask & sound
    states = np.where(mask[..., None], states, 0).astype(np.float32)
    about = truth.provenance | {"policy": "prediction", "given": given}
    return replace(truth, position=states[..., :2], velocity=states[..., 2:], mask=mask, provenance=about)
