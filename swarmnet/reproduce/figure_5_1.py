"""Figure 5.1: subsets of a network's edge functions, against the expert with the same rules switched on.

Trained as the thesis says, on 1..5 agents with and without an obstacle. Column (a) has all edge functions, (b) goal,
(c) goal and agent, (d) goal and obstacle, (e) agent, (f) obstacle and agent; the thesis calls (e) and (f) failures.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl

from envs.config import SimulateConfig
from envs.experts.config import BoidsConfig
from gnn.separation import COLUMNS, HORIZONS, separation
from swarmnet.figures import STYLE
from swarmnet.figures_probe import separation_figure
from swarmnet.progress import Update
from swarmnet.reproduce.experiment import Cell, DataSet, Effort, Experiment
from swarmnet.reproduce.shown import gathered, write
from swarmnet.reproduce.work import demonstrations, few, trained, unseen

MODELS = {
    "swarmnet separable": "separable",
    "swarmnet best": "best",
    "swarmnet best-mean": "best-mean",
    "swarmnet thesis-ch5": "thesis-ch5",
}
AS_CODED, STAY, NONE = "walls go with the obstacle rule", "walls stay", "no walls"
WALLS = (AS_CODED, STAY, NONE)
"""Boids' virtual walls are part of the obstacle rule, but no edge carries them: where the truth has them."""
SHOWN = "shown"


def column(name: str, horizon: int, data: str) -> str:
    """`(e) 40`, `(e) 40, walls stay`."""
    return f"({name}) {horizon}" + ("" if data == AS_CODED else f", {data}")


def run(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """Trains on mixed swarms and tests every subset of edge functions, with walls here and there."""
    world = SimulateConfig(preset="published", mixed=True)
    data = demonstrations(world, effort, cell.seed)
    model = trained(MODELS[cell.row], data, effort, folder, progress, seed=cell.seed)
    test, found = unseen(world, few(effort, 15)), {}
    full = test.mask[:, 0].all(axis=1).argsort()[::-1]  # scenes with everybody first: two of them are shown
    expert = world.world().expert
    assert isinstance(expert, BoidsConfig)
    for walls in WALLS:
        law = replace(expert, walls=False) if walls == NONE else expert
        columns = separation(model, test.take(full), law, walls_stay=walls == STAY)
        for name, one in columns.items():
            for horizon, value in zip(HORIZONS, one.error.published_mean, strict=True):
                found[column(name, horizon, walls)] = value
        if walls == AS_CODED:
            with mpl.rc_context(STYLE):
                write(folder, SHOWN, separation_figure(columns))
    return found


def draw(folder: Path, done: Sequence[tuple[Cell, dict]]) -> list[Path]:
    """The sheet of each row's first seed."""
    return gathered(folder, done, {SHOWN: "figure-5.1-{row}"})


FIGURE_5_1 = Experiment(
    name="figure-5.1",
    about="subsets of edge functions against the expert with the same rules, with the error of every column",
    rows=tuple(MODELS),
    data_sets=(
        DataSet(
            "mixed boids", tuple(column(n, h, walls) for walls in WALLS for h in reversed(HORIZONS) for n in COLUMNS)
        ),
    ),
    run=run,
    notes="Each column is normalized by the changes in its own truth. The virtual walls are part of the obstacle rule, "
    "but no edge carries them: the truth has them in the columns with that rule, as coded; in all (`walls stay`), as "
    "in every scene the network has seen; or in none (`no walls`).",
    figure=draw,
)
