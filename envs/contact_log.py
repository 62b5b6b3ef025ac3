"""The contact log: one row for each episode of contact of a pair, in memory and as CSV or Parquet."""

import contextlib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as arrow_csv
import pyarrow.parquet as arrow_parquet
from jaxtyping import Float, Int

from envs.touching import PARTNERS, Touches
from swarm_mjcf.errors import SwarmError
from swarm_mjcf.whole import WholeFile


class ContactLogError(SwarmError):
    """A contact log cannot be written or read; the message says which and why."""


@dataclass(frozen=True, kw_only=True)
class ContactLog:
    """E episodes in order of scene and onset: each a longest run of consecutive states at which a pair touches.

    Times are those of states, from the start of the scene. Two agents are one pair, the lower number being `agent`.
    """

    scene: Int[np.ndarray, " E"]
    agent: Int[np.ndarray, " E"]
    partner_kind: np.ndarray
    """agent, obstacle or wall."""
    partner: Int[np.ndarray, " E"]
    """Number among its kind; walls: east, north, west, south."""
    t_start: Float[np.ndarray, " E"]
    """First state of the episode [s]."""
    t_end: Float[np.ndarray, " E"]
    """Last state of the episode [s]; the pair may still touch where the recording ends."""
    states: Int[np.ndarray, " E"]
    """Number of its states, as counted by the collision report."""
    depth: Float[np.ndarray, " E"]
    """Deepest penetration [m]."""
    relative_speed: Float[np.ndarray, " E"]
    """|v_partner - v_agent| at the first state [m/s]."""
    closing_speed: Float[np.ndarray, " E"]
    """How fast the distance shrinks at the first state [m/s]."""
    impulse: Float[np.ndarray, " E"]
    """Normal impulse of the whole episode [N s]; NaN (empty in a file) where no engine told it."""

    def __len__(self) -> int:
        return len(self.scene)


COLUMNS = tuple(field.name for field in fields(ContactLog))
_DTYPES = dict.fromkeys(COLUMNS, np.float64) | {"partner_kind": np.str_}
_DTYPES |= dict.fromkeys(("scene", "agent", "partner", "states"), np.int64)
_ARROW = {np.float64: pa.float64(), np.int64: pa.int64(), np.str_: pa.string()}
SCHEMA = pa.schema([(name, _ARROW[dtype]) for name, dtype in _DTYPES.items()])
"""Of a contact log file."""


def contact_log(touches: Touches, timestep: float | int, *, first_scene: int = 0) -> ContactLog:
    """Episodes from touching states `timestep` [s] apart; `first_scene` is added to the scene numbers."""
    t = touches.take(
        np.lexsort([touches.state, touches.partner, touches.kind, touches.agent, touches.scene])  # pair by pair
    )
    pair = np.stack([t.scene, t.agent, t.kind, t.partner])
    breaks = np.flatnonzero((np.diff(pair, axis=1) != 0).any(axis=0) | (np.diff(t.state) != 1))
    starts, ends = np.append(0, breaks + 1)[: len(t)], np.append(breaks, len(t) - 1)[: len(t)]

    def over(ufunc: np.ufunc, values: np.ndarray) -> np.ndarray:
        return ufunc.reduceat(values, starts) if len(starts) else values

    log = ContactLog(
        scene=t.scene[starts] + first_scene,
        agent=t.agent[starts],
        partner_kind=np.array(PARTNERS)[t.kind[starts]],
        partner=t.partner[starts],
        t_start=np.round(t.state[starts] * timestep, 9),
        t_end=np.round(t.state[ends] * timestep, 9),
        states=ends - starts + 1,
        depth=over(np.maximum, t.depth),
        relative_speed=t.relative_speed[starts],
        closing_speed=t.closing_speed[starts],
        impulse=over(np.add, t.impulse),
    )
    return _taken(log, np.lexsort([log.partner, log.agent, log.t_start, log.scene]))


def _taken(log: ContactLog, order: np.ndarray) -> ContactLog:
    return replace(log, **{name: getattr(log, name)[order] for name in COLUMNS})


class ContactLogWriter:
    """Writes a log part by part, CSV or Parquet by the name's ending; the file appears only when all is written.

    Use as a context manager: an exception inside leaves no file and whatever was there before untouched.

    Raises:
      ContactLogError: the ending is neither .csv nor .parquet, or the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._check_ending(self.path)
        kind = arrow_csv.CSVWriter if self.path.suffix == ".csv" else arrow_parquet.ParquetWriter
        try:
            with contextlib.ExitStack() as stack:
                part = stack.enter_context(WholeFile(self.path))
                self._file = stack.enter_context(kind(part, SCHEMA))
                self._open = stack.pop_all()
        except OSError as error:
            raise ContactLogError(f"{self.path}: cannot be written ({error.strerror or error})") from error

    @staticmethod
    def _check_ending(path: Path) -> None:
        if path.suffix not in (".csv", ".parquet"):
            raise ContactLogError(f"{path}: a contact log ends in .csv or .parquet, not in {path.suffix!r}")

    def __enter__(self) -> "ContactLogWriter":
        return self

    def append(self, log: ContactLog) -> None:
        """Adds rows."""
        columns = [pa.array(getattr(log, name), SCHEMA.field(name).type, from_pandas=True) for name in COLUMNS]
        self._file.write_batch(pa.record_batch(columns, schema=SCHEMA))

    def __exit__(self, *error: Any) -> None:
        try:
            self._open.__exit__(*error)
        except OSError as failure:
            raise ContactLogError(f"{self.path}: cannot be written ({failure.strerror or failure})") from failure


def save_log(path: str | Path, log: ContactLog) -> None:
    """Writes a log whole or not at all; see `ContactLogWriter`."""
    with ContactLogWriter(path) as writer:
        writer.append(log)


def load_log(path: str | Path) -> ContactLog:
    """A log that `save_log` or `ContactLogWriter` wrote. Raises ContactLogError."""
    path = Path(path)
    ContactLogWriter._check_ending(path)
    try:
        if path.suffix == ".csv":
            types = arrow_csv.ConvertOptions(column_types=SCHEMA, include_columns=list(COLUMNS))
            table = arrow_csv.read_csv(path, convert_options=types)
        else:
            table = arrow_parquet.read_table(path, columns=list(COLUMNS))
        return ContactLog(**{name: table[name].to_numpy().astype(_DTYPES[name]) for name in COLUMNS})
    except (OSError, pa.ArrowException, KeyError) as error:
        raise ContactLogError(f"{path}: no contact log that can be read ({str(error).splitlines()[0]})") from error
