"""Progress for people: a bar on a terminal, a line now and then where the output is a file."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol, runtime_checkable

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

LINE_SECONDS = 10.0


@runtime_checkable
class Update(Protocol):
    """`update(done, total, note)`: how far the work is, and a few words."""

    def __call__(self, done: int, total: int, note: str = "") -> None: ...


@contextmanager
def progress(title: str) -> Iterator[Update]:
    """A bar while the block runs. Goes to stderr, so that a program's results stay clean on stdout."""
    started = time.monotonic()
    if not sys.stderr.isatty():
        last = started

        def line(done: int, total: int, note: str = "") -> None:
            nonlocal last
            now = time.monotonic()
            if now - last >= LINE_SECONDS or (done >= total and now - started >= 1):
                last = now
                print(
                    f"{title}: {done}/{total} after {now - started:.0f} s {note}".rstrip(), file=sys.stderr, flush=True
                )

        yield line
        return
    from rich.console import Console

    columns = (
        TextColumn("{task.description:24}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as bars:
        task = bars.add_task(title, total=None, note="")
        yield lambda done, total, note="": bars.update(task, completed=done, total=total, note=note)
