"""Which recordings are shown: some scenes of one file, or one scene as several files recorded it."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from envs.storage import Header, read_header, stream
from envs.trajectories import Trajectories
from swarm_mjcf.errors import SpecError, SwarmError
from swarmnet.film import Panel

MAX_FILES = 4
"""Recordings that are compared at most."""


@dataclass(frozen=True)
class Selection:
    """Panels and how they are laid out."""

    panels: list[Panel]
    columns: int
    compared: bool
    """Whether the panels are several recordings of one scene."""


def select(
    files: Sequence[str | Path], *, scenes: Sequence[int] = (0,), grid: str | None = None, titles: Sequence[str] = ()
) -> Selection:
    """Reads what is to be shown.

    One file: its scenes, or with a grid as many as it has panels, from the first given on. Several files: one scene of
    each, all from the same start; the first is dashed in the others.

    Args:
      files: 1 to 4 files of trajectories.
      scenes: numbers of scenes.
      grid: "ROWSxCOLUMNS"; None lays panels out as squarely as their number allows.
      titles: names of the files' recordings; what the files say themselves by default.

    Raises:
      SpecError: a number is out of range, says which and what is allowed.
      SwarmError: files cannot be read, or do not hold the same scenes.
    """
    paths = [Path(file) for file in files]
    if not 1 <= len(paths) <= MAX_FILES:
        raise SpecError("data", f"{len(paths)} files", f"1 to {MAX_FILES} files")
    if titles and len(titles) != len(paths):
        raise SpecError("titles", tuple(titles), f"one for each of {len(paths)} files, or none")
    if not scenes:
        raise SpecError("scene", tuple(scenes), "at least one number")
    headers = [read_header(path) for path in paths]
    rows, columns = _layout(grid, len(paths) if len(paths) > 1 else len(scenes))
    if len(paths) == 1 and grid is not None and len(scenes) == 1:
        scenes = _from(scenes[0], rows * columns, headers[0], grid)
    for scene in scenes:
        _need_scene(headers[0], scene)
    if len(paths) == 1:
        panels = [
            Panel(recording, " · ".join((*titles, f"scene {scene}")))
            for scene, recording in zip(scenes, read_scenes(paths[0], scenes), strict=True)
        ]
        if len(panels) == 1 and not titles:
            panels = [Panel(panels[0].recording, f"{_name(headers[0])} · {panels[0].title}")]
    else:
        panels = _compared(headers, scenes, titles or _names(headers))
    if len(panels) > rows * columns:
        raise SpecError("grid", grid, f"room for {len(panels)} panels")
    return Selection(panels, columns, len(paths) > 1)


def read_scenes(path: Path, scenes: Sequence[int]) -> list[Trajectories]:
    """Some scenes of a file, each by itself and in the given order; only what is wanted is held in memory."""
    found: dict[int, Trajectories] = {}
    first = 0
    for slab in stream(path):
        found |= {scene: slab.take([scene - first]) for scene in scenes if first <= scene < first + len(slab)}
        first += len(slab)
        if len(found) == len(set(scenes)):
            break
    return [found[scene] for scene in scenes]


def _compared(headers: Sequence[Header], scenes: Sequence[int], titles: Sequence[str]) -> list[Panel]:
    if len(scenes) > 1:
        raise SpecError("scene", tuple(scenes), "one scene when several files are compared")
    first, (scene,) = headers[0], scenes
    for header in headers[1:]:
        for what, one, other in (("scenes", first.scenes, header.scenes), ("rows", first.rows, header.rows)):
            if one != other:
                raise SwarmError(
                    f"{first.path} and {header.path} do not hold the same scenes: {one} {what} in one and {other} in "
                    "the other; record them from the same scenes and seed for the same number of steps"
                )
    recordings = [read_scenes(header.path, [scene])[0] for header in headers]
    for header, recording in zip(headers[1:], recordings[1:], strict=True):
        if found := difference(recordings[0], recording):
            raise SwarmError(f"{first.path} and {header.path} do not hold the same scenes: scene {scene} has {found}")
    named = [f"{title} · scene {scene}" for title in titles]
    rest = zip(recordings[1:], named[1:], strict=True)
    return [Panel(recordings[0], named[0]), *(Panel(r, n, recordings[0], titles[0]) for r, n in rest)]


def _layout(grid: str | None, panels: int) -> tuple[int, int]:
    """Rows and columns."""
    if grid is None:
        columns = panels if panels <= 3 else math.ceil(math.sqrt(panels))
        return math.ceil(panels / columns), columns
    found = re.fullmatch(r"([1-9]\d?)x([1-9]\d?)", grid)
    if found is None:
        raise SpecError("grid", grid, "ROWSxCOLUMNS with whole numbers from 1 to 99, such as 3x3")
    return int(found[1]), int(found[2])


def _from(first: int, count: int, header: Header, grid: str) -> range:
    """The scenes of a grid."""
    _need_scene(header, first)
    if first + count > header.scenes:
        left = header.scenes - first
        raise SpecError(
            "grid", grid, f"at most {left} panels: {header.path} holds {header.scenes} scenes, from {first} on {left}"
        )
    return range(first, first + count)


def _need_scene(header: Header, scene: int) -> None:
    if not 0 <= scene < header.scenes:
        only = "only scene 0" if header.scenes == 1 else f"{header.scenes} scenes, 0 to {header.scenes - 1}"
        raise SpecError("scene", scene, f"what {header.path} holds: {only}")


def difference(one: Trajectories, other: Trajectories) -> str | None:
    """In what two recordings of one scene differ before anything has moved, or None."""
    if one.dt != other.dt:
        return f"dt {one.dt:g} s in one and {other.dt:g} s in the other"
    if one.counts != other.counts:
        return f"{one.counts} goals, obstacles and agents in one and {other.counts} in the other"
    apart = np.abs(one.position[:, 0] - other.position[:, 0]).max()
    if (one.mask[:, 0] != other.mask[:, 0]).any() or apart > 1e-3:
        return f"other starts (up to {apart:.3g} m apart)"
    return None


def _names(headers: Sequence[Header]) -> list[str]:
    """Who steers in each recording; where two say the same, the file's name is added."""
    names = [_name(header) for header in headers]
    twice = [names.count(name) > 1 and name != header.path.stem for name, header in zip(names, headers, strict=True)]
    return [f"{n} ({h.path.stem})" if t else n for n, h, t in zip(names, headers, twice, strict=True)]


def _name(header: Header) -> str:
    """Who steers in a recording: what its maker wrote, or the file's name."""
    for key in ("policy", "expert"):
        if isinstance(about := header.provenance.get(key), str) and about:
            return about
    return header.path.stem
