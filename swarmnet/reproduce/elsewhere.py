"""Cells that ran on another machine, or whose folders are gone: the document of results carries what they found."""

import json
from collections.abc import Sequence
from pathlib import Path

from swarm_mjcf.errors import SwarmError
from swarmnet.reproduce.cells import claim, read_record, write_record
from swarmnet.reproduce.experiment import Cell, Effort, Experiment
from swarmnet.reproduce.lock import Busy, locked

ELSEWHERE = "elsewhere"
"""Marks a record without a folder of its own: it counts and is merged, and no figure is drawn of what it left."""
NEEDED = ("row", "data", "seed", "dt", "profile", "commit", "hardware", "versions", "wall_seconds", "values")


def carried(records: Sequence[dict]) -> list[dict]:
    """What a document says of each cell: its whole record."""
    return [{name: value for name, value in record.items() if name != ELSEWHERE} for record in records]


def adopt(experiment: Experiment, document: Path, effort: Effort, folder: Path) -> int:
    """Takes the finished cells of a document of the same experiment for done where `folder` has none of its own.

    Returns how many. Raises SwarmError, before anything is written, for a file that is no such document, for cells
    that the experiment does not have, and for cells that spent something else.
    """
    found = [(_cell(experiment, record, document), record) for record in _read(document, experiment.name)]
    for cell, record in found:
        had = {"profile": record["profile"]} | {name: record.get(name) for name in ("demonstrations", "minutes")}
        same = {"profile": effort.profile, "demonstrations": experiment.size(cell, effort), "minutes": effort.minutes}
        same = {name: value for name, value in same.items() if had[name] is not None}
        different = [f"{name} {had[name]!r} -> {value!r}" for name, value in same.items() if had[name] != value]
        if different:
            raise SwarmError(f"{document}: {cell} spent something else ({', '.join(different)}); give the same")
    claim(folder, effort)
    adopted = 0
    for cell, record in found:
        place = cell.path(folder)
        try:
            with locked(place / "cell.lock"):
                if "values" not in (read_record(place) or {}):
                    write_record(place, record | {ELSEWHERE: True})
                    adopted += 1
        except Busy:  # another process is about to have a better one
            continue
    return adopted


def _read(path: Path, name: str) -> list[dict]:
    """The cells of a document."""
    try:
        document = json.loads(path.read_text())
        other, cells = document["name"], document.get("cells")
    except OSError as error:
        raise SwarmError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise SwarmError(f"{path}: is no document of results, such as `swarmnet reproduce` writes") from error
    if other != name:
        raise SwarmError(f"{path}: has the results of {other!r}, not of {name!r}")
    if not cells:
        raise SwarmError(f"{path}: carries no cells, only their means; they have to be run again")
    return cells


def _cell(experiment: Experiment, record: dict, path: Path) -> Cell:
    lacking = [name for name in NEEDED if name not in record]
    if lacking:
        raise SwarmError(f"{path}: a cell lacks {', '.join(lacking)}")
    cell = Cell(record["row"], record["data"], record["seed"])
    if cell.row not in experiment.rows or cell.data not in {data.name for data in experiment.data_sets}:
        raise SwarmError(f"{path}: {experiment.name} has no cell {cell} (any more)")
    return cell
