"""Several streams of pictures in one: rows of panels, as for a comparison or for many scenes at once."""

from collections.abc import Iterator, Sequence

import numpy as np

from swarm_mjcf.errors import SpecError, SwarmError

GAP = 4
"""Pixels between two panels."""
_DIVIDER = (214, 218, 224)


def tiled(streams: Sequence[Iterator[np.ndarray]], *, columns: int) -> Iterator[np.ndarray]:
    """Pictures uint8 (H, W, 3) of streams of one size, row by row in `columns` columns, 4 pixels apart.

    A stream that ends before the others stays on its last picture; panels that no stream fills stay grey. All streams
    are closed at the end.

    Raises:
      SpecError: there is no stream, or no column.
      SwarmError: a stream has no picture, or the sizes differ.
    """
    if not streams:
        raise SpecError("streams", len(streams), "at least 1")
    if columns < 1:
        raise SpecError("columns", columns, "at least 1")
    return streams[0] if len(streams) == columns == 1 else _tiled(streams, columns)


def _tiled(streams: Sequence[Iterator[np.ndarray]], columns: int) -> Iterator[np.ndarray]:
    try:
        current = [next(stream, None) for stream in streams]
        pictures = [picture for picture in current if picture is not None]
        if len(pictures) < len(streams):
            raise SwarmError(f"panels: {len(streams) - len(pictures)} of {len(streams)} streams have no picture")
        height, width = pictures[0].shape[:2]
        for picture in pictures:
            if picture.shape != (height, width, 3):
                given = f"{picture.shape[0]} x {picture.shape[1]}"
                raise SwarmError(f"panels: sizes differ, {height} x {width} and {given} pixels")
        rows = -(-len(streams) // columns)
        whole = np.empty((rows * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3), np.uint8)
        whole[:] = _DIVIDER
        while True:
            for panel, picture in enumerate(pictures):
                top, left = panel // columns * (height + GAP), panel % columns * (width + GAP)
                whole[top : top + height, left : left + width] = picture
            yield whole.copy()
            current = [next(stream, None) for stream in streams]
            if all(picture is None for picture in current):
                return
            pictures = [old if new is None else new for old, new in zip(pictures, current, strict=True)]
    finally:
        for stream in streams:
            if hasattr(stream, "close"):
                stream.close()  # type: ignore[attr-defined]  # a generator of frames frees its renderer
