"""Long tables with named columns `t,id,x,y[,type][,run]`, whatever they are stored in: rows by column -> runs."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from envs.importers.config import FIELDS, KINDS, LENGTHS, ImportConfig
from envs.importers.tracks import ImportFailed, Tracks, height_fact, length, numbered, seconds, tracks_of, unit_facts

_UNIT = r"\s*(\w+(?:\s*/\s*\w+)?)\s*"
_WITH_UNIT = re.compile(rf"^\s*(.+?)\s*(?:/{_UNIT}|\[{_UNIT}\]|\({_UNIT}\))\s*$")
TEXT = ("id", "type", "run")
"""Columns that may hold words."""


@dataclass(frozen=True)
class Column:
    """One of our columns in a file: its name there, and the unit that its header or type tells."""

    name: str
    unit: str | None = None


def find_columns(path: str, names: Sequence[str], config: ImportConfig) -> dict[str, Column]:
    """Our column -> where the file has it. Headers may tell units, as in `x/cm`, `x [cm]`, `x (cm)` or `vx [cm/s]`.

    Raises ImportFailed for a column that is missing, or is named but not there.
    """
    twice = [name for at, name in enumerate(names) if name in names[:at]]
    if twice:
        raise ImportFailed(f"{path}: has the column {twice[0]!r} more than once")
    full = {name: name for name in names}
    for name in names:
        if found := _WITH_UNIT.match(name):
            full.setdefault(found.group(1), name)
    mapped = config.named_columns()
    columns = {}
    for ours in FIELDS:
        theirs = mapped.get(ours, ours)
        if theirs in full:
            found = _WITH_UNIT.match(full[theirs])
            columns[ours] = Column(full[theirs], next(filter(None, found.groups()[1:])) if found else None)
        elif ours in mapped:
            raise ImportFailed(f"{path}: has no column {theirs!r}; it has {_listed(names)}")
    if "t" in columns and "frame" in columns:
        del columns["frame"]
    missing = [name for name in ("id", "x", "y") if name not in columns]
    if not {"t", "frame"} & set(columns):
        missing.insert(0, "t (or frame)")
    if missing:
        hint = ""
        if all(_is_number(name) for name in names):
            hint = " (its first line holds numbers: a line with the columns' names is missing)"
        raise ImportFailed(
            f"{path}: no column {', '.join(missing)} among {_listed(names)}{hint}; say which is which, such as "
            "--columns t=time id=ped"
        )
    return columns


def runs_of(
    path: str,
    name: str,
    columns: Mapping[str, Column],
    values: Mapping[str, np.ndarray],
    config: ImportConfig,
    facts: dict[str, str],
) -> list[Tracks]:
    """The runs of a table. `values` holds arrays by our column names: text for id, type and run, else float64."""
    if not len(values["id"]):
        raise ImportFailed(f"{path}: no rows of data")
    units = {ours: column.unit for ours, column in columns.items()}
    clock = "t" if "t" in columns else "frame"
    if clock == "t" and config.fps is not None and "frame" not in (units["t"], config.time_unit):
        raise ImportFailed(
            f"{path}: --fps says {config.fps:g} frames per second, and column {columns['t'].name!r} holds times; leave "
            "--fps out, or say that it counts frames: --time-unit frame"
        )
    if clock == "frame" and config.time_unit not in (None, "frame"):
        raise ImportFailed(
            f"{path}: --time-unit says {config.time_unit}, and the only clock is column {columns['frame'].name!r}, "
            f"which counts frames; leave --time-unit out, or say that it holds times: --columns "
            f"t={columns['frame'].name}"
        )
    to_seconds, time_fact = seconds(path, config, "frame" if clock == "frame" else units["t"])
    scale, said = {}, {}
    for axis in ("x", "y", *(("z",) if "z" in columns else ())):
        scale[axis], said[axis] = length(path, config, units[axis])
    facts |= {"times": time_fact, **unit_facts(said)}
    position = np.stack([values["x"] * scale["x"], values["y"] * scale["y"]], axis=1)
    velocity = None
    if config.velocity == "file" and "vx" in columns and "vy" in columns:
        speed = {axis: _speed(path, units[f"v{axis}"]) or scale[axis] for axis in ("x", "y")}
        velocity = np.stack([values["vx"] * speed["x"], values["vy"] * speed["y"]], axis=1)
        if told := [f"{unit} ({name})" for name in ("vx", "vy") if (unit := units[name])]:
            facts["unit of velocities"] = ", ".join(told)
    kind = _kinds(path, values["type"], config) if "type" in columns else None
    if "run" not in columns:
        runs, of_run = ("",), np.zeros(len(values["id"]), np.int64)
    else:
        runs, of_run = numbered(values["run"])
    if "z" in columns:
        _, person = numbered(values["id"])
        facts["z"] = height_fact(path, values["z"] * scale["z"], person * len(runs) + of_run)
    order = np.argsort(of_run, kind="stable")
    ends = np.cumsum(np.bincount(of_run, minlength=len(runs)))
    return [
        tracks_of(
            f"{name} run {run}" if run else name,
            time=values[clock][rows] * to_seconds,
            id=values["id"][rows],
            position=position[rows],
            velocity=None if velocity is None else velocity[rows],
            kind=None if kind is None else kind[rows],
            facts=facts,
        )
        for run, rows in zip(runs, np.split(order, ends[:-1]), strict=True)
    ]


def _speed(path: str, said: str | None) -> float | None:
    """m/s in a header's unit of velocities; None where it says none, then they are in the unit of positions, per s."""
    if said is None:
        return None
    unit, _, per = (word.strip() for word in said.partition("/"))
    if unit not in LENGTHS or per != "s":
        known = ", ".join(f"{unit}/s" for unit in LENGTHS)
        raise ImportFailed(f"{path}: its header says unit of velocities '{said}', known are {known}")
    return LENGTHS[unit]


def _kinds(path: str, types: np.ndarray, config: ImportConfig) -> np.ndarray:
    known = config.kind_names()
    found, code = np.unique(types, return_inverse=True)
    unknown = [str(word) for word in found if str(word) not in known]
    if unknown:
        raise ImportFailed(
            f"{path}: types {_listed(unknown)} are none of {', '.join(KINDS)}; say what they are, such as --types "
            f"{unknown[0]}=agent"
        )
    return np.asarray([KINDS.index(known[str(word)]) for word in found], np.int8)[code.reshape(-1)]


def _listed(names: Sequence[str], most: int = 12) -> str:
    return ", ".join(map(repr, names[:most])) + (f" and {len(names) - most} more" if len(names) > most else "")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
