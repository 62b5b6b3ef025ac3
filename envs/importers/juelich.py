"""Text files of Forschungszentrum Juelich (PeTrack, JuPedSim): `# framerate: 25 fps`, `# id frame x/cm y/cm z/cm`."""

import re
from pathlib import Path

from envs.importers.config import ImportConfig
from envs.importers.text import numeric_table
from envs.importers.tracks import ImportFailed, Tracks, Update, frame_rate, height_fact, length, tracks_of, unit_facts

SHAPE = "the columns id frame x y [z]"
_BRACKETED = re.compile(r"(?<=\S)\s*[\[(]([^\s\[\]()]+)[\])]")
_RATE = re.compile(r"frame\s*rate\s*[:=]?\s*([0-9.eE+-]+)", re.IGNORECASE)
_NAMES = {"id": "id", "frame": "frame", "fr": "frame", "x": "x", "y": "y", "z": "z"}


def read(path: Path, config: ImportConfig, update: Update) -> list[Tracks]:
    """One run. Units are read per column, so x in cm beside y in m is converted as it says.

    Raises ImportFailed where neither header nor option tells frame rate and units.
    """
    comments, table = numeric_table(path, update, least=4, shape=SHAPE)
    said = None
    for comment in comments:
        if found := _RATE.search(comment):
            try:
                said = float(found.group(1))
            except ValueError as error:
                raise ImportFailed(f"{path}: its header has no number of frames in {comment!r}") from error
    place, units = _columns(path, comments, table.shape[1])
    rate, rate_fact = frame_rate(str(path), config, said)
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
    without a header. Raises ImportFailed for a header of more columns than the rows have."""
    for comment in reversed(comments):
        words = [word.partition("/") for word in _BRACKETED.sub(r"/\1", comment).split()]
        names = [_NAMES.get(name.lower(), "") for name, _, _ in words]
        if {"id", "frame", "x", "y"} <= set(names):
            if len(names) > width:
                raise ImportFailed(
                    f"{path}: rows have {width} columns, its header names {len(names)}: {comment.strip()}"
                )
            return (
                {name: at for at, name in enumerate(names) if name},
                {name: unit.lower() for name, (_, _, unit) in zip(names, words, strict=True) if name and unit},
            )
        if "id" in names and ("x" in names or "frame" in names):
            missing = sorted({"id", "frame", "x", "y"} - set(names))
            raise ImportFailed(f"{path}: its header names no column {', '.join(missing)}; expected are {SHAPE}")
    return {"id": 0, "frame": 1, "x": 2, "y": 3, "z": 4}, {}
