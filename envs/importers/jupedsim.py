"""JuPedSim's SQLite: table trajectory_data (frame, id, pos_x, pos_y [, pos_z]), table metadata with fps; in metres."""

import contextlib
import sqlite3
from pathlib import Path

import numpy as np

from envs.importers.config import ImportConfig
from envs.importers.tracks import ImportFailed, Tracks, Update, frame_rate, height_fact, length, readable, tracks_of

NEEDED = ("frame", "id", "pos_x", "pos_y")
_PART = 100_000


def read(path: Path, config: ImportConfig, update: Update) -> list[Tracks]:
    """One run. The database is opened read-only."""
    readable(path)
    with path.open("rb") as file:
        if file.read(16) != b"SQLite format 3\0":
            raise ImportFailed(f"{path}: is no SQLite database")
    try:
        with contextlib.closing(sqlite3.connect(path.absolute().as_uri() + "?mode=ro", uri=True)) as base:
            tables = sorted(name for (name,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'"))
            columns = [row[1] for row in base.execute("PRAGMA table_info(trajectory_data)")]
            missing = [name for name in NEEDED if name not in columns]
            if missing:
                raise ImportFailed(
                    f"{path}: is no JuPedSim database: trajectory_data ({', '.join(NEEDED)}) is expected, it has the "
                    f"tables {', '.join(tables) or 'none'}" + (f" without {', '.join(missing)}" if columns else "")
                )
            said = _said(path, base) if "metadata" in tables else None
            (rows,) = base.execute("SELECT count(*) FROM trajectory_data").fetchone()
            if not rows:
                raise ImportFailed(f"{path}: no rows of data")
            wanted = ", ".join((*NEEDED, "pos_z") if "pos_z" in columns else NEEDED)
            parts, cursor = [], base.execute(f"SELECT {wanted} FROM trajectory_data ORDER BY id, frame")
            while part := cursor.fetchmany(_PART):
                parts.append(np.asarray(part, np.float64))
                update(sum(map(len, parts)), rows, f"read {path.name}")
    except sqlite3.Error as error:
        raise ImportFailed(f"{path}: a damaged or locked SQLite database ({error})") from error
    except (ValueError, TypeError) as error:
        raise ImportFailed(f"{path}: trajectory_data holds something that is no number ({error})") from error
    table = np.concatenate(parts)
    rate, rate_fact = frame_rate(str(path), config, said, where="metadata")
    scale, unit = length(str(path), config, "m", where="format")
    facts = {"format": "JuPedSim SQLite", "unit": unit, "frame rate": rate_fact}
    if "pos_z" in columns:
        facts["z"] = height_fact(str(path), table[:, 4] * scale, table[:, 1])
    return [tracks_of(path.name, time=table[:, 0] / rate, id=table[:, 1], position=table[:, 2:4] * scale, facts=facts)]


def _said(path: Path, base: sqlite3.Connection) -> float | None:
    for (value,) in base.execute("SELECT value FROM metadata WHERE key = 'fps'"):
        try:
            return float(value)
        except (ValueError, TypeError) as error:
            raise ImportFailed(f"{path}: its metadata says fps {value!r}, which is no number") from error
    return None
