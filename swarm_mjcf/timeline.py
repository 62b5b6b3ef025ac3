"""The strip between caption and picture: how far the run is, when there was contact, and how deep bodies overlapped."""

import numpy as np

from swarm_mjcf.playback import Playback

_TO_COME, _PAST, _NOW = np.array([232, 235, 240]), np.array([196, 201, 209]), np.array([34, 38, 46])
_CONTACT = np.array([222, 22, 34])


def strip_height(height: int) -> int:
    """Rows of the strip in a picture of that many rows."""
    return max(5, round(0.025 * height))


class Timeline:
    """Time runs from left to right. A red column stands where somebody touched something, as high as the deepest
    penetration is beside an agent's radius: full at one radius, and where the depth is not known."""

    def __init__(self, playback: Playback, *, hit: np.ndarray, radius: float, width: int, height: int) -> None:
        rows = len(playback.position)
        column = (np.arange(rows) * (width - 1)) // max(rows - 1, 1)
        depth = np.ones(hit.shape) if playback.depth is None else playback.depth / radius
        share = np.where(hit, np.clip(depth, 0.25, 1), 0).max(axis=1)
        level = np.zeros(width)
        np.maximum.at(level, column, share)
        if width > rows:  # a row holds until the next one
            level = share[np.clip(np.searchsorted(column, np.arange(width), side="left"), 0, rows - 1)]
        filled = np.arange(height)[:, None] >= height - np.ceil(level * height)
        self._done = np.where(filled[..., None], _CONTACT, _PAST).astype(np.uint8)
        self._column = column

    def paint(self, canvas: np.ndarray, row: int) -> None:
        """Fills `canvas`, uint8 (height, width, 3), as it is at row `row`: the future is not told."""
        now = int(self._column[row])
        canvas[:, : now + 1] = self._done[:, : now + 1]
        canvas[:, now + 1 :] = _TO_COME
        canvas[:, max(now - 1, 0) : now + 1] = _NOW
