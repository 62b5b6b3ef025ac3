"""`obsmat.txt` of the ETH walking pedestrians (Pellegrini et al. 2009): frame id x z y vx vz vy, metres, no header."""

from pathlib import Path

import numpy as np

from envs.importers.config import ImportConfig
from envs.importers.text import numeric_table
from envs.importers.tracks import ImportFailed, Tracks, Update, frame_rate, height_fact, length, tracks_of

SHAPE = "the 8 columns frame id x z y vx vz vy"


def read(path: Path, config: ImportConfig, update: Update) -> list[Tracks]:
    """One run; positions are on the ground in metres by the data set's own definition, the frame rate is declared."""
    _, table = numeric_table(path, update, least=8, shape=SHAPE)
    if table.shape[1] != 8:
        raise ImportFailed(f"{path}: rows have {table.shape[1]} columns, expected are {SHAPE}")
    scale, unit = length(str(path), config, "m", where="format")
    rate, rate_fact = frame_rate(str(path), config, None)
    frame, id, height = table[:, 0], table[:, 1], table[:, 3]
    tracks = tracks_of(
        path.name,
        time=frame / rate,
        id=id,
        position=table[:, [2, 4]] * scale,
        velocity=table[:, [5, 7]] * scale,
        facts={"format": "ETH obsmat", "unit": unit, "frame rate": rate_fact, "z": height_fact(str(path), height, id)},
    )
    return [check_rate(tracks)]


def check_rate(tracks: Tracks) -> Tracks:
    """Adds to the facts how the file's own speeds compare with differences at the declared rate: 1 when it is right."""
    assert tracks.velocity is not None
    same = np.diff(tracks.id) == 0
    moved = np.linalg.norm(np.diff(tracks.position, axis=0)[same], axis=1) / np.diff(tracks.time)[same]
    own = np.linalg.norm(tracks.velocity[1:][same], axis=1)
    if not len(own) or not np.median(own):
        return tracks
    ratio = float(np.median(moved) / np.median(own))
    tracks.facts["check of the frame rate"] = (
        f"median speed from positions is {ratio:.3g} times that of the file's own velocities"
    )
    return tracks
