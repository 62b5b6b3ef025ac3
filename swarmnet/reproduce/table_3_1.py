"""Table 3.1: prediction error of SwarmNet and its rivals at 5 and 40 steps, N=5, for three laws and two time steps."""

from pathlib import Path

from envs.config import SimulateConfig
from gnn.evaluate import constant_velocity, persistence
from swarmnet.progress import Update
from swarmnet.reproduce.borrow import Learning, trained_once
from swarmnet.reproduce.experiment import Cell, DataSet, Effort, Experiment
from swarmnet.reproduce.work import SLOWLY, demonstrations, errors, published_mean, unseen

MODELS = {
    "swarmnet best": "best",
    "swarmnet thesis-ch3": "thesis-ch3-blind",
    "swarmnet thesis-ch3 context": "thesis-ch3",
    "kipf": "kipf",
    "lstm": "lstm",
}
BASELINES = ("persistence", "constant velocity")
LAWS = {"boids": "published", "helbing": "helbing", "chaser": "chaser"}
HORIZONS = (5, 40)

WORLDS = {
    law if dt == 0.3 else f"{law} dt{dt}": SimulateConfig(preset=preset, dt=dt)
    for dt in (0.3, 0.1)
    for law, preset in LAWS.items()
}
"""Data sets by name, physics contacts off as published."""

THESIS = {
    "kipf": (0.4288, 17.45, 0.4374, 19.61, 0.1391, 14.23),
    "lstm": (0.8992, 41.20, 1.2241, 42.88, 0.2013, 126.3),
    "swarmnet thesis-ch3": (0.2813, 10.47, 0.1000, 3.855, 0.0152, 3.691),
    "swarmnet thesis-ch3 context": (0.2338, 2.778, 0.0317, 0.484, 0.0152, 3.691),
}
"""The thesis's figures for boids, helbing, chaser, each at 5 and 40 steps."""


def columns(data: str) -> tuple[str, ...]:
    """Columns of a data set, such as `boids 5`."""
    return tuple(f"{data} {horizon}" for horizon in HORIZONS)


def run(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """Trains where there is something to train, and tests on unseen runs."""
    world = WORLDS[cell.data]
    if cell.row in BASELINES:
        test = unseen(world, effort)
        predict = persistence if cell.row == "persistence" else constant_velocity(test.dt)
        return {
            column: published_mean(predict, {}, test, window=1, horizon=horizon)
            for column, horizon in zip(columns(cell.data), HORIZONS, strict=True)
        }
    learning = Learning(model=MODELS[cell.row], seed=cell.seed)
    model = trained_once(learning, demonstrations(world, effort, cell.seed), effort, folder, progress)
    return errors(model, unseen(world, effort), HORIZONS, columns(cell.data))


def references() -> dict[tuple[str, str], float]:
    """The thesis's figures by row and column; it is compared at dt 0.3 and 0.1 alike, its own step is not stated."""
    return {
        (row, column): value
        for row, values in (THESIS | {"swarmnet best": THESIS["swarmnet thesis-ch3 context"]}).items()
        for suffix in ("", " dt0.1")
        for column, value in zip((c for law in LAWS for c in columns(law + suffix)), values, strict=True)
    }


TABLE_3_1 = Experiment(
    name="table-3.1",
    about="prediction error at 5 and 40 steps: SwarmNet, rivals and baselines on Boids, Helbing and chasers",
    rows=(*MODELS, *BASELINES),
    data_sets=tuple(DataSet(name, columns(name), world.dt or 0.3) for name, world in WORLDS.items()),
    run=run,
    references=references(),
    leading=("swarmnet best",),
    untrained=BASELINES,
    notes=SLOWLY,
)
