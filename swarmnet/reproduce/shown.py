"""Scenes as a network predicts them from their first rows alone: kept in a cell's folder, drawn from there."""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from envs.storage import load, save
from envs.trajectories import Trajectories
from gnn.checkpoint import Model
from gnn.forecast import forecast
from gnn.windows import check_rows
from swarmnet.figures_thesis import Shown
from swarmnet.reproduce.experiment import Cell, Experiment
from swarmnet.sheets import write_sheet

STEPS = 40
"""Predicted steps that are shown."""


def show(model: Model, truth: Trajectories, folder: Path, name: str, *, unit: float) -> Float[np.ndarray, " S"]:
    """Keeps scenes and what the model makes of them under `name`, and returns the error of each over `STEPS` steps.

    The error is the published one: MSE over all predicted steps, present nodes and 4 dimensions, divided by `unit`, the
    mean squared one-step change of the test data (`gnn.evaluate.natural_change`).

    Raises TrajectoryError when the scenes are too short.
    """
    truth = until(truth, model.config.window + STEPS)
    guess = forecast(model, truth)
    keep(folder, name, truth, guess)
    return scene_errors(truth, guess, model.config.window) / unit


def scene_errors(truth: Trajectories, guess: Trajectories, given: int) -> Float[np.ndarray, " S"]:
    """MSE of each scene over all rows after the first `given`, present nodes and 4 dimensions; inf after overflow."""
    off = np.concatenate([truth.position - guess.position, truth.velocity - guess.velocity], axis=-1, dtype=np.float64)
    here = truth.mask[:, given:]
    square = np.where(guess.mask[:, given:], np.mean(off[:, given:] ** 2, axis=-1), np.inf)
    return np.where(here, square, 0).sum(axis=(1, 2)) / here.sum(axis=(1, 2))


def until(trajectories: Trajectories, rows: int) -> Trajectories:
    """The first rows of every scene. Raises TrajectoryError when there are fewer."""
    check_rows(trajectories, rows, f"a figure of {STEPS} predicted steps")
    return trajectories.rows(0, rows)


def keep(folder: Path, name: str, truth: Trajectories, guess: Trajectories) -> None:
    """Writes FOLDER/shown/NAME-truth.h5 and NAME-predicted.h5."""
    save(folder / "shown" / f"{name}-truth.h5", truth)
    save(folder / "shown" / f"{name}-predicted.h5", guess)


def panels(folder: Path, name: str, titles: Sequence[str], *, agents: tuple[int, ...] | None = None) -> list[Shown]:
    """A panel for each title, of the scenes that were kept under `name`, in their order."""
    truth, guess = (load(folder / "shown" / f"{name}-{what}.h5") for what in ("truth", "predicted"))
    first = guess.provenance["given"] - 1
    return [
        Shown(truth.take([scene]), guess.take([scene]), title, first=first, agents=agents)
        for scene, title in enumerate(titles)
    ]


def first_of_rows[R: Mapping](done: Sequence[tuple[Cell, R]]) -> dict[str, tuple[Cell, R]]:
    """The finished cell with the least seed of every row that has one: a figure shows single networks."""
    found: dict[str, tuple[Cell, R]] = {}
    for cell, record in sorted(done, key=lambda pair: pair[0].seed):
        found.setdefault(cell.row, (cell, record))
    return found


def small_print(record: Mapping, *, data: str = "", effort: str = "", seeds: Sequence[int] = ()) -> str:
    """What a network had: demonstrations and minutes (or what `data` and `effort` say), dt, seed. A smoke run says that
    it is one."""
    chosen = list(seeds) or [record["seed"]]
    words = [
        data or f"{record['demonstrations']} demonstrations",
        effort or f"{record['minutes']:.3g} min of training",
        f"dt {record['dt']:g} s",
        ("seeds " if len(chosen) > 1 else "seed ") + ", ".join(map(str, chosen)),
    ]
    return ", ".join(words) + (" (smoke run)" if record["profile"] == "quick" else "")


def write(folder: Path, name: str, figure: Figure) -> list[Path]:
    """FOLDER/NAME.png and .pdf."""
    return [write_sheet(folder / f"{name}{ending}", figure) for ending in (".png", ".pdf")]


def gathered(folder: Path, done: Sequence[tuple[Cell, Mapping]], pictures: Mapping[str, str]) -> list[Path]:
    """Copies the pictures that the first cell of each row drew into `folder`; `pictures`: name there -> name with
    `{row}`."""
    files = []
    for row, (cell, _) in first_of_rows(done).items():
        for kept, name in pictures.items():
            for ending in (".png", ".pdf"):
                path = folder / f"{name.format(row=row.removeprefix('swarmnet ').replace(' ', '-'))}{ending}"
                shutil.copyfile(cell.path(folder) / f"{kept}{ending}", path)
                files.append(path)
    return files


def file_name(experiment: Experiment, row: str) -> str:
    """The experiment's name for its first row, with the row's behind for the others."""
    first = row == experiment.rows[0]
    return experiment.name if first else f"{experiment.name}-{row.removeprefix('swarmnet ').replace(' ', '-')}"
