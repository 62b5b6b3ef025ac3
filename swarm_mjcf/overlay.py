"""What is painted over the bodies, by every renderer alike: outlines, trails, dashed reference, contact flashes."""

import math

import numpy as np

from swarm_mjcf.build import agent_color
from swarm_mjcf.ink import Dots, Paths, circles, stamp
from swarm_mjcf.playback import Playback
from swarm_mjcf.spec import SceneSpec
from swarm_mjcf.view import View

CONTACT = np.array([222, 22, 34])
"""The colour of an agent in contact, red, green, blue in 0..255; no agent has it otherwise."""
_GOAL_LINE = np.array([24, 132, 60])
_SOLID_LINE = np.array([52, 56, 64])
_ARENA_LINE = np.array([196, 200, 208])
_FLASH_FRAMES = 4


def agent_colors(count: int) -> np.ndarray:
    """Colours of agents 0..count-1, float (N, 3) in 0..255."""
    return 255 * np.array([agent_color(i) for i in range(count)])


class Overlay:
    """Lines over the picture of one playback: built once, then painted frame by frame."""

    def __init__(self, spec: SceneSpec, playback: Playback, *, view: View, trail: float | int, every: int) -> None:
        self._view, self._every = view, every
        self._scale = max(0.75, view.height / 440)
        self._colors = agent_colors(playback.position.shape[1])
        self._present = playback.agent_present
        self._position = playback.position
        self._window = min(trail / playback.dt, len(playback.position))
        self._hit_row = _last_true(playback.agent_hit | playback.solid_hit)
        self._paths = Paths.of(view.project(playback.position), playback.agent_present)
        self._ghost = None
        if playback.reference is not None:
            known = playback.agent_present & np.isfinite(playback.reference).all(-1)
            self._ghost = playback.reference, known, Paths.of(view.project(playback.reference), known)
        # A body smaller than this gets a ring, so that it is seen in a wide view; its own size stays visible inside.
        smallest = 5.5 * self._scale / view.pixels_per_meter
        self._small = spec.agent_radius < smallest
        self._ring = max(spec.agent_radius, smallest)
        self._body = spec.agent_radius
        self._static = stamp(self._standing(spec, playback), view.height, view.width)

    def paint(self, canvas: np.ndarray, row: int) -> None:
        """Paints row `row` over the bodies on `canvas`, contiguous uint8 (height, width, 3)."""
        self._static.press(canvas)
        present = np.flatnonzero(self._present[row])
        place = self._position[row, present]
        since = row - self._hit_row[row, present]
        color = np.where((since < self._every)[:, None], CONTACT, self._colors[present])
        layers = [self._trails(row), *self._outlines(place, color)]
        if self._ghost is not None:
            layers += self._reference(row)
        flash = since < _FLASH_FRAMES * self._every
        if flash.any():
            layers.append(self._flashes(place[flash], since[flash] / (_FLASH_FRAMES * self._every)))
        stamp(Dots.join(layers), self._view.height, self._view.width).press(canvas)
        if (since < self._every).any():
            edge = math.ceil(3 * self._scale)
            canvas[:edge] = canvas[-edge:] = CONTACT
            canvas[:, :edge] = canvas[:, -edge:] = CONTACT

    def _rings(self, place: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Points (M, R, 2) [pixels] around places (R, 2) [m], about a pixel apart."""
        scale = self._view.pixels_per_meter
        return self._view.project(circles(place * scale, radius * scale) / scale)

    def _outlines(self, place: np.ndarray, color: np.ndarray) -> list[Dots]:
        body = self._rings(place, np.full(len(place), self._body))
        lines = [Dots.of(body, color=(0.62 if not self._small else 1.0) * color, width=1.3 * self._scale)]
        if self._small:
            halo = self._rings(place, np.full(len(place), self._ring))
            lines.append(Dots.of(halo, color=color, width=1.5 * self._scale))
        return lines

    def _trails(self, row: int) -> Dots:
        part = self._paths.between(math.ceil(row - self._window), row)
        agent, age = self._paths.agent[part], row - self._paths.time[part]
        opacity = 0.75 * np.clip(1 - age / max(self._window, 1), 0, 1) + 0.08
        # The line ends at the body's edge instead of crossing it.
        head = self._view.project(self._position[row])[agent]
        gone = np.hypot(*(self._paths.xy[part] - head).T) < self._ring * self._view.pixels_per_meter
        opacity = np.where(gone, 0.0, opacity)
        return Dots.of(self._paths.xy[part], color=self._colors[agent], opacity=opacity, width=1.7 * self._scale)

    def _reference(self, row: int) -> list[Dots]:
        assert self._ghost is not None
        place, known, paths = self._ghost
        part = paths.between(math.ceil(row - self._window), row)
        dash = (paths.along[part] % (9 * self._scale)) < 5 * self._scale
        line = 0.55 * self._colors[paths.agent[part]]
        dashes = Dots.of(paths.xy[part], color=line, opacity=np.where(dash, 0.7, 0.0), width=1.2 * self._scale)
        here = np.flatnonzero(known[row])
        rings = self._rings(place[row, here], np.full(len(here), self._ring))
        dotted = np.where(np.arange(len(rings)) % 6 < 3, 0.8, 0.0)[:, None]
        return [dashes, Dots.of(rings, color=0.55 * self._colors[here], opacity=dotted, width=1.2 * self._scale)]

    def _flashes(self, place: np.ndarray, age: np.ndarray) -> Dots:
        """Rings that widen and fade over a few frames; age is 0..1."""
        rings = self._rings(place, self._ring * (1.6 + 1.6 * age))
        return Dots.of(
            rings, color=CONTACT, opacity=np.broadcast_to(1 - 0.8 * age, rings.shape[:2]), width=2.2 * self._scale
        )

    def _standing(self, spec: SceneSpec, playback: Playback) -> Dots:
        """What never moves: the arena's border, outlines of obstacles, the goal with its ring."""
        corners = spec.arena * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
        along = np.linspace(0, 1, max(2, math.ceil(2 * spec.arena * self._view.pixels_per_meter * 1.5)))[:, None, None]
        border = self._view.project(corners[:-1] + along * np.diff(corners, axis=0))
        solid = playback.obstacle[playback.obstacle_present]
        rings = self._rings(solid, np.full(len(solid), spec.obstacle_radius))
        layers = [Dots.of(rings, color=_SOLID_LINE, width=1.5 * self._scale)]
        if not spec.walls:  # walls are bodies and show the border themselves
            layers.append(Dots.of(border, color=_ARENA_LINE, width=1.2 * self._scale))
        if playback.goal is not None:
            least = 5 * self._scale / self._view.pixels_per_meter
            for radius in (spec.goal_radius, max(spec.goal_radius, least) + 0.8 * least):
                ring = self._rings(playback.goal[None], np.array([radius]))
                layers.append(Dots.of(ring, color=_GOAL_LINE, width=1.6 * self._scale))
        return Dots.join(layers)


def _last_true(flags: np.ndarray) -> np.ndarray:
    """The last row up to each row at which a flag was set, (T, N); far in the past when never."""
    rows = np.arange(len(flags))[:, None]
    return np.maximum.accumulate(np.where(flags, rows, -(10**9)), axis=0)
