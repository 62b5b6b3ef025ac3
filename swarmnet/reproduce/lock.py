"""File locks, so that several processes share the cells and data of one experiment. A process that dies frees its."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from swarm_mjcf.errors import SwarmError


class Busy(SwarmError):
    """Another process holds the lock."""


@contextmanager
def locked(path: Path, *, wait: bool = False) -> Iterator[None]:
    """Holds the lock file `path` during the block. Raises Busy where another process has it, unless told to wait."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            raise Busy(f"{path.parent}: another process works on it") from None
        yield  # closing the file frees the lock; the file itself stays, or two processes could hold two of a name
