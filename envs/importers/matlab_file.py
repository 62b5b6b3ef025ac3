"""MATLAB v4 and v5 files: one matrix of numbers whose columns are named by number, counted from 1 as in MATLAB."""

import zlib
from pathlib import Path

import numpy as np

from envs.importers.config import ImportConfig
from envs.importers.long_table import TEXT, Column, runs_of
from envs.importers.tracks import ImportFailed, Tracks, Update, label, readable
from swarm_mjcf.errors import SpecError


def read(path: Path, config: ImportConfig, update: Update) -> list[Tracks]:
    """The runs of a matrix. Raises SpecError for --columns that are no numbers, ImportFailed for other contents."""
    size = readable(path)
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    with path.open("rb") as file:
        start = file.read(128)
    if start.startswith(b"MATLAB 7.3") or start[:8] == b"\x89HDF\r\n\x1a\n":
        raise ImportFailed(f"{path}: is of MATLAB v7.3; save it in MATLAB with save(..., '-v7')")
    try:
        contents = loadmat(path, appendmat=False, chars_as_strings=True, struct_as_record=True)
    except (
        MatReadError,
        NotImplementedError,
        ValueError,
        TypeError,
        OSError,
        EOFError,
        LookupError,
        zlib.error,
    ) as error:
        raise ImportFailed(f"{path}: is no whole MATLAB v5 file ({error})") from error
    update(size, size, f"read {path.name}")
    table = _table(path, contents, config.variable)
    columns = {}
    for ours, theirs in config.named_columns().items():
        if not theirs.isdigit() or not 1 <= int(theirs) <= table.shape[1]:
            raise SpecError(
                "columns", f"{ours}={theirs}", f"numbers from 1 to {table.shape[1]}, which is what the table has"
            )
        columns[ours] = Column(theirs)
    missing = [name for name in ("id", "x", "y") if name not in columns]
    if not {"t", "frame"} & set(columns):
        missing.insert(0, "t (or frame)")
    if missing:
        raise ImportFailed(
            f"{path}: a table of {table.shape[1]} columns; say which is {', '.join(missing)}, such as "
            "--columns frame=1 id=2 x=3 y=4"
        )
    values = {}
    for ours, column in columns.items():
        data = table[:, int(column.name) - 1]
        if ours in TEXT and not np.isfinite(data).all():
            raise ImportFailed(f"{path}: {np.count_nonzero(~np.isfinite(data))} rows have no {ours}")
        values[ours] = np.asarray([label(value) for value in data]) if ours in TEXT else data.astype(np.float64)
    return runs_of(str(path), path.name, columns, values, config, {"format": "MATLAB"})


def _table(path: Path, contents: dict, wanted: str | None) -> np.ndarray:
    """The one matrix of real numbers, or the one that is asked for."""
    tables = {
        name: value
        for name, value in contents.items()
        if not name.startswith("__") and isinstance(value, np.ndarray) and value.ndim == 2 and value.dtype.kind in "iuf"
    }
    if wanted is not None:
        if wanted not in tables:
            raise ImportFailed(f"{path}: has no table {wanted!r} of numbers; it has {', '.join(tables) or 'none'}")
        return tables[wanted]
    large = {name: value for name, value in tables.items() if value.shape[1] >= 4}
    if len(large) != 1:
        found = ", ".join(large) or "none"
        raise ImportFailed(f"{path}: tables of numbers with 4 columns or more: {found}; name one with --variable")
    (table,) = large.values()
    return table
