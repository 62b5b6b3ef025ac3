"""Figure 5.1: subsets of a network's edge functions, against the expert with the same rules switched on.

Trained as the thesis says, on 1..5 agents with and without an obstacle. Column (a) has all edge functions, (b) goal,
(c) goal and agent, (d) goal and obstacle, (e) agent, (f) obstacle and agent; the thesis calls (e) and (f) failures.
What makes functions separate: `best` and chapter 5's network with one thing changed, and swarms of one composition.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np

from envs.config import SimulateConfig
from envs.experts.config import BoidsConfig
from gnn.separation import COLUMNS, HORIZONS, separation
from swarmnet.figures import STYLE
from swarmnet.figures_probe import error_grid, separation_figure
from swarmnet.progress import Update
from swarmnet.reproduce.experiment import Cell, DataSet, Effort, Experiment
from swarmnet.reproduce.shown import gathered, write
from swarmnet.reproduce.work import demonstrations, few, trained, unseen

MAIN = ("best", "separable", "thesis-ch5")
ONE_THING_CHANGED = (
    "best-sum",
    "best-mean",
    "best-world",
    "best-hidden",
    "best-narrow",
    "best-unbiased",
    "thesis-ch5-frame",
    "thesis-ch5-mean",
    "thesis-ch5-narrow",
    "thesis-ch5-unbiased",
)
MODELS = {f"swarmnet {name}": name for name in (*MAIN, *ONE_THING_CHANGED)}
LEADING = tuple(f"swarmnet {name}" for name in MAIN)
MIXED, FIXED = "mixed boids", "fixed boids"
"""What is learned from: 1..5 agents with and without an obstacle, or always 5 agents and one obstacle."""
AS_CODED, STAY, NONE = "walls go with the obstacle rule", "walls stay", "no walls"
WALLS = (AS_CODED, STAY, NONE)
"""Boids' virtual walls are part of the obstacle rule, but no edge carries them: where the truth has them."""
SHOWN = "shown"


def column(learned: str, name: str, horizon: int, walls: str) -> str:
    """`(e) 40`, `(e) 40, walls stay`, `fixed (e) 40`."""
    return ("fixed " if learned == FIXED else "") + f"({name}) {horizon}" + ("" if walls == AS_CODED else f", {walls}")


def run(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """Trains and tests every subset of edge functions on mixed swarms, with walls here and there."""
    world = SimulateConfig(preset="published", mixed=True)
    data = demonstrations(replace(world, mixed=cell.data == MIXED), effort, cell.seed)
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
                found[column(cell.data, name, horizon, walls)] = value
        if walls == AS_CODED:
            with mpl.rc_context(STYLE):
                write(folder, SHOWN, separation_figure(columns))
    return found


def draw(folder: Path, done: Sequence[tuple[Cell, dict]]) -> list[Path]:
    """The error of every subset at 40 steps, mean over seeds, and the sheet of the first seed of each row."""
    found: dict[str, dict[str, list[float]]] = {}
    for data in (MIXED, FIXED):
        for row, model in MODELS.items():
            for record in (record for cell, record in done if (cell.row, cell.data) == (row, data)):
                line = found.setdefault(model + (", fixed" if data == FIXED else ""), {name: [] for name in COLUMNS})
                for name, values in line.items():
                    value = record["values"][column(data, name, HORIZONS[-1], NONE)]
                    values.append(np.inf if value is None else value)  # a prediction that ran away is stored as null
    errors = {line: {name: float(np.mean(values)) for name, values in row.items()} for line, row in found.items()}
    titles = {name: f"({name})\n" + "\n".join(kinds) for name, kinds in COLUMNS.items()}
    label = f"normalized error at {HORIZONS[-1]} steps, truth without walls, mean over seeds"
    mixed = [(cell, record) for cell, record in done if cell.data == MIXED]
    return write(folder, "figure-5.1", error_grid(errors, titles, label=label)) + gathered(
        folder, mixed, {SHOWN: "figure-5.1-{row}"}
    )


FIGURE_5_1 = Experiment(
    name="figure-5.1",
    about="subsets of edge functions against the expert with the same rules, with the error of every column",
    rows=tuple(MODELS),
    data_sets=tuple(
        DataSet(data, tuple(column(data, n, h, walls) for walls in WALLS for h in reversed(HORIZONS) for n in COLUMNS))
        for data in (MIXED, FIXED)
    ),
    exists=lambda row, data: data == MIXED or row in LEADING,
    in_quick=lambda row, data: data == MIXED and row in LEADING,
    leading=LEADING,
    run=run,
    notes="Each column is normalized by the changes in its own truth. Learned from runs of 1 to 5 agents with and "
    "without an obstacle, in columns `fixed` from runs of 5 agents and one obstacle; all tested on the mixed "
    "ones. Networks: `best` and chapter 5's as they are, with forces for messages (`separable`), and with one "
    "thing changed: messages joined by their sum or mean alone, edge functions on raw states of the world "
    "(`world`) or in the receiver's frame (`frame`), functions without linear paths beside their hidden "
    "layers (`hidden`), messages of 2 numbers (`narrow`), edge functions without biases (`unbiased`). An "
    "absent edge has no message in any of them. The virtual walls are part of the obstacle rule, but no edge "
    "carries them: the truth has them in the columns with that rule, as coded; in all (`walls stay`), as in "
    "every scene the network has seen; or in none (`no walls`).",
    figure=draw,
)
