"""Which reader reads a file."""

import importlib
from pathlib import Path

from envs.importers.config import FORMATS, ImportConfig
from envs.importers.tracks import ImportFailed, Tracks, Update

_MODULES = {
    "csv": "csv_file",
    "parquet": "parquet_file",
    "published": "published",
    "juelich": "juelich",
    "jupedsim": "jupedsim",
    "eth": "eth",
    "trajnet": "trajnet",
    "matlab": "matlab_file",
}
"""Each has a function `read(path, config, update) -> list[Tracks]`, one per run."""
_ENDINGS = {
    "_timeseries.npy": "published",
    ".csv": "csv",
    ".tsv": "csv",
    ".parquet": "parquet",
    ".pq": "parquet",
    ".sqlite": "jupedsim",
    ".sqlite3": "jupedsim",
    ".db": "jupedsim",
    ".ndjson": "trajnet",
    ".mat": "matlab",
    "obsmat.txt": "eth",
    ".txt": "juelich",
}
"""First that fits."""


def read(path: Path, config: ImportConfig, update: Update = lambda *_: None) -> list[Tracks]:
    """The runs of a file. Raises ImportFailed, and what the format's reader raises."""
    kind = config.format
    if kind == "auto":
        kind = next((kind for ending, kind in _ENDINGS.items() if path.name.lower().endswith(ending)), None)
        if kind is None:
            raise ImportFailed(
                f"{path}: its name does not tell the format; give --format, one of {', '.join(FORMATS[1:])}"
            )
    return importlib.import_module(f"envs.importers.{_MODULES[kind]}").read(path, config, update)
