"""The bodies, drawn by matplotlib where there is no OpenGL: same view, same colours, flat."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from swarm_mjcf.build import FLOOR_COLOR, GOAL_COLOR, OBSTACLE_COLOR, WALL_COLOR
from swarm_mjcf.ink import circles
from swarm_mjcf.playback import Playback
from swarm_mjcf.spec import SceneSpec
from swarm_mjcf.view import View

_DPI = 100.0


class MatplotlibPainter:
    """Fills a picture with the bodies of one playback; obstacles, walls and the goal are drawn once and kept."""

    def __init__(self, spec: SceneSpec, playback: Playback, *, view: View) -> None:
        self._view, self._playback, self._radius = view, playback, spec.agent_radius
        figure = Figure(figsize=(view.width / _DPI, view.height / _DPI), dpi=_DPI, facecolor=FLOOR_COLOR)
        self._canvas = FigureCanvasAgg(figure)
        self._axes = figure.add_axes((0, 0, 1, 1), xlim=(0, view.width), ylim=(view.height, 0))
        self._axes.set_axis_off()
        if spec.walls:
            self._fill(_walls(spec.arena), WALL_COLOR)
        if playback.goal is not None:
            self._fill(_discs(playback.goal[None], spec.goal_radius), GOAL_COLOR)
        self._fill(_discs(playback.obstacle[playback.obstacle_present], spec.obstacle_radius), OBSTACLE_COLOR)
        self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(figure.bbox)
        self._agents = self._fill([], FLOOR_COLOR)

    def paint(self, canvas: np.ndarray, row: int, colors: np.ndarray) -> None:
        """Fills `canvas`, uint8 (height, width, 3), with row `row`; colors (N, 3) in 0..255."""
        here = np.flatnonzero(self._playback.agent_present[row])
        discs = (
            self._view.project(np.stack(_discs(self._playback.position[row, here], self._radius))) if len(here) else []
        )
        self._canvas.restore_region(self._still)
        self._agents.set_verts(list(discs))
        self._agents.set_facecolor(list(colors[here] / 255))
        self._axes.draw_artist(self._agents)
        canvas[:] = np.asarray(self._canvas.buffer_rgba())[:, :, :3]

    def close(self) -> None:
        """Nothing is held beyond memory."""

    def _fill(self, shapes: list[np.ndarray], color: tuple[float, float, float]) -> PolyCollection:
        artist = PolyCollection([self._view.project(shape) for shape in shapes], facecolors=[color], linewidths=0)
        self._axes.add_collection(artist, autolim=False)
        return artist


def _discs(center: np.ndarray, radius: float) -> list[np.ndarray]:
    """Outlines of discs, each (M, 2) [m]."""
    unit = circles(np.zeros((1, 2)), np.array([10.0]))[:, 0] / 10
    return [place + radius * unit for place in center]


def _walls(arena: float) -> list[np.ndarray]:
    """Four strips outside the arena's border, each (4, 2) [m]."""
    strip = np.array([[1, -1.04], [1.04, -1.04], [1.04, 1.04], [1, 1.04]]) * arena
    turn = np.array([[0, 1], [-1, 0]])
    return [strip @ np.linalg.matrix_power(turn, side) for side in range(4)]
