"""Sampled futures of a swarm: what the model does not know, and what the world does at random.

One idea for both kinds of Bayesian network: M sets of weights, each predicted with a key. SwarmNet+ (thesis, section
3.1.5; Gal 2016) is one member with dropout, a new mask at every step; a deep ensemble (Lakshminarayanan et al. 2017)
is 3 to 5 members trained from different seeds, and a sampled future keeps its member to the end. Both know only the
model's own doubt; in a noisy world a `ProcessNoise` adds the rest, through the integrator and its limits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Key

from envs.dynamics import limited
from envs.record import Array
from envs.trajectories import Trajectories
from gnn.checkpoint import Model
from gnn.decode import Integrator
from gnn.family import Params, Predict
from gnn.features import Scales
from gnn.graph import Graph
from gnn.process_noise import ProcessNoise, Residuals, acceleration, along_across, following
from gnn.scores import Scores, ScoreSums, mean_scores, score_sums
from gnn.windows import Dataset, check_rows, windows
from swarm_mjcf.errors import SpecError, SwarmError

ONE_STEP_DRAWS = 10
"""Samples for mean and variance of the model's own one-step prediction."""


class SamplerError(SwarmError):
    """These models do not make one sampler."""


@dataclass(frozen=True)
class Sampler:
    """A distribution over futures."""

    predict: Predict
    members: Params
    """Weights of M members, stacked on the leading axis of every leaf."""
    scales: Scales
    integrator: Integrator
    window: int
    """Rows of the history."""
    noise: ProcessNoise | None = None
    """Random accelerations of the world; None: the model's own doubt alone."""

    def sample(
        self, key: Key[Array, ""], history: Float[Array, "B W V 4"], graph: Graph, horizon: int, samples: int
    ) -> Float[Array, "K B h V 4"]:
        """K = `samples` futures, each state fed back as input; sample k is member k mod M's."""
        return _futures(
            self.members, self.noise, key, jnp.asarray(history), graph,
            predict=self.predict, integrator=self.integrator, horizon=horizon, samples=samples,
        )  # fmt: skip


def make_sampler(models: Sequence[Model]) -> Sampler:
    """One model (its dropout draws, if it has any), or several of the same kind as an ensemble; no process noise yet.

    Raises SamplerError for none, or for models that differ in more than their weights.
    """
    if not models:
        raise SamplerError("a sampler needs at least one model")
    first = models[0]
    for number, model in enumerate(models):
        for name in ("config", "integrator"):
            if getattr(model, name) != getattr(first, name):
                raise SamplerError(f"ensemble: model {number} has another {name} than model 0; train all alike")
        alike = (np.allclose(a, b) for a, b in zip(*map(jax.tree.leaves, (model.scales, first.scales)), strict=True))
        if not all(alike):
            raise SamplerError(f"ensemble: model {number} has other scales than model 0; train all on the same data")
    members = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(model.params for model in models))
    return Sampler(first.predict, members, first.scales, first.integrator, first.config.window)


@partial(jax.jit, static_argnames=("predict", "integrator", "horizon", "samples"))
def _futures(
    members: Params,
    noise: ProcessNoise | None,
    key: Key[Array, ""],
    history: Array,
    graph: Graph,
    *,
    predict: Predict,
    integrator: Integrator,
    horizon: int,
    samples: int,
) -> Float[Array, "K B h V 4"]:
    size = len(jax.tree.leaves(members)[0])
    each = -(-samples // size)

    def future(params: Params, key: Key[Array, ""]) -> Float[Array, "B h V 4"]:
        k_first, k_steps = jax.random.split(key)
        standard = jax.random.normal(k_first, (len(history), graph.counts[2], 2))

        def step(carry: tuple[Array, Array], key: Key[Array, ""]):
            (history, standard), (k_model, k_noise) = carry, jax.random.split(key)
            last = history[:, -1]
            after = predict(params, history, graph, horizon=1, key=k_model)[:, 0]
            if noise is not None:
                standard = following(noise, k_noise, standard)
                after = pushed(last, after, acceleration(noise, standard, last, graph), integrator)
            return (jnp.concatenate([history[:, 1:], after[:, None]], axis=1), standard), after

        _, states = jax.lax.scan(step, (history, standard), jax.random.split(k_steps, horizon))
        return jnp.swapaxes(states, 0, 1)

    of_member = jax.vmap(future, in_axes=(None, 0))
    states = jax.vmap(of_member)(members, jax.random.split(key, (size, each)))  # (M, each, B, h, V, 4)
    return jnp.swapaxes(states, 0, 1).reshape(size * each, *states.shape[2:])[:samples]


def pushed(
    before: Float[Array, "B V 4"], after: Float[Array, "B V 4"], push: Float[Array, "B N 2"], step: Integrator
) -> Float[Array, "B V 4"]:
    """The predicted state with a further acceleration of the agents [m/s^2], within the limits of the control step."""
    first = before.shape[1] - push.shape[1]
    velocity = before[:, first:, 2:]
    planned = (after[:, first:, 2:] - velocity) / step.dt
    extra = jnp.where(push == 0, 0, limited(velocity, planned + push, step) - planned)
    moved = extra * (step.dt**2 * (step.substeps + 1) / (2 * step.substeps))
    return jnp.asarray(after).at[:, first:].add(jnp.concatenate([moved, extra * step.dt], axis=-1))


def one_step_residuals(sampler: Sampler, trajectories: Trajectories, *, seed: int = 0) -> Residuals:
    """Errors of the mean one-step prediction from every row, with the variance of the model's own samples.

    Raises TrajectoryError for trajectories without a row to predict.
    """
    check_rows(trajectories, sampler.window + 1, "a one-step residual")
    data, counts = Dataset.of(trajectories), trajectories.counts
    scenes, rows = data.states.shape[:2]
    first, dt = counts[0] + counts[1], sampler.integrator.dt
    quiet = replace(sampler, noise=None)

    def at(start: Array) -> Residuals:
        history, truth, mask, graph = windows(
            data, jnp.arange(scenes), jnp.full(scenes, start), window=sampler.window, horizon=1, counts=counts
        )
        drawn = quiet.sample(jax.random.fold_in(jax.random.key(seed), start), history, graph, 1, ONE_STEP_DRAWS)
        reached = drawn[:, :, 0, first:, 2:]  # (K, S, N, 2)
        here = mask[:, 0, first:, None]
        error = jnp.where(here, (truth[:, 0, first:, 2:] - reached.mean(axis=0)) / dt, 0)
        off = (reached - reached.mean(axis=0)) / dt
        velocity = jnp.broadcast_to(history[:, -1, first:, 2:], off.shape)
        variance = along_across(velocity, off).var(axis=0, ddof=1)
        # Who leaves after this row has no residual.
        staying = replace(graph, present=jnp.asarray(graph.present) & mask[:, 0])
        return Residuals(history=history[:, -1:], graph=staying, error=error, variance=variance)

    found = jax.jit(lambda: jax.lax.map(at, jnp.arange(rows - sampler.window)))()
    return jax.tree.map(lambda x: x.reshape(len(x) * x.shape[1], *x.shape[2:]), found)


def score_futures(
    sampler: Sampler,
    trajectories: Trajectories,
    *,
    horizon: int = 40,
    samples: int = 100,
    starts: int = 1,
    batch: int = 50,
    seed: int = 0,
) -> Scores:
    """Scores of the sampled positions of agents at horizons 1..h, from `starts` evenly spaced rows of every scene.

    Raises TrajectoryError for trajectories too short, SpecError for a number below 1.
    """
    for field, value in (("horizon", horizon), ("starts", starts), ("batch", batch)):
        if value < 1:
            raise SpecError(field, value, "at least 1")
    check_rows(trajectories, sampler.window + horizon, f"a prediction of {horizon} steps from {sampler.window}")
    data = Dataset.of(trajectories)
    scenes, rows = data.states.shape[:2]
    every = np.unique(np.linspace(0, rows - sampler.window - horizon, starts).round().astype(int))
    scene, start = (grid.ravel() for grid in np.meshgrid(np.arange(scenes), every, indexing="ij"))
    sums = []
    for begin in range(0, len(scene), batch):
        places = np.arange(begin, begin + batch)
        real = places < len(scene)  # the last batch is filled up: one compile for all
        places = places.clip(max=len(scene) - 1)
        key = jax.random.fold_in(jax.random.key(seed), begin)
        part = _scored(
            sampler.members, sampler.noise, key, data, scene[places], start[places], real, predict=sampler.predict,
            integrator=sampler.integrator, window=sampler.window, horizon=horizon, samples=samples,
            counts=trajectories.counts,
        )  # fmt: skip
        sums.append(jax.device_get(part))
    return mean_scores(jax.tree.map(lambda *parts: np.sum(parts, axis=0), *sums))


@partial(jax.jit, static_argnames=("predict", "integrator", "window", "horizon", "samples", "counts"))
def _scored(
    members: Params,
    noise: ProcessNoise | None,
    key: Key[Array, ""],
    data: Dataset,
    scene: Int[Array, " B"],
    start: Int[Array, " B"],
    real: Bool[Array, " B"],
    *,
    predict: Predict,
    integrator: Integrator,
    window: int,
    horizon: int,
    samples: int,
    counts: tuple[int, int, int],
) -> ScoreSums:
    history, truth, mask, graph = windows(data, scene, start, window=window, horizon=horizon, counts=counts)
    futures = _futures(
        members, noise, key, history, graph, predict=predict, integrator=integrator, horizon=horizon, samples=samples
    )
    agents = jnp.arange(sum(counts)) >= counts[0] + counts[1]
    return score_sums(futures, truth, mask & agents & real[:, None, None])
