"""Long CSV with a header line, read in blocks; the delimiter is what the header line has: comma, semicolon or tab."""

import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from envs.importers.config import ImportConfig
from envs.importers.long_table import TEXT, find_columns, runs_of
from envs.importers.tracks import ImportFailed, Tracks, Update, readable


def read(path: Path, config: ImportConfig, update: Update) -> list[Tracks]:
    """The runs of a CSV file. Raises ImportFailed for what is no table with the columns asked for."""
    size = readable(path)
    skipped, names, delimiter = _header(path)
    columns = find_columns(str(path), names, config)
    kinds = {c.name: pa.string() if ours in TEXT else pa.float64() for ours, c in columns.items()}
    parts: list[pa.RecordBatch] = []
    try:
        with path.open("rb") as file:
            reader = csv.open_csv(
                file,
                read_options=csv.ReadOptions(column_names=names, skip_rows=skipped + 1),
                parse_options=csv.ParseOptions(delimiter=delimiter),
                convert_options=csv.ConvertOptions(column_types=kinds, include_columns=list(kinds)),
            )
            for part in reader:
                parts.append(part)
                update(min(file.tell(), size), size, f"read {path.name}")
    except (pa.ArrowException, UnicodeDecodeError) as error:
        # Arrow names columns by number.
        said = re.sub(r"In CSV column #(\d+)", lambda found: f"column {names[int(found[1])]}", str(error))
        raise ImportFailed(f"{path}: {said.splitlines()[0]}") from error
    table = pa.Table.from_batches(parts) if parts else pa.schema(list(kinds.items())).empty_table()
    values = {ours: arrow_column(str(path), ours, table.column(c.name)) for ours, c in columns.items()}
    return runs_of(str(path), path.name, columns, values, config, {"format": "CSV"})


def arrow_column(path: str, ours: str, column: pa.ChunkedArray) -> np.ndarray:
    """An Arrow column as text, or as float64 with NaN where it is empty."""
    if ours in TEXT:
        if column.null_count:
            raise ImportFailed(f"{path}: {column.null_count} rows have no {ours}")
        texts = np.asarray(pc.utf8_trim_whitespace(column.cast(pa.string())).to_pylist(), dtype=str)  # pyright: ignore[reportAttributeAccessIssue]
        if (texts == "").any():
            raise ImportFailed(f"{path}: {np.count_nonzero(texts == '')} rows have no {ours}")
        return texts
    try:
        return np.asarray(column.cast(pa.float64()).to_numpy(), np.float64)
    except pa.ArrowException as error:
        raise ImportFailed(f"{path}: column {ours} holds something that is no number ({error})") from error


def _header(path: Path) -> tuple[int, list[str], str]:
    """Lines before the header (comments and empty ones), the columns' names, and the delimiter."""
    with path.open("rb") as file:
        for skipped in range(1000):
            raw = file.readline(1 << 16)
            try:
                line = raw.decode("utf-8-sig")
            except UnicodeDecodeError as error:
                raise ImportFailed(f"{path}: is not text (its header is not UTF-8)") from error
            if "\0" in line:
                raise ImportFailed(f"{path}: is not text (its header holds zero bytes)")
            if raw and (line.startswith("#") or not line.strip()):
                continue
            delimiter = next((mark for mark in ",;\t" if mark in line), ",")
            return skipped, [word.strip().strip('"') for word in line.strip("\r\n").split(delimiter)], delimiter
    raise ImportFailed(f"{path}: no header among its first lines")
