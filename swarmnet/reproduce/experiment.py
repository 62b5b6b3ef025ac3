"""What an experiment is: rows x data sets x seeds make cells; a cell is one resumable job that gives its columns."""

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from swarm_mjcf.errors import SpecError
from swarmnet.progress import Update

REGISTRY: dict[str, str] = {
    "table-3.1": "swarmnet.reproduce.table_3_1:TABLE_3_1",
    "table-3.2": "swarmnet.reproduce.table_3_2:TABLE_3_2",
    "table-4.1": "swarmnet.reproduce.table_4_1:TABLE_4_1",
    "table-4.2": "swarmnet.reproduce.table_4_2:TABLE_4_2",
    "table-4.3": "swarmnet.reproduce.table_4_3:TABLE_4_3",
    "figure-3.5": "swarmnet.reproduce.figures_3:FIGURE_3_5",
    "figure-3.6": "swarmnet.reproduce.figures_3:FIGURE_3_6",
    "figure-3.7": "swarmnet.reproduce.figures_3:FIGURE_3_7",
    "figure-3.8": "swarmnet.reproduce.figures_3:FIGURE_3_8",
    "figure-3.9": "swarmnet.reproduce.figure_3_9:FIGURE_3_9",
    "figure-4.2": "swarmnet.reproduce.figures_4:FIGURE_4_2",
    "figure-4.3": "swarmnet.reproduce.figures_4:FIGURE_4_3",
    "figure-4.4": "swarmnet.reproduce.figures_4:FIGURE_4_4",
    "figure-4.5": "swarmnet.reproduce.figures_4:FIGURE_4_5",
    "figure-5.1": "swarmnet.reproduce.figure_5_1:FIGURE_5_1",
    "figure-5.2": "swarmnet.reproduce.figures_5:FIGURE_5_2",
    "figure-5.3": "swarmnet.reproduce.figures_5:FIGURE_5_3",
    "figure-5.4": "swarmnet.reproduce.figures_5:FIGURE_5_4",
    "table-6.1": "swarmnet.reproduce.table_6_1:TABLE_6_1",
    "aggregation": "swarmnet.reproduce.aggregation:AGGREGATION",
    "control": "swarmnet.reproduce.control:CONTROL",
}
"""Experiments by name, as `module:ATTRIBUTE`, imported when asked for."""


@dataclass(frozen=True)
class DataSet:
    """One family of trajectories and the columns of the table that a cell on it fills."""

    name: str
    columns: tuple[str, ...]
    dt: float = 0.3
    """Control step [s]."""


@dataclass(frozen=True)
class Cell:
    """One job: a row of the table on one data set with one seed (of data and weights)."""

    row: str
    data: str
    seed: int

    def __str__(self) -> str:
        return f"{self.row} / {self.data} / seed {self.seed}"

    def path(self, folder: Path) -> Path:
        """Its own folder below that of the experiment."""
        return folder / self.row.replace("/", "-") / self.data.replace("/", "-") / f"seed-{self.seed}"


@dataclass(frozen=True, kw_only=True)
class Effort:
    """What a cell may spend; the same for every row."""

    profile: str
    demonstrations: int
    """Runs simulated to learn from, the 5% kept out for validation among them."""
    test_scenes: int
    """Unseen runs to test on."""
    minutes: float
    """Training of one cell [min]."""
    data: Path
    """Folder that simulated data sets are kept in, shared by all experiments."""


@dataclass(frozen=True, kw_only=True)
class Profile:
    """How much is spent on a whole experiment."""

    seeds: tuple[int, ...]
    demonstrations: int
    test_scenes: int
    minutes: float | None
    """Training per cell [min]; None: `QUICK_MINUTES` shared by all cells that train."""


QUICK_MINUTES = 6.0
"""Training of a whole experiment in profile quick [min]."""
PROFILES = {
    "quick": Profile(seeds=(0,), demonstrations=1000, test_scenes=100, minutes=None),
    "cpu": Profile(seeds=(0, 1, 2), demonstrations=5000, test_scenes=500, minutes=5.0),
    "full": Profile(seeds=(0, 1, 2), demonstrations=50_000, test_scenes=500, minutes=60.0),
}

Run = Callable[[Cell, Effort, Path, Update], dict[str, float]]
"""`run(cell, effort, folder, progress) -> {column: value}`: does the cell in its folder, or goes on with it. What it
leaves in the folder it finds there again after an interruption; `swarmnet.reproduce.work` has the parts."""
Figure = Callable[[Path, Sequence[tuple[Cell, dict]]], list[Path]]
"""`figure(folder, done) -> files`: draws what the finished cells (with their `cell.json`) show, into `folder`, the
experiment's own; `cell.path(folder)` has what the cell left."""


def _everywhere(row: str, data: str) -> bool:
    return True


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """A table or figure of the thesis, or an argument of its text."""

    name: str
    about: str
    """One line."""
    rows: tuple[str, ...]
    data_sets: tuple[DataSet, ...]
    run: Run
    references: Mapping[tuple[str, str], float] = field(default_factory=dict)
    """The thesis's figures by (row, column)."""
    leading: tuple[str, ...] = ()
    """Rows whose cells come first, with all seeds; the others follow seed by seed."""
    untrained: tuple[str, ...] = ()
    """Rows that learn nothing: one cell for each data set, whatever the seeds, and no share of the minutes."""
    exists: Callable[[str, str], bool] = _everywhere
    """Whether a (row, data set) makes sense; by default every one."""
    in_quick: Callable[[str, str], bool] = _everywhere
    """Whether profile quick does it: what it leaves out has no share of its minutes."""
    size: Callable[["Cell", Effort], int] = lambda cell, effort: effort.demonstrations
    """Demonstrations that a cell learns from."""
    unit: str = "normalized MSE"
    notes: str = ""
    """What a reader must know, printed below the table."""
    figure: Figure | None = None

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns, in the order of the data sets."""
        return tuple(column for data in self.data_sets for column in data.columns)

    def reference(self, row: str, column: str) -> float | None:
        """The thesis's figure, None where it has none."""
        return self.references.get((row, column))

    def data_set(self, name: str) -> DataSet:
        """A data set by name. Raises SpecError."""
        for data in self.data_sets:
            if data.name == name:
                return data
        raise SpecError("data set", name, "one of " + ", ".join(data.name for data in self.data_sets))

    def cells(self, seeds: Sequence[int], rows: Sequence[str] = (), columns: Sequence[str] = ()) -> list[Cell]:
        """The jobs in the order of their work. `columns` names columns or data sets; nothing means all.

        Raises SpecError for a row or a column that does not exist.
        """
        for row in rows:
            if row not in self.rows:
                raise SpecError("rows", row, "some of " + ", ".join(repr(known) for known in self.rows))
        known = (*self.columns, *(data.name for data in self.data_sets))
        for column in columns:
            if column not in known:
                raise SpecError("columns", column, "some of " + ", ".join(map(repr, dict.fromkeys(known))))
        wanted = set(columns) or set(known)
        kept = [data.name for data in self.data_sets if wanted & {data.name, *data.columns}]
        rows = rows or self.rows
        first = [(row, seed) for row in rows if row in self.leading for seed in seeds]
        then = [(row, seed) for seed in seeds for row in rows if row not in (*self.leading, *self.untrained)]
        last = [(row, 0) for row in rows if row in self.untrained]
        order = (*first, *then, *last)
        return [Cell(row, data, seed) for row, seed in order for data in kept if self.exists(row, data)]

    def effort(self, profile: str, data: Path, minutes: float | None = None) -> Effort:
        """What every cell may spend in a profile; `minutes` of training overrides. Raises SpecError."""
        if profile not in PROFILES:
            raise SpecError("profile", profile, "one of " + ", ".join(PROFILES))
        chosen = PROFILES[profile]
        cells = self.cells(chosen.seeds)
        shares = sum(cell.row not in self.untrained and self.in_quick(cell.row, cell.data) for cell in cells)
        return Effort(
            profile=profile,
            demonstrations=chosen.demonstrations,
            test_scenes=chosen.test_scenes,
            minutes=minutes or chosen.minutes or QUICK_MINUTES / max(shares, 1),
            data=data,
        )


def find(name: str) -> Experiment:
    """An experiment by name. Raises SpecError for one that does not exist."""
    if name not in REGISTRY:
        raise SpecError("name", name, "one of " + ", ".join(REGISTRY))
    module, attribute = REGISTRY[name].split(":")
    found: Any = getattr(importlib.import_module(module), attribute)
    return found
