"""Figure 3.9: sampled futures of noisy Boids by dropout and by an ensemble, and how honest their bands are."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np

from envs.config import SimulateConfig
from envs.trajectories import Trajectories
from gnn.calibration import with_noise
from gnn.scores import Scores
from gnn.uncertainty import Sampler, make_sampler, score_futures
from gnn.windows import Dataset, windows
from swarmnet.figures import STYLE
from swarmnet.figures_uncertainty import figure_3_9, scores_by_horizon
from swarmnet.progress import Update
from swarmnet.reproduce.experiment import Cell, DataSet, Effort, Experiment
from swarmnet.reproduce.shown import gathered, write
from swarmnet.reproduce.work import demonstrations, recordings, trained, unseen

WORLD = SimulateConfig(preset="published", perception_noise=1.0, actuation_noise=0.5)
"""Noise of the expert [m and m/s, m/s^2]: the thesis's perception noise, and a tenth of the largest acceleration."""
MEMBERS = {"dropout": 1, "ensemble of 3": 3}
"""Networks of a method; they share the minutes."""
HELD_OUT, HELD_OUT_SEED, TESTED = 300, 2_000_000, 150
"""Scenes that the noise is fitted to and calibrated on, their seed, and scenes tested."""
HORIZON, STEP = 40, 30
AT = (1, 5, 10, 20, 40)
"""Horizons in the table."""
SAMPLES = 60
FIGURES = ("futures", "scores")


def columns() -> tuple[str, ...]:
    """Coverage at the worst horizons of all, then the scores at some."""
    ends = tuple(f"90% band{which}, {end}" for which in ("", " without noise") for end in ("least", "most"))
    return ends + tuple(f"{name} at {h}" for name in ("90% band", "50% band", "energy", "NLL") for h in AT)


def run(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """Trains the members, fits process noise on held-out scenes, samples futures of the test scenes and scores them."""
    data, members = demonstrations(WORLD, effort, cell.seed), MEMBERS[cell.row]
    part = replace(effort, minutes=effort.minutes / members)
    preset = "best-plus" if members == 1 else "best"
    models = [
        trained(preset, data, part, folder / f"member-{k}", progress, seed=10 * cell.seed + k) for k in range(members)
    ]
    held_out = recordings(replace(WORLD, scenes=HELD_OUT, seed=HELD_OUT_SEED), effort)
    test = unseen(WORLD, replace(effort, test_scenes=min(TESTED, effort.test_scenes)))
    bare = make_sampler(models)
    full = with_noise(bare, held_out, horizon=HORIZON, seed=cell.seed)
    scores, without = (
        score_futures(sampler, test, horizon=HORIZON, samples=SAMPLES, starts=2, seed=cell.seed)
        for sampler in (full, bare)
    )
    with mpl.rc_context(STYLE):
        _draw(folder, full, test, {cell.row: scores, f"{cell.row}, without noise": without})
    ends = [end(np.asarray(one.coverage_90)) for one in (scores, without) for end in (np.min, np.max)]
    kinds = (scores.coverage_90, scores.coverage_50, scores.energy, scores.nll)
    values = [*ends, *(kind[h - 1] for kind in kinds for h in AT)]
    return {name: float(value) for name, value in zip(columns(), values, strict=True)}


def _draw(folder: Path, sampler: Sampler, test: Trajectories, scores: dict[str, Scores]) -> None:
    """The first test scene's futures, and all scores by horizon."""
    zero = jnp.zeros(1, jnp.int32)
    history, _, _, graph = windows(
        Dataset.of(test), zero, zero, window=sampler.window, horizon=HORIZON, counts=test.counts
    )
    futures = np.asarray(sampler.sample(jax.random.key(0), history, graph, HORIZON, 100))[:, 0]
    write(folder, FIGURES[0], figure_3_9(futures, test, scene=0, start=sampler.window - 1, step=STEP))
    write(folder, FIGURES[1], scores_by_horizon(scores, dt=test.dt))


def draw(folder: Path, done: Sequence[tuple[Cell, dict]]) -> list[Path]:
    """Both figures of each method's first seed."""
    return gathered(folder, done, {name: f"figure-3.9-{{row}}-{name}" for name in FIGURES})


FIGURE_3_9 = Experiment(
    name="figure-3.9",
    about="sampled futures of noisy Boids by dropout and by an ensemble: coverage of bands, energy score, NLL",
    rows=tuple(MEMBERS),
    data_sets=(DataSet("noisy boids", columns()),),
    run=run,
    unit="share, energy [m], NLL [nats]",
    notes="Perception noise 1 m and 1 m/s, actuation noise 0.5 m/s^2. `least` and `most`: coverage of the central 90% "
    "band over all horizons from 1 to 40. Process noise is fitted and calibrated on scenes apart from the tested ones.",
    figure=draw,
)
