"""The common record of every reader: rows of one run in metres and seconds, and what was declared or read of them."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from envs.importers.config import KINDS, LENGTHS, TIMES, ImportConfig
from envs.trajectories import AGENT
from swarm_mjcf.errors import SwarmError

HEIGHT = 0.5
"""A height that changes by more than this [m] within one person is no bobbing head: stairs, or flight."""
Update = Callable[[int, int, str], None]
"""Called with (done, total, what is being done)."""


class ImportFailed(SwarmError):
    """A file of recorded trajectories cannot be used as it is; the message says what, where, and what to do."""


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """Rows of one run, by id and then by time. `tracks_of` makes and checks it."""

    name: str
    """File, and run where it has several."""
    time: Float[np.ndarray, " n"]
    """[s]"""
    id: Int[np.ndarray, " n"]
    """Index into `labels`."""
    position: Float[np.ndarray, "n 2"]
    """[m]"""
    kind: Int[np.ndarray, " P"]
    """GOAL, OBSTACLE or AGENT, of each label."""
    labels: tuple[str, ...]
    """What the file calls them."""
    velocity: Float[np.ndarray, "n 2"] | None = None
    """The file's own [m/s], where it has them."""
    edges: Int[np.ndarray, "P P"] | None = None
    """Edge types (source, target), where the file has them."""
    facts: dict[str, str] = field(default_factory=dict)
    """What was declared and what was read, for people."""


def tracks_of(
    name: str,
    *,
    time: np.ndarray,
    id: np.ndarray,
    position: Float[np.ndarray, "n 2"],
    facts: dict[str, str],
    kind: np.ndarray | None = None,
    velocity: Float[np.ndarray, "n 2"] | None = None,
) -> Tracks:
    """Checks rows in the order of the file and sorts them. Times are in s, positions in m; `kind` is one per row.

    Raises:
      ImportFailed: no rows, a value that is not finite, two rows of one id at one time, time that goes backwards
        within an id, or an id of two types.
    """
    if not len(time):
        raise ImportFailed(f"{name}: no rows of data")
    labels, code = numbered(id)
    columns = {"t": time, "x": position[:, 0], "y": position[:, 1]}
    if id.dtype.kind == "f":
        columns["id"] = id
    if velocity is not None:
        columns |= {"vx": velocity[:, 0], "vy": velocity[:, 1]}
    for column, values in columns.items():
        bad = ~np.isfinite(values)
        if bad.any():
            row = int(np.argmax(bad))
            raise ImportFailed(
                f"{name}: {column} is {values[row]} in {int(bad.sum())} of {len(values)} rows, first in data row "
                f"{row + 1} (id {labels[code[row]]}); leave such rows out, and choose what to do with gaps (--gap)"
            )
    order = np.lexsort((time, code))
    twice = (np.diff(code[order]) == 0) & (np.diff(time[order]) == 0)
    if twice.any():
        row = int(order[np.argmax(twice)])
        raise ImportFailed(
            f"{name}: {int(twice.sum())} rows repeat an id at a time, first id {labels[code[row]]} at t = "
            f"{time[row]:g} s; take them out, or tell several runs apart: files of their own, or a column run"
        )
    as_given = np.argsort(code, kind="stable")
    back = (np.diff(code[as_given]) == 0) & (np.diff(time[as_given]) < 0)
    if back.any():
        at = int(np.argmax(back))
        row, after = int(as_given[at]), int(as_given[at + 1])
        raise ImportFailed(
            f"{name}: time goes backwards for id {labels[code[row]]}, from {time[row]:g} s in data row {row + 1} to "
            f"{time[after]:g} s in data row {after + 1}; sort the file by time, or give ids that are not used twice"
        )
    of_label = np.full(len(labels), AGENT, np.int8)
    if kind is not None:
        of_label[code] = kind
        two = kind != of_label[code]
        if two.any():
            row = int(np.argmax(two))
            names = sorted({KINDS[kind[row]], KINDS[of_label[code[row]]]})
            raise ImportFailed(f"{name}: id {labels[code[row]]} is {' and '.join(names)}, a type must stay the same")
    return Tracks(
        name=name,
        time=np.asarray(time, np.float64)[order],
        id=code[order],
        position=np.asarray(position, np.float64)[order],
        kind=of_label,
        labels=labels,
        velocity=None if velocity is None else np.asarray(velocity, np.float64)[order],
        facts=facts,
    )


def numbered(ids: np.ndarray) -> tuple[tuple[str, ...], Int[np.ndarray, " n"]]:
    """Labels and each row's index into them; numbers are in the order of numbers, words as the alphabet has them."""
    found, code = np.unique(ids, return_inverse=True)
    try:
        rank = np.argsort(found.astype(np.float64), kind="stable")
    except ValueError:
        rank = np.arange(len(found))
    place = np.empty(len(found), np.int64)
    place[rank] = np.arange(len(found))
    return tuple(label(x) for x in found[rank]), place[code.reshape(-1)]


def label(value: Any) -> str:
    """A name as people write it: whole numbers without a point."""
    return str(int(value)) if isinstance(value, np.floating) and value.is_integer() else str(value)


def length(name: str, config: ImportConfig, said: str | None, *, where: str = "header") -> tuple[float, str]:
    """Metres in the unit of positions, and what to say of it. `said` is what the file says, None for nothing."""
    return _scale(name, "unit of positions", "--unit", config.unit, said, LENGTHS, where)


def unit_facts(said: dict[str, str]) -> dict[str, str]:
    """What to say of the units of x and y."""
    if said["x"] == said["y"]:
        return {"unit": said["x"]}
    return {"unit of x": said["x"], "unit of y": said["y"]}


def seconds(name: str, config: ImportConfig, said: str | None, *, where: str = "header") -> tuple[float, str]:
    """Seconds in the unit of the column t; frames by --fps."""
    if (said or config.time_unit) == "frame":
        rate, fact = frame_rate(name, config, None)
        return 1 / rate, f"frame numbers at {fact}"
    if said is None and config.time_unit is None:
        raise ImportFailed(
            f"{name}: does not say the unit of times; give --time-unit, one of {', '.join(TIMES)}, or frame with --fps"
        )
    return _scale(name, "unit of times", "--time-unit", config.time_unit, said, TIMES, where)


def frame_rate(name: str, config: ImportConfig, said: float | None, *, where: str = "header") -> tuple[float, str]:
    """Frame numbers per second, and what to say of it. Raises ImportFailed when nobody says, or two say otherwise."""
    if said is not None:
        if not 0 < said < np.inf:
            raise ImportFailed(f"{name}: its {where} says {said:g} frames per second")
        if config.fps is not None and not np.isclose(config.fps, said, rtol=1e-6):
            raise ImportFailed(f"{name}: its {where} says {said:g} frames per second, --fps says {config.fps:g}")
        return float(said), f"{said:g} fps ({where})"
    if config.fps is None:
        raise ImportFailed(f"{name}: does not say how many frames a second has; give --fps")
    return config.fps, f"{config.fps:g} fps (declared)"


def _scale(
    name: str, what: str, option: str, declared: str | None, said: str | None, known: dict[str, float], where: str
) -> tuple[float, str]:
    if said is not None:
        if said not in known:
            raise ImportFailed(f"{name}: its {where} says {what} '{said}', known are {', '.join(known)}")
        if declared is not None and declared != said:
            raise ImportFailed(f"{name}: its {where} says {said}, {option} says {declared}")
        return known[said], f"{said} ({where})"
    if declared is None:
        raise ImportFailed(f"{name}: does not say the {what}; give {option}, one of {', '.join(known)}")
    return known[declared], f"{declared} (declared)"


def height_fact(name: str, height: Float[np.ndarray, " n"], id: np.ndarray) -> str:
    """What is said of a third coordinate [m], which is left out: people's height, or motion that is no longer flat."""
    if not np.isfinite(height).all():
        raise ImportFailed(f"{name}: z is not finite in some rows; leave the column out (it is not used)")
    _, code = numbered(id)
    low, high = np.full(code.max() + 1, np.inf), np.full(code.max() + 1, -np.inf)
    np.minimum.at(low, code, height)
    np.maximum.at(high, code, height)
    most = float((high - low).max())
    if most > HEIGHT:
        return f"left out although it varies by up to {most:.3g} m within one id: only the motion in the plane is kept"
    return f"left out, varies by at most {most:.3g} m within an id"


def readable(path: Path) -> int:
    """Size of a file that can be opened. Raises ImportFailed for one that is missing or empty."""
    if not path.exists():
        raise ImportFailed(f"{path}: does not exist")
    if path.is_dir():
        raise ImportFailed(f"{path}: is a folder; name the files in it")
    if not (size := path.stat().st_size):
        raise ImportFailed(f"{path}: is empty")
    return size
