"""Section 4.2's control: edge functions locked at their random start, all others trained.

The thesis says that the training error then "is never able to be brought down below 1 even for 1 step prediction".
"""

from pathlib import Path

from envs.config import SimulateConfig
from swarmnet.progress import Update
from swarmnet.reproduce.experiment import Cell, DataSet, Effort, Experiment
from swarmnet.reproduce.work import demonstrations, errors, trained, unseen

MODELS = {"": "thesis-ch3", " best": "best"}
FREE, LOCKED = "unlocked", "locked"
WORLDS = {"chaser": "chaser", "boids": "published"}
HORIZONS = (1, 5, 40)


def columns(data: str) -> tuple[str, ...]:
    """Columns of a data set, such as `chaser 1`."""
    return tuple(f"{data} {horizon}" for horizon in HORIZONS)


def run(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """Trains from scratch, with or without a lock on the edge functions."""
    state, _, which = cell.row.partition(" ")
    world = SimulateConfig(preset=WORLDS[cell.data])
    model = trained(
        MODELS[f" {which}" if which else ""],
        demonstrations(world, effort, cell.seed),
        effort,
        folder,
        progress,
        seed=cell.seed,
        freeze=("edge/*",) if state == LOCKED else (),
    )
    return errors(model, unseen(world, effort), HORIZONS, columns(cell.data))


CONTROL = Experiment(
    name="control",
    about="edge functions locked at their random start, the rest trained, beside the same unlocked (section 4.2)",
    rows=tuple(state + which for which in MODELS for state in (LOCKED, FREE)),
    data_sets=tuple(DataSet(name, columns(name)) for name in WORLDS),
    run=run,
    notes="The thesis: with locked edge functions the error stays above 1 even for 1 step. Rows without `best` are "
    "chapter 3's network.",
)
