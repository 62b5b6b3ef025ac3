"""Where the camera stands and where a point of the scene falls in the picture; the same for every renderer."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from swarm_mjcf.playback import Playback
from swarm_mjcf.spec import SceneSpec

FOVY = 30.0
"""Vertical opening angle [degrees]; narrower than MuJoCo's 45, so that discs at the border keep their shape."""
ELEVATION = {"top": -90.0, "tilted": -50.0}
"""Camera names -> MuJoCo's elevation [degrees]; both look north."""
DISC_TOP = 0.3
"""Height [m] at which the bodies' discs end (`build`); what is painted over them lies there."""


@dataclass(frozen=True)
class View:
    """A pinhole camera that looks north and down, as MuJoCo's free camera with azimuth 90."""

    center: tuple[float, float]
    """The point looked at [m], in the plane."""
    distance: float
    """From the camera to that point [m]."""
    elevation: float
    """-90 looks straight down [degrees]."""
    width: int
    """Picture width [pixels]."""
    height: int
    """Picture height [pixels]."""

    @property
    def pixels_per_meter(self) -> float:
        """Scale at the point looked at, across the view [pixels/m]."""
        return self.height / (2 * self.distance * math.tan(math.radians(FOVY / 2)))

    def project(self, points: np.ndarray) -> np.ndarray:
        """Plane points (..., 2) [m] -> pixels (..., 2) as (column, row); NaN for points behind the camera."""
        sin, cos = math.sin(math.radians(-self.elevation)), math.cos(math.radians(-self.elevation))
        east, north = points[..., 0] - self.center[0], points[..., 1] - self.center[1]
        depth = self.distance + north * cos - DISC_TOP * sin
        scale = self.pixels_per_meter * self.distance / np.where(depth > 1e-3 * self.distance, depth, np.nan)
        column = self.width / 2 + east * scale
        row = self.height / 2 - (north * sin + DISC_TOP * cos) * scale
        return np.stack([column, row], axis=-1)


def fit_view(spec: SceneSpec, shown: Sequence[Playback], *, camera: str, width: int, height: int) -> View:
    """The closest constant view of all runs: all agents at all times, the obstacles and the goals, with a margin."""
    points = np.concatenate([_extremes(spec, playback) for playback in shown])
    low, high = points.min(axis=0), points.max(axis=0)
    half = np.maximum((high - low) / 2, 6 * spec.agent_radius)
    middle = (low + high) / 2
    corners = middle + half * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    center = (float(middle[0]), float(middle[1]))
    view = View(center, 4 * float(half.max()), ELEVATION[camera], width, height)
    sin = math.sin(math.radians(-view.elevation))
    margin = 0.06 * min(width, height)
    for _ in range(12):
        seen = view.project(corners)
        size = (seen.max(axis=0) - seen.min(axis=0)) / (np.array([width, height]) - 2 * margin)
        offset = (seen.max(axis=0) + seen.min(axis=0)) / 2 - np.array([width, height]) / 2
        north = view.center[1] - float(offset[1]) / (view.pixels_per_meter * sin)
        view = replace(view, center=(center[0], north), distance=view.distance * float(size.max()))
    return view


def _extremes(spec: SceneSpec, playback: Playback) -> np.ndarray:
    """Corners [m], (P, 2), of the boxes around everything that is to be seen."""
    positions = [playback.position[playback.agent_present]]
    if playback.reference is not None:
        ghost = playback.reference[playback.agent_present]
        positions.append(ghost[np.isfinite(ghost).all(-1)])
    sized = [(np.concatenate(positions), spec.agent_radius)]
    sized += [(playback.obstacle[playback.obstacle_present], spec.obstacle_radius)]
    if playback.goal is not None:
        sized.append((playback.goal[None], spec.goal_radius))
    boxes = [np.concatenate([points - radius, points + radius]) for points, radius in sized if len(points)]
    return np.concatenate(boxes) if boxes else np.array([[-spec.arena, -spec.arena], [spec.arena, spec.arena]])
