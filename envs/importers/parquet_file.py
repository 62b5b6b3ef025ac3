"""Long Parquet; columns of timestamps or durations, and files of `swarmnet export`, tell their units themselves."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from envs.importers.config import ImportConfig
from envs.importers.csv_file import arrow_column
from envs.importers.long_table import find_columns, runs_of
from envs.importers.tracks import ImportFailed, Tracks, Update, readable

UNITS_KEY = b"swarmnet.units"
"""Key of the schema's metadata under which `swarmnet export` writes `{column: unit}`."""


def read(path: Path, config: ImportConfig, update: Update) -> list[Tracks]:
    """The runs of a Parquet file."""
    readable(path)
    try:
        with pq.ParquetFile(path) as file:
            schema = file.schema_arrow
            columns = find_columns(str(path), schema.names, config)
            told = _told(path, schema)
            clock = "t" if "t" in columns else "frame"
            for ours, column in columns.items():
                columns[ours] = replace(column, unit=column.unit or told.get(column.name))
            names = [column.name for column in columns.values()]
            parts, rows, total = [], 0, file.metadata.num_rows
            for part in file.iter_batches(columns=names):
                parts.append(part)
                update(rows := rows + part.num_rows, total, f"read {path.name}")
            table = pa.Table.from_batches(parts) if parts else schema.empty_table()
    except (pa.ArrowException, OSError) as error:
        raise ImportFailed(f"{path}: is no whole Parquet file ({str(error).splitlines()[0]})") from error
    values = {}
    for ours, column in columns.items():
        data = table.column(column.name)
        if ours == clock and (pa.types.is_timestamp(data.type) or pa.types.is_duration(data.type)):
            if data.null_count:
                raise ImportFailed(f"{path}: {data.null_count} rows have no {ours}")
            ticks = data.cast(pa.int64()).to_numpy()
            # From the first on: nanoseconds since 1970 do not fit into a float64.
            values[ours] = (ticks - ticks.min(initial=ticks[0] if len(ticks) else 0)).astype(np.float64)
        else:
            values[ours] = arrow_column(str(path), ours, data)
    return runs_of(str(path), path.name, columns, values, config, {"format": "Parquet"})


def _told(path: Path, schema: pa.Schema) -> dict[str, str]:
    """Units by column name, from the file's own metadata and from types that have one."""
    told = {
        entry.name: entry.type.unit
        for entry in schema
        if pa.types.is_timestamp(entry.type) or pa.types.is_duration(entry.type)
    }
    try:
        return told | json.loads((schema.metadata or {}).get(UNITS_KEY, b"{}"))
    except (ValueError, TypeError) as error:
        raise ImportFailed(f"{path}: its metadata {UNITS_KEY.decode()} are no JSON object") from error
