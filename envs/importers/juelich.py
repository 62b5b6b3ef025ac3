"""Text files of Forschungszentrum Juelich (PeTrack, JuPedSim): `# framerate: 25 fps`, `# id frame x/cm y/cm z/cm`."""

import re
from pathlib import Path

from envs.importers.config import ImportConfig
from envs.importers.text import numeric_table
from envs.importers.tracks import ImportFailed, Tracks, Update, frame_rate, height_fact, length, tracks_of, unit_facts

SHAPE = "the columns id frame x y [z]"
_BRACKETED = re.compile(r"(?<=\S)\s*[\[(]([^\s\[\]()]+)[\])]")
_RATE = re.compile(r"frame\s*rate\s*[:=]?\s*([0-9.eE+-]+)", re.IGNORECASE)
_NAMES = {
    "id": ("id", "persid", "pers_id", "personid", "ped"),
    "frame": ("frame", "fr"),
    "x": ("x",),
    "y": ("y",),
    "z": ("z",),
}
_OURS = {theirs: ours for ours, names in _NAMES.items() for theirs in names}
_NEEDED = ("id", "frame", "x", "y")


def read(path: Path, config: ImportConfig, update: Update) -> list[Tracks]:
    """One run. Units are read per column, so x in cm beside y in m is converted as it says.

    Raises ImportFailed where neither header nor option tells frame rate and units, or the header tells two rates.
    """
    comments, table = numeric_table(path, update, least=4, shape=SHAPE)
    rates: set[float] = set()
    for comment in comments:
        if found := _RATE.search(comment):
            try:
                rates.add(float(found.group(1)))
            except ValueError as error:
                raise ImportFailed(f"{path}: its header has no number of frames in {comment!r}") from error
    if len(rates) > 1:
        raise ImportFailed(
            f"{path}: its header names several frame rates: {', '.join(f'{r:g}' for r in sorted(rates))}"
        )
    place, units = _columns(path, comments, table.shape[1])
    rate, rate_fact = frame_rate(str(path), config, rates.pop() if rates else None)
    scales, said_of = {}, {}
    for axis in ("x", "y"):
        scales[axis], said_of[axis] = length(str(path), config, units.get(axis))
    facts = {"format": "Juelich text", "frame rate": rate_fact, **unit_facts(said_of)}
    if "z" in place and place["z"] < table.shape[1]:
        scale = length(str(path), config, units["z"])[0] if "z" in units else scales["x"]
        facts["z"] = height_fact(str(path), table[:, place["z"]] * scale, table[:, place["id"]])
    position = table[:, [place["x"], place["y"]]] * [scales["x"], scales["y"]]
    return [
        tracks_of(
            path.name, time=table[:, place["frame"]] / rate, id=table[:, place["id"]], position=position, facts=facts
        )
    ]


def _columns(path: Path, comments: list[str], width: int) -> tuple[dict[str, int], dict[str, str]]:
    """Where each column stands, and its unit where the header says one (x/m, x[m], x [m], x (m)); id frame x y z
    without a header. Raises ImportFailed for a header that lacks a column, names one twice, or names more than the rows
    have."""
    partial = None
    for comment in reversed(comments):
        words = [word.partition("/") for word in _BRACKETED.sub(r"/\1", comment).split()]
        names = [_OURS.get(name.lower(), "") for name, _, _ in words]
        if set(_NEEDED) <= set(names):
            if len(names) > width:
                raise ImportFailed(
                    f"{path}: rows have {width} columns, its header names {len(names)}: {comment.strip()}"
                )
            if twice := [name for name in _NAMES if names.count(name) > 1]:
                raise ImportFailed(f"{path}: its header names {twice[0]} more than once: {comment.strip()}")
            return (
                {name: at for at, name in enumerate(names) if name},
                {name: unit.lower() for name, (_, _, unit) in zip(names, words, strict=True) if name and unit},
            )
        header = len(names) == width and {"x", "y"} <= set(names)  # or prose about x and y
        if header or ("id" in names and {"x", "frame"} & set(names)):
            partial = partial or (comment.strip(), [name for name in _NEEDED if name not in names])
    if partial:  # the usual order would be a guess
        known = ", ".join(f"{name} (known are {', '.join(_NAMES[name])})" for name in partial[1])
        raise ImportFailed(f"{path}: its header names no column for {known}: {partial[0]}")
    return {"id": 0, "frame": 1, "x": 2, "y": 3, "z": 4}, {}
