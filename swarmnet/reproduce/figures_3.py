"""Figures 3.5 to 3.8: what SwarmNet predicts, by number of demonstrations, and beside Kipf's network."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from envs.config import SimulateConfig
from envs.storage import load
from envs.trajectories import Trajectories
from gnn.checkpoint import Model
from gnn.evaluate import natural_change
from swarmnet.figures_thesis import error_by_size, prediction_sheet
from swarmnet.judge import sweep
from swarmnet.progress import Update
from swarmnet.reproduce.borrow import Learning, trained_once
from swarmnet.reproduce.experiment import Cell, DataSet, Effort, Experiment
from swarmnet.reproduce.shown import STEPS, file_name, first_of_rows, panels, show, small_print, write
from swarmnet.reproduce.table_3_1 import HORIZONS as TABLE
from swarmnet.reproduce.table_3_1 import MODELS, WORLDS, columns
from swarmnet.reproduce.work import SLOWLY, TEST_SEED, demonstrations, errors, unseen

BOIDS, CHASER = WORLDS["boids"], WORLDS["chaser"]
SWARMNETS = ("swarmnet best", "swarmnet thesis-ch3 context")
PLACES = tuple(f"obstacle place {place}" for place in (1, 2, 3, 4))
HORIZONS = (1, 5, 10, 20, 40)
SIZES = {"1K": 1000, "2K": 2000, "5K": 5000, "10K": 10_000, "20K": 20_000, "50K": 50_000, "100K": 100_000}
LARGEST = {"quick": 5000, "cpu": 20_000, "full": 100_000}
"""Most demonstrations of figure 3.6 by profile."""
SAMPLES = ("sample 1", "sample 2", "sample 3", "sample 4")
FEW = "1000 demonstrations"
PAIR = (0, 1)
"""The two agents that figures with two agents show: the first, whoever they are."""


def network(world: SimulateConfig, cell: Cell, effort: Effort, folder: Path, progress: Update) -> Model:
    """The row's network on this world."""
    data = demonstrations(world, effort, cell.seed)
    return trained_once(Learning(model=MODELS[cell.row], seed=cell.seed), data, effort, folder, progress)


def run_3_5(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """One start, the obstacle in four places."""
    model, test = network(BOIDS, cell, effort, folder, progress), unseen(BOIDS, effort)
    sweep(BOIDS.world(), model, folder, engine="native", steps=model.config.window - 1 + STEPS, seed=TEST_SEED)
    truth = load(folder / "rollouts" / "sweep_truth.h5")
    found = show(model, truth, folder, "places", unit=natural_change(test)[0])
    return errors(model, test, TABLE, columns("boids")) | dict(zip(PLACES, found.tolist(), strict=True))


def draw_3_5(folder: Path, done: Sequence[tuple[Cell, dict]]) -> list[Path]:
    """A row of four panels for each model."""
    files = []
    for row, (cell, record) in first_of_rows(done).items():
        shown = panels(cell.path(folder), "places", PLACES)
        note = f"{row}, {small_print(record)}"
        files += write(folder, file_name(FIGURE_3_5, row), prediction_sheet(shown, columns=4, note=note))
    return files


def run_3_6(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """The best preset with that many demonstrations; nothing where they are more than the profile allows."""
    size = SIZES[cell.row]
    if size > LARGEST[effort.profile]:
        return {}
    data = demonstrations(BOIDS, replace(effort, demonstrations=size), cell.seed)
    model = trained_once(Learning(model="best", seed=cell.seed), data, effort, folder, progress)
    return errors(model, unseen(BOIDS, effort), HORIZONS, [_steps(horizon) for horizon in HORIZONS])


def _steps(horizon: int) -> str:
    return f"{horizon} step" + ("s" if horizon > 1 else "")


def draw_3_6(folder: Path, done: Sequence[tuple[Cell, dict]]) -> list[Path]:
    """Lines over the sizes that have results; nothing without those of 1K, which the others are compared with."""
    have = {(cell.row, cell.seed): record for cell, record in done if record["values"]}
    rows = [row for row in SIZES if any(row == found for found, _ in have)]
    if not rows or rows[0] != "1K":
        return []
    seeds = sorted({seed for _, seed in have})

    def value(row: str, seed: int, horizon: int) -> float:
        found = have.get((row, seed), {"values": {}})["values"].get(_steps(horizon))
        return np.nan if found is None else found

    values = {h: np.array([[value(row, seed, h) for row in rows] for seed in seeds]) for h in HORIZONS}
    note = "swarmnet best, " + small_print(next(iter(have.values())), data="boids", seeds=seeds)
    return write(folder, "figure-3.6", error_by_size(values, [SIZES[row] for row in rows], note=note))


def run_3_7(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """A network that saw 1000 demonstrations, on four unseen scenes."""
    few = replace(effort, demonstrations=1000)
    model, test = network(BOIDS, cell, few, folder, progress), unseen(BOIDS, effort)
    return errors(model, test, TABLE, columns("boids")) | _samples(model, test, folder, SAMPLES)


def _samples(model: Model, test: Trajectories, folder: Path, names: Sequence[str]) -> dict[str, float]:
    """The first test scenes, whatever they show."""
    found = show(model, test.take(slice(0, len(names))), folder, "samples", unit=natural_change(test)[0])
    return dict(zip(names, found.tolist(), strict=True))


def draw_3_7(folder: Path, done: Sequence[tuple[Cell, dict]]) -> list[Path]:
    """All agents above, two of them below."""
    files = []
    for row, (cell, record) in first_of_rows(done).items():
        place, names = cell.path(folder), [""] * len(SAMPLES)
        shown = [*panels(place, "samples", SAMPLES), *panels(place, "samples", names, agents=PAIR)]
        note = f"{row}, boids, {small_print(record, data=FEW)}"
        figure = prediction_sheet(shown, columns=len(SAMPLES), note=note, side=("all agents", "two agents"))
        files += write(folder, file_name(FIGURE_3_7, row), figure)
    return files


def run_3_8(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """Chasers: the table's errors, and two unseen scenes."""
    model, test = network(CHASER, cell, effort, folder, progress), unseen(CHASER, effort)
    return errors(model, test, TABLE, columns("chaser")) | _samples(model, test, folder, SAMPLES[:2])


def draw_3_8(folder: Path, done: Sequence[tuple[Cell, dict]]) -> list[Path]:
    """The same two scenes by each model, side by side; all agents above, two of them below."""
    cells = first_of_rows(done)
    order = [row for row in FIGURE_3_8.rows if row in cells]
    if not order:
        return []
    above, below = [], []
    for row in order:
        place = cells[row][0].path(folder)
        above += panels(place, "samples", [f"{row}, {sample}" for sample in SAMPLES[:2]])
        below += panels(place, "samples", ["", ""], agents=PAIR)
    note = f"chasers, {small_print(cells[order[0]][1])}"
    figure = prediction_sheet([*above, *below], columns=len(above), note=note, side=("all agents", "two agents"))
    return write(folder, "figure-3.8", figure)


SHOWN_NOTE = (
    f"Columns of a place or sample: the error of what the figure shows, over {STEPS} predicted steps from the first "
    "rows alone. The others: mean over all windows of the unseen runs."
)
FIGURE_3_5 = Experiment(
    name="figure-3.5",
    about="predictions for four places of the obstacle over the truth",
    rows=SWARMNETS,
    data_sets=(DataSet("boids", (*columns("boids"), *PLACES)),),
    run=run_3_5,
    leading=SWARMNETS[:1],
    notes=SHOWN_NOTE,
    figure=draw_3_5,
)
FIGURE_3_6 = Experiment(
    name="figure-3.6",
    about="error by horizon and number of demonstrations (1K to 100K), Boids",
    rows=tuple(SIZES),
    data_sets=(DataSet("boids", tuple(map(_steps, HORIZONS))),),
    run=run_3_6,
    size=lambda cell, effort: SIZES[cell.row],
    notes="A row is a number of demonstrations, all trained for the same minutes: quick goes to 5K, cpu to 20K.",
    figure=draw_3_6,
)
FIGURE_3_7 = Experiment(
    name="figure-3.7",
    about="predictions by a network trained on 1000 demonstrations",
    rows=SWARMNETS,
    data_sets=(DataSet("boids", (*columns("boids"), *SAMPLES)),),
    run=run_3_7,
    size=lambda cell, effort: 1000,
    leading=SWARMNETS[:1],
    notes=f"Trained on 1000 demonstrations in every profile. {SHOWN_NOTE}",
    figure=draw_3_7,
)
FIGURE_3_8 = Experiment(
    name="figure-3.8",
    about="SwarmNet beside Kipf's network on chasers, two samples",
    rows=(*SWARMNETS, "kipf"),
    data_sets=(DataSet("chaser", (*columns("chaser"), *SAMPLES[:2])),),
    run=run_3_8,
    leading=SWARMNETS[:1],
    notes=f"{SLOWLY} {SHOWN_NOTE}",
    figure=draw_3_8,
)
