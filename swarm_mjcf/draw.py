"""The bodies, drawn by matplotlib where there is no OpenGL: same view, same colours, flat."""

from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from swarm_mjcf.build import FLOOR_COLOR, GOAL_COLOR, OBSTACLE_COLOR, WALL_COLOR
from swarm_mjcf.camera import Camera
from swarm_mjcf.ink import circles
from swarm_mjcf.playback import Playback
from swarm_mjcf.spec import SceneSpec
from swarm_mjcf.view import View

_DPI = 100.0


class MatplotlibPainter:
    """Fills a picture with the bodies of one playback; what stands still is drawn once and kept."""

    def __init__(self, spec: SceneSpec, playback: Playback, *, camera: Camera) -> None:
        self._spec, self._playback, self._camera = spec, playback, camera
        self._figure = Figure(figsize=(camera.width / _DPI, camera.height / _DPI), dpi=_DPI, facecolor=FLOOR_COLOR)
        self._canvas = FigureCanvasAgg(self._figure)
        self._axes = self._figure.add_axes((0, 0, 1, 1), xlim=(0, camera.width), ylim=(camera.height, 0))
        self._axes.set_axis_off()
        self._walls, self._goal, self._solids = (self._bodies(c) for c in (WALL_COLOR, GOAL_COLOR, OBSTACLE_COLOR))
        self._agents = self._bodies(FLOOR_COLOR)
        self._agents.set_animated(True)  # not part of what stands still
        self._still: tuple[View, np.ndarray, np.ndarray, Any] | None = None

    def paint(self, canvas: np.ndarray, row: int, colors: np.ndarray) -> None:
        """Fills `canvas`, uint8 (height, width, 3), with row `row`; colors (N, 3) in 0..255."""
        view, here = self._camera.at(row), np.flatnonzero(self._playback.agent_present[row])
        self._canvas.restore_region(self._standing(view, row))
        _place(self._agents, view, _discs(self._playback.position[row, here], self._spec.agent_radius))
        self._agents.set_facecolor(list(colors[here] / 255))
        self._axes.draw_artist(self._agents)
        canvas[:] = np.asarray(self._canvas.buffer_rgba())[:, :, :3]

    def close(self) -> None:
        """Nothing is held beyond memory."""

    def _standing(self, view: View, row: int) -> Any:
        """Everything but the agents, as matplotlib keeps it; drawn anew only when camera or obstacles have moved."""
        spec, place, there = self._spec, self._playback.obstacle[row], self._playback.obstacle_present[row]
        if self._still is not None:
            seen, before, was_there, kept = self._still
            if view == seen and np.array_equal(place, before) and np.array_equal(there, was_there):
                return kept
        goal = self._playback.goal
        _place(self._walls, view, _walls(spec.arena) if spec.walls else np.zeros((0, 4, 2)))
        _place(self._goal, view, _discs(np.zeros((0, 2)) if goal is None else goal[None], spec.goal_radius))
        _place(self._solids, view, _discs(place[there], spec.obstacle_radius))
        self._canvas.draw()
        kept = self._canvas.copy_from_bbox(self._figure.bbox)
        self._still = view, place, there, kept
        return kept

    def _bodies(self, color: tuple[float, float, float]) -> PolyCollection:
        artist = PolyCollection([], facecolors=[color], linewidths=0)
        self._axes.add_collection(artist, autolim=False)
        return artist


def _place(artist: PolyCollection, view: View, shapes: np.ndarray) -> None:
    artist.set_verts(list(view.project(shapes)))


def _discs(center: np.ndarray, radius: float) -> np.ndarray:
    """Outlines (R, M, 2) [m] of discs around centres (R, 2)."""
    unit = circles(np.zeros((1, 2)), np.array([10.0]))[:, 0] / 10
    return center[:, None] + radius * unit


def _walls(arena: float) -> np.ndarray:
    """Four strips outside the arena's border, (4, 4, 2) [m]."""
    strip = np.array([[1, -1.04], [1.04, -1.04], [1.04, 1.04], [1, 1.04]]) * arena
    turn = np.array([[0, 1], [-1, 0]])
    return np.stack([strip @ np.linalg.matrix_power(turn, side) for side in range(4)])
