"""Which view each picture has: a constant one that shows the whole run, or one that stays with the swarm."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from swarm_mjcf.errors import SpecError
from swarm_mjcf.playback import Playback
from swarm_mjcf.spec import SceneSpec
from swarm_mjcf.view import DISC_TOP, ELEVATION, FOVY, View, fit_view

CAMERAS = (*ELEVATION, "follow")
"""Names of cameras: from above, tilted, or from above and staying with the swarm."""
FOLLOW_SECONDS = 3.0
"""How far the following camera looks ahead and back to keep calm [s of simulation]."""
_FOLLOW_LEAST = 8.0
"""A followed swarm is shown at least this many agent radii wide to each side."""


@dataclass(frozen=True, eq=False)
class Camera:
    """The view of every row of a run."""

    center: np.ndarray
    """Point looked at [m], (T, 2)."""
    distance: np.ndarray
    """From the camera to that point [m], (T,)."""
    elevation: float
    """-90 looks straight down [degrees]."""
    width: int
    """Picture width [pixels]."""
    height: int
    """Picture height [pixels]."""
    ground: float | None = None
    """Spacing of lines on the ground [m], by which a moving camera shows that it moves; None for none."""

    def at(self, row: int) -> View:
        """The view of row `row`; later than the last row it is the last one's."""
        row = min(row, len(self.distance) - 1)
        center = float(self.center[row, 0]), float(self.center[row, 1])
        return View(center, float(self.distance[row]), self.elevation, self.width, self.height)

    @property
    def closest(self) -> View:
        """The view with the largest scale."""
        return self.at(int(np.argmin(self.distance)))


def scene_camera(spec: SceneSpec, shown: Sequence[Playback], *, camera: str, width: int, height: int) -> Camera:
    """The camera for runs that are shown in pictures of one size with one view, so that they can be compared.

    "top" and "tilted" stand still and show all of every run. "follow" looks from above, stays over the middle of the
    present agents and zooms so that every one of them is in the picture at every row. It knows the whole run, so its
    path is smooth without lagging behind: the middle is averaged over `FOLLOW_SECONDS` to both sides, and so is the
    widest zoom needed within them.

    Args:
      spec: sizes of what is shown.
      shown: one run or several.
      camera: one of `CAMERAS`.
      width, height: of the picture below its caption [pixels].

    Raises:
      SpecError: there is no such camera, or nothing to show.
    """
    if camera not in CAMERAS:
        raise SpecError("camera", camera, f"one of {', '.join(CAMERAS)}")
    if not shown:
        raise SpecError("shown", shown, "at least one run")
    if camera == "follow":
        return _follow(spec, shown, width=width, height=height)
    view = fit_view(spec, shown, camera=camera, width=width, height=height)
    return Camera(np.array([view.center]), np.array([view.distance]), view.elevation, width, height)


def _follow(spec: SceneSpec, shown: Sequence[Playback], *, width: int, height: int) -> Camera:
    low, high = _boxes(shown, spec.agent_radius)
    window = max(1, round(FOLLOW_SECONDS / shown[0].dt))
    center = np.stack([_smooth(axis, window) for axis in ((low + high) / 2).T], axis=-1)
    half = np.maximum(np.maximum(high - center, center - low), _FOLLOW_LEAST * spec.agent_radius)
    room = 0.44 * np.array([width, height])  # a margin of 6% of the picture to each side
    scale = _smooth(_highest((half / room).max(axis=1), window), window)  # metres per pixel
    # Scales hold at the height of the discs' tops, which are nearer than the plane.
    distance = scale * height / (2 * math.tan(math.radians(FOVY / 2))) + DISC_TOP
    ground = _round_number(float(np.median(scale)) * min(width, height) / 5)
    return Camera(center, distance, ELEVATION["top"], width, height, ground)


def _boxes(shown: Sequence[Playback], radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners [m], (T, 2) twice, of the box around all bodies at each row; where nobody is there, between those of the
    rows before and after."""
    rows = max(len(playback.position) for playback in shown)
    low, high = np.full((rows, 2), np.inf), np.full((rows, 2), -np.inf)
    for playback in shown:
        there = playback.agent_present[..., None]
        part = slice(0, len(playback.position))
        low[part] = np.minimum(low[part], np.where(there, playback.position - radius, np.inf).min(axis=1))
        high[part] = np.maximum(high[part], np.where(there, playback.position + radius, -np.inf).max(axis=1))
    known = np.flatnonzero(np.isfinite(low[:, 0]))
    if not len(known):
        return np.zeros((rows, 2)), np.zeros((rows, 2))
    every = np.arange(rows)
    low, high = (np.stack([np.interp(every, known, box[known, a]) for a in (0, 1)], axis=-1) for box in (low, high))
    return low, high


def _smooth(values: np.ndarray, window: int) -> np.ndarray:
    """Means (T,) weighted by a Hann window over `window` rows to both sides; the ends are held."""
    kernel = np.hanning(2 * window + 3)[1:-1]
    return np.convolve(np.pad(values, window, mode="edge"), kernel / kernel.sum(), mode="valid")


def _highest(values: np.ndarray, window: int) -> np.ndarray:
    """Largest value (T,) within `window` rows to both sides, so that its means are nowhere below `values`."""
    padded = np.pad(values, window, mode="edge")
    return np.lib.stride_tricks.sliding_window_view(padded, 2 * window + 1).max(axis=-1)


def _round_number(value: float) -> float:
    """The largest of 1, 2, 5, 10, 20, ... (and of 0.5, 0.2, ...) that is at most `value`."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9))
