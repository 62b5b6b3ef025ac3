"""The parts that cells are made of: data simulated once, training within a budget, the published error."""

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

from envs.config import SimulateConfig
from envs.simulate import fingerprint, simulate
from envs.storage import load
from envs.trajectories import Trajectories
from gnn.baselines.config import KipfConfig
from gnn.budget import train_for
from gnn.checkpoint import Model
from gnn.config import TrainConfig, model_preset
from gnn.evaluate import prediction_error
from gnn.family import Params, Predict
from gnn.metrics import read_metrics
from gnn.padding import mix
from gnn.train import split
from swarmnet.commands.train import note
from swarmnet.progress import Update
from swarmnet.reproduce.experiment import Effort
from swarmnet.reproduce.lock import locked

VALIDATION = 0.05
"""Share of the demonstrations kept out of training."""
TEST_SEED = 1_000_000
"""Seed of the unseen scenes; those of training are seeds of cells."""
BRIEF = 10
"""Gradient steps of a chunk in trainings of less than a minute."""
SLOW: dict[type, int] = {KipfConfig: 8}
"""Models that are tested on one in so many of the unseen scenes: Kipf's encoder, over all pairs at each of ten rows,
takes 5 minutes for a table's 500."""
SLOWLY = f"Kipf's network is tested on one in {SLOW[KipfConfig]} of the unseen scenes."
"""What the notes of a table with such a model say."""
PLAN = "plan.json"
"""What `train_for` keeps in the folder of a training."""


def demonstrations(world: SimulateConfig, effort: Effort, seed: int) -> Trajectories:
    """The runs to learn from: `effort.demonstrations` of this world, drawn from the cell's seed."""
    return recordings(replace(world, scenes=effort.demonstrations, seed=seed), effort)


def unseen(world: SimulateConfig, effort: Effort) -> Trajectories:
    """The runs to test on, the same for every row and seed."""
    return recordings(replace(world, scenes=effort.test_scenes, seed=TEST_SEED), effort)


def recordings(config: SimulateConfig, effort: Effort) -> Trajectories:
    """Trajectories of `config`, simulated by whoever asks first; others wait for it."""
    path = effort.data / f"{slug(config)}.h5"
    with locked(path.with_suffix(".lock"), wait=True):
        simulate(config, path)
    return load(path)


def slug(config: SimulateConfig) -> str:
    """A file name that says how the settings differ from the defaults, and that no other settings have."""
    given = [
        f"{field.name}-{value}"
        for field in fields(config)
        if field.name not in ("preset", "chunk", "threads", "engine")
        and (value := getattr(config, field.name)) != field.default
    ]
    return "_".join([config.preset, *given, fingerprint(config)[:8]]).replace(" ", "")


def few(effort: Effort, agents: int) -> Effort:
    """The same with fewer test scenes of many agents: the cost of a scene grows with the square of their number."""
    return replace(effort, test_scenes=min(effort.test_scenes, max(32, effort.test_scenes * 100 // agents**2)))


def trained(
    model: str,
    trajectories: Trajectories | Sequence[Trajectories],
    effort: Effort,
    folder: Path,
    progress: Update,
    *,
    seed: int,
    initial: Model | None = None,
    freeze: Sequence[str] = (),
) -> Model:
    """A model trained in `folder` for the minutes of the effort, or gone on with. The plan is kept in the folder.

    Several trajectories, of swarms of several sizes, are mixed. `initial`, `freeze`: tuning (`gnn.train.train`).
    """
    parts = [trajectories] if isinstance(trajectories, Trajectories) else trajectories
    learning, validation = (mix(side) for side in zip(*(split(part, VALIDATION) for part in parts), strict=True))
    return train_for(
        effort.minutes,
        curriculum(model, seed, effort.minutes),
        learning,
        folder,
        validation=validation,
        progress=lambda done, total, row: progress(done, total, note(row)),
        initial=initial,
        freeze=freeze,
    )


def curriculum(model: str, seed: int, minutes: float) -> TrainConfig:
    """How a model is trained. Those of chapter 3 and the rivals as the thesis does it, to 10 steps, and with its batch.

    One that predicts an acceleration from one state learns a law without noise from single steps: on Boids, in equal
    minutes, its error was half that of the curriculum, whose long predictions cost ten times as much per step. In less
    than a minute chunks are short: every stage takes three at least, which of Kipf's network are minutes otherwise.
    """
    chunk = BRIEF if minutes < 1 else TrainConfig.chunk
    if model_preset(model).acts:
        return TrainConfig(model=model, seed=seed, horizons=(1,), stage_steps=(10_000,), batch=64, chunk=chunk)
    return TrainConfig(model=model, seed=seed, chunk=chunk)


def spent(folder: Path) -> tuple[int, float]:
    """What training has taken so far anywhere in a cell's folder: gradient steps, and seconds with their compiling."""
    rows = [row for file in folder.rglob("metrics.jsonl") for row in _chunks(file)]
    return sum(steps for steps, _ in rows), sum((steps / rate for steps, rate in rows), 0.0)


def _chunks(file: Path) -> list[tuple[int, float]]:
    """(gradient steps, steps per second) of every chunk."""
    rows = read_metrics(file)
    before = [0, *(row["step"] for row in rows)]
    return [(row["step"] - was, row["steps_per_second"]) for was, row in zip(before, rows, strict=False)]


def errors(model: Model, trajectories: Trajectories, horizons: Sequence[int], names: Sequence[str]) -> dict[str, float]:
    """The published error (mean over windows) of a model at the horizons, under the names of columns."""
    window, share = model.config.window, SLOW.get(type(model.config), 1)
    trajectories = trajectories.take(slice(None, None, share))
    return {
        name: published_mean(model.predict, model.params, trajectories, window=window, horizon=horizon)
        for name, horizon in zip(names, horizons, strict=True)
    }


def published_mean(predict: Predict, params: Params, trajectories: Trajectories, *, window: int, horizon: int) -> float:
    """The published error of any predictor. A horizon by itself: in one call with a longer one, every window would be
    predicted to the longer."""
    return prediction_error(predict, params, trajectories, window=window, horizons=(horizon,)).published_mean[0]
