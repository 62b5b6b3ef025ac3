"""Runs the cells of an experiment, each under its lock: what is done is kept, what fails is recorded, others go on."""

import datetime
import json
import platform
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from envs.trajectories import versions
from swarm_mjcf.errors import SwarmError
from swarmnet.progress import Update, progress
from swarmnet.reproduce.experiment import Cell, Effort, Experiment
from swarmnet.reproduce.lock import Busy, locked
from swarmnet.reproduce.work import spent
from swarmnet.results import commit, hardware, write_whole

RECORD, EFFORT = "cell.json", "effort.json"
Bar = Callable[[str], AbstractContextManager[Update]]


@dataclass(frozen=True)
class Outcome:
    """What became of the cells of one call."""

    done: tuple[Cell, ...]
    failed: tuple[Cell, ...]
    busy: tuple[Cell, ...]
    """Left to other processes, which work on them."""


def run_cells(
    experiment: Experiment,
    cells: Sequence[Cell],
    effort: Effort,
    folder: Path,
    *,
    finished: Callable[[str, dict], None] = lambda title, record: None,
    bar: Bar = progress,
) -> Outcome:
    """Does what is missing of `cells` below `folder`, in order, and what failed before once more.

    `finished(title, record)` is called after each that was done now.

    Raises SwarmError for a folder whose cells were run with another effort.
    """
    claim(folder, effort)
    had = {cell: read_record(cell.path(folder)) for cell in cells}
    done, failed, busy = [], [], []
    for number, cell in enumerate(cells, 1):
        place, title = cell.path(folder), f"{number}/{len(cells)} {experiment.name}: {cell}"
        try:
            with locked(place / "cell.lock"):
                record = read_record(place)
                # What has failed since the beginning, another job has just tried.
                if record is None or ("failed" in record and record == had[cell]):
                    with bar(title) as update:
                        record = run_cell(experiment, cell, effort, place, update)
                    write_record(place, record)
                    finished(title, record)
        except Busy:
            busy.append(cell)
        else:
            (failed if "failed" in record else done).append(cell)
    return Outcome(tuple(done), tuple(failed), tuple(busy))


def run_cell(experiment: Experiment, cell: Cell, effort: Effort, place: Path, update: Update) -> dict:
    """The cell's record: its values, or why it failed, and all that is needed to judge them."""
    begun, before = time.monotonic(), spent(place)[1]
    record = {
        "row": cell.row,
        "data": cell.data,
        "seed": cell.seed,
        "dt": experiment.data_set(cell.data).dt,
        "profile": effort.profile,
        "commit": commit(),
        "hardware": hardware(),
        "versions": {"python": platform.python_version(), **versions()},
    }
    if cell.row not in experiment.untrained:
        record |= {"demonstrations": experiment.size(cell, effort), "minutes": effort.minutes}
    try:
        found = experiment.run(cell, effort, place, update)
        record["values"] = {column: value if value - value == 0 else None for column, value in found.items()}
    except Busy:
        raise
    except SwarmError as error:
        record["failed"] = str(error)
    except Exception as error:  # a night of cells must not end with the first that breaks
        write_whole(place / "error.txt", traceback.format_exc())
        record["failed"] = f"{type(error).__name__}: {error}".splitlines()[0] + f" (see {place / 'error.txt'})"
    steps, seconds = spent(place)
    if steps:  # nothing is said of networks that were trained outside the cell, which figures 5.2 to 5.4 share
        record |= {"steps": steps, "training_seconds": seconds}
    return record | {
        "wall_seconds": before + time.monotonic() - begun,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def claim(folder: Path, effort: Effort) -> None:
    """Records what cells may spend, or raises SwarmError where others of this folder spent something else."""
    settings = {"demonstrations": effort.demonstrations, "test_scenes": effort.test_scenes, "minutes": effort.minutes}
    with locked(folder / "effort.lock", wait=True):
        had = claimed(folder)
        if not had:
            write_whole(folder / EFFORT, json.dumps(settings, indent=1))
            return
    different = [f"{key} {had.get(key)!r} -> {value!r}" for key, value in settings.items() if had.get(key) != value]
    if different:
        raise SwarmError(
            f"{folder}: its cells spend something else ({', '.join(different)}); give the same, or another --out"
        )


def claimed(folder: Path) -> dict:
    """What the cells of a folder may spend; nothing where there are none."""
    path = folder / EFFORT
    return json.loads(path.read_text()) if path.exists() else {}


def write_record(place: Path, record: dict) -> None:
    """Writes cell.json."""
    write_whole(place / RECORD, json.dumps(record, indent=1) + "\n")


def read_record(place: Path) -> dict | None:
    """A cell's cell.json; None where it has none yet."""
    path = place / RECORD
    return json.loads(path.read_text()) if path.exists() else None


def records(experiment: Experiment, folder: Path) -> list[tuple[Cell, dict]]:
    """All cells of the experiment that have a record, of any seed, in the order of rows, data sets and seeds."""
    found = []
    for row in experiment.rows:
        for data in experiment.data_sets:
            where = Cell(row, data.name, 0).path(folder).parent
            seeds = sorted(int(path.parent.name.removeprefix("seed-")) for path in where.glob(f"seed-*/{RECORD}"))
            cells = [Cell(row, data.name, seed) for seed in seeds]
            found += [(cell, record) for cell in cells if (record := read_record(cell.path(folder)))]
    return found
