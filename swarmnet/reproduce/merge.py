"""Finished cells as one document in the common format, and as a table for people, beside the thesis's figures."""

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

from swarmnet.reproduce.cells import records
from swarmnet.reproduce.elsewhere import carried
from swarmnet.reproduce.experiment import Cell, Experiment
from swarmnet.results import Results, Row, span, uneven, unfinished


def merge(experiment: Experiment, planned: Sequence[Cell], folder: Path, *, profile: str, command: str) -> Results:
    """The document of all finished cells below `folder`; those of `planned` that are not are named as missing."""
    found = records(experiment, folder)
    done = [(cell, record) for cell, record in found if "values" in record]
    have = {cell for cell, _ in found}
    return Results(
        name=experiment.name,
        rows=[
            made
            for row in experiment.rows
            for data in experiment.data_sets
            for column in data.columns
            if (made := _row(experiment, row, column, [r for c, r in done if (c.row, c.data) == (row, data.name)]))
        ],
        dt=_only(data.dt for data in experiment.data_sets),
        seeds=sorted({cell.seed for cell, _ in done}),
        profile=profile,
        more={
            "command": command,
            **_origin([record for _, record in done]),
            **({"notes": experiment.notes} if experiment.notes else {}),
            "missing": [asdict(cell) for cell in planned if cell not in have],
            "failed": [asdict(cell) | {"reason": record["failed"]} for cell, record in found if "failed" in record],
            "cells": carried([record for _, record in done]),
        },
    )


def _row(experiment: Experiment, row: str, column: str, cells: list[dict]) -> Row | None:
    """Mean and standard deviation (ddof 1) over the seeds; a prediction that overflowed in any of them has none."""
    cells = [record for record in cells if column in record["values"]]
    if not cells:
        return None
    values = [record["values"][column] for record in cells]
    sound = [value for value in values if value is not None]
    whole = len(sound) == len(values)
    return Row(
        row,
        column,
        statistics.fmean(sound) if whole else float("nan"),
        std=statistics.stdev(sound) if whole and len(sound) > 1 else None,
        reference=experiment.reference(row, column),
        unit=experiment.unit,
        more={
            "n": len(values),
            "seeds": [record["seed"] for record in cells],
            "profile": cells[0]["profile"],
            "dt": cells[0]["dt"],
            "demonstrations": _only(record.get("demonstrations") for record in cells),
            "minutes": _only(record.get("minutes") for record in cells),
            "steps": [record["steps"] for record in cells if record.get("steps")],
            "wall_seconds": round(statistics.fmean(record["wall_seconds"] for record in cells), 1),
            **({} if whole else {"diverged": len(values) - len(sound)}),
        },
    )


def _origin(done: list[dict]) -> dict:
    """Commit, machine and versions that the cells were run with, the commonest first where they differ."""
    if not done:
        return {}
    machines = _by_frequency([record["hardware"] for record in done])
    return {
        "commit": ", ".join(_by_frequency([str(record["commit"]) for record in done])),
        "hardware": machines[0],
        **({"also_on": machines[1:]} if len(machines) > 1 else {}),
        "versions": _by_frequency([record["versions"] for record in done])[0],
    }


def _by_frequency[T](values: list[T]) -> list[T]:
    distinct = [value for at, value in enumerate(values) if value not in values[:at]]
    return sorted(distinct, key=values.count, reverse=True)


def _only[T](values: Iterable[T]) -> T | None:
    """What all of them are; None where they differ."""
    distinct = set(values)
    return distinct.pop() if len(distinct) == 1 else None


def table(results: Results) -> str:
    """The document for a terminal: for every column the rows, ours beside the thesis's."""
    machine, lines = results.more.get("hardware"), []
    if results.profile == "quick":
        lines.append("SMOKE RUN (profile quick): not to be quoted")
    width = max([len(row.row) for row in results.rows], default=0)
    for column in dict.fromkeys(row.column for row in results.rows):
        rows = [row for row in results.rows if row.column == column]
        lines += ["", f"{column}  [{rows[0].unit}, dt {rows[0].more['dt']:g} s]"]
        lines.append(
            f"  {'':{width}}  {'ours':>22}  {'n':>2}  {'thesis':>9}  {'demos':>6}  {'min':>5}  {'wall s':>7}  "
            f"{'steps':>16}"
        )
        lines += [f"  {row.row:{width}}  {_figures(row)}" for row in rows]
    lines += [f"\n{text}" for text in uneven([asdict(row) | row.more for row in results.rows])]
    if machine:
        origin = results.more
        lines += ["", f"{machine['cpu']}, {machine['cores']} cores, {', '.join(machine['devices'])}"
                  f"{', and other machines' if 'also_on' in origin else ''}; commit {origin['commit']}"]  # fmt: skip
    if results.more.get("notes"):
        lines.append(results.more["notes"])
    lines += unfinished(results.more)
    return "\n".join(lines).lstrip("\n")


def _figures(row: Row) -> str:
    ours = "diverged" if row.value != row.value else f"{row.value:.4g}"
    ours += "" if row.std is None else f" ± {row.std:.2g}"
    thesis = "" if row.reference is None else f"{row.reference:.4g}"
    minutes = "" if row.more["minutes"] is None else f"{row.more['minutes']:.3g}"
    demonstrations = "" if row.more["demonstrations"] is None else row.more["demonstrations"]
    steps = span(row.more["steps"])
    return (
        f"{ours:>22}  {row.more['n']:>2}  {thesis:>9}  {demonstrations:>6}  {minutes:>5}  "
        f"{row.more['wall_seconds']:>7.0f}  {steps:>16}"
    )
