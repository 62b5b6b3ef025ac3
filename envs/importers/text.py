"""Tables of numbers separated by blanks, with comment lines; what is wrong is said with its line."""

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import Float

from envs.importers.tracks import ImportFailed, Update, readable


def lines_of(path: Path, update: Update) -> Iterator[str]:
    """Lines of a text file. Raises ImportFailed for what is no text."""
    size, done = readable(path), 0
    with path.open("rb") as file:
        for number, raw in enumerate(file):
            done += len(raw)
            if not number % 50_000:
                update(done, size, f"read {path.name}")
            try:
                line = raw.decode("utf-8-sig" if not number else "utf-8")
            except UnicodeDecodeError as error:
                raise ImportFailed(f"{path}: is not text (line {number + 1} is not UTF-8)") from error
            if "\0" in line:
                raise ImportFailed(f"{path}: is not text (line {number + 1} holds zero bytes)")
            yield line
    update(size, size, f"read {path.name}")


def numeric_table(path: Path, update: Update, *, least: int, shape: str) -> tuple[list[str], Float[np.ndarray, "n c"]]:
    """Comment lines without their `#`, and the numbers of all others.

    Args:
      least: fewest columns.
      shape: what the columns are, for messages.

    Raises:
      ImportFailed: not text, no rows, a word that is no number, or rows of different or too small width.
    """
    comments: list[str] = []

    def data() -> Iterator[str]:
        for line in lines_of(path, update):
            if line.lstrip().startswith("#"):
                comments.append(line.strip().lstrip("#").strip())
            elif line.strip():
                yield line

    rows = data()
    first = next(rows, None)
    if first is None:
        raise ImportFailed(f"{path}: no rows of data")
    try:
        table = np.loadtxt(chain([first], rows), ndmin=2, comments=None)
    except ValueError as error:
        raise _first_fault(path, shape) from error
    if table.shape[1] < least:
        raise ImportFailed(f"{path}: rows have {table.shape[1]} columns, expected are {shape}")
    return comments, table


def _first_fault(path: Path, shape: str) -> ImportFailed:
    width = None
    for number, line in enumerate(lines_of(path, lambda *_: None), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        for word in words:
            try:
                float(word)
            except ValueError:
                return ImportFailed(
                    f"{path}: line {number} has {word!r} where a number should be; expected are {shape}"
                )
        if width is not None and len(words) != width:
            return ImportFailed(
                f"{path}: line {number} has {len(words)} columns, those before it {width}; expected are {shape}"
            )
        width = len(words)
    return ImportFailed(f"{path}: is no table of numbers; expected are {shape}")
