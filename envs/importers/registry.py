"""Which reader reads a file."""

import importlib
from collections.abc import Sequence
from pathlib import Path

from envs.importers.config import FORMATS, ImportConfig
from envs.importers.tracks import ImportFailed, Tracks, Update
from swarm_mjcf.errors import SpecError

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
_TABLES = ("csv", "parquet", "matlab")
_READ_BY = {"columns": _TABLES, "types": _TABLES, "time_unit": _TABLES, "variable": ("matlab",)}
"""Formats that read an option; those that are not here are read by all."""
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
    return importlib.import_module(f"envs.importers.{_MODULES[_format(path, config)]}").read(path, config, update)


def check_options(paths: Sequence[Path], config: ImportConfig) -> None:
    """Raises SpecError for a declared option that no file's format reads, ImportFailed where a format is unknown."""
    formats = {_format(path, config) for path in paths}
    for option, used_by in _READ_BY.items():
        if (value := getattr(config, option)) and not formats & set(used_by):
            raise SpecError(
                option, value, f"nothing for {', '.join(sorted(formats))}: it belongs to {', '.join(used_by)}"
            )


def _format(path: Path, config: ImportConfig) -> str:
    if config.format != "auto":
        return config.format
    kind = next((kind for ending, kind in _ENDINGS.items() if path.name.lower().endswith(ending)), None)
    if kind is None:
        raise ImportFailed(f"{path}: its name does not tell the format; give --format, one of {', '.join(FORMATS[1:])}")
    return kind
