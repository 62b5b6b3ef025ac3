"""What is painted over the bodies, by every renderer alike: outlines, trails, dashed reference, contacts."""

import math

import numpy as np

from swarm_mjcf.build import agent_color
from swarm_mjcf.camera import Camera
from swarm_mjcf.ink import Dots, Paths, Stamp, circles, stamp
from swarm_mjcf.playback import Playback, began
from swarm_mjcf.spec import SceneSpec
from swarm_mjcf.view import View

CONTACT = np.array([222, 22, 34])
"""The colour of an agent in contact, red, green, blue in 0..255; no agent has it otherwise."""
_MARK = np.array([150, 8, 20])
_GOAL_LINE = np.array([24, 132, 60])
_SOLID_LINE = np.array([52, 56, 64])
_ARENA_LINE = np.array([196, 200, 208])
_GROUND_LINE = np.array([224, 227, 232])
_FLOOR = 235
"""Every channel of the floor is at least this bright, and of no body."""
_FLASH_FRAMES = 4
_DOTS = 40_000
"""Dots of trails in a picture; a crowd's trails are shortened to that, or each picture would take seconds."""
_CROWD = 100
"""Above this number of agents the rings around small bodies shrink, so that they do not hide each other."""
_MARKS = 400
"""Marks of past contacts that are kept in the picture, the latest."""


def agent_colors(count: int) -> np.ndarray:
    """Colours of agents 0..count-1, float (N, 3) in 0..255."""
    return 255 * np.array([agent_color(i) for i in range(count)])


class Overlay:
    """Lines over the pictures of one playback, painted frame by frame.

    Without `contacts` nothing tells of them. With them an agent in contact is red, a ring fades out around it, a red
    frame is drawn, and a cross stays where each contact began.
    """

    def __init__(
        self, spec: SceneSpec, playback: Playback, *, camera: Camera, trail: float | int, every: int, contacts: bool
    ) -> None:
        self._spec, self._playback, self._camera, self.every = spec, playback, camera, every
        self._scale = max(0.75, camera.height / 440)
        self._colors = agent_colors(playback.position.shape[1])
        self._window = min(trail / playback.dt, len(playback.position))
        self.hit = (playback.agent_hit | playback.solid_hit) & contacts
        """Whose contacts are shown, bool (T, N)."""
        self._hit_row = _last_true(self.hit)
        self._began = np.argwhere(began(self.hit))  # in order of time
        closest = camera.closest
        self._paths = Paths.of(playback.position, closest.project(playback.position), playback.agent_present)
        rows, laid = len(playback.position), len(self._paths.time)
        self._window = min(self._window, max(1.0, rows * _DOTS / max(laid, 1)))
        self._ghost = None
        if playback.reference is not None:
            known = playback.agent_present & np.isfinite(playback.reference).all(-1)
            paths = Paths.of(playback.reference, closest.project(playback.reference), known)
            self._ghost = playback.reference, known, paths
        self._still: tuple[View, np.ndarray, np.ndarray, Stamp, Stamp] | None = None

    def paint(self, canvas: np.ndarray, row: int) -> None:
        """Paints row `row` over the bodies on `canvas`, contiguous uint8 (height, width, 3)."""
        view = self._camera.at(row)
        ground, standing = self._standing(view, row)
        if self._camera.ground is not None:
            ground.press(canvas, brighter=_FLOOR)
        standing.press(canvas)
        present = np.flatnonzero(self._playback.agent_present[row])
        place = self._playback.position[row, present]
        since = row - self._hit_row[row, present]
        color = np.where((since < self.every)[:, None], CONTACT, self._colors[present])
        layers = [self._trails(view, row), *self._outlines(view, place, color)]
        if (past := np.searchsorted(self._began[:, 0], row)) > 0:
            layers.append(self._marks(view, self._began[:past][-_MARKS:]))
        if self._ghost is not None:
            layers += self._reference(view, row)
        flash = since < _FLASH_FRAMES * self.every
        if flash.any():
            layers.append(self._flashes(view, place[flash], since[flash] / (_FLASH_FRAMES * self.every)))
        stamp(Dots.join(layers), view.height, view.width).press(canvas)
        if (since < self.every).any():
            edge = math.ceil(3 * self._scale)
            canvas[:edge] = canvas[-edge:] = CONTACT
            canvas[:, :edge] = canvas[:, -edge:] = CONTACT

    def _least(self, view: View) -> float:
        """A body smaller than this radius [m] gets a ring of it, so that it is seen in a wide view."""
        crowd = min(1.0, _CROWD / len(self._colors)) ** 0.5
        return 5.5 * crowd * self._scale / view.pixels_per_meter

    def _outlines(self, view: View, place: np.ndarray, color: np.ndarray) -> list[Dots]:
        body, least = self._spec.agent_radius, self._least(view)
        small = body < least
        lines = [Dots.of(_rings(view, place, body), color=(1.0 if small else 0.62) * color, width=1.3 * self._scale)]
        if small:
            lines.append(Dots.of(_rings(view, place, least), color=color, width=1.5 * self._scale))
        return lines

    def _trails(self, view: View, row: int) -> Dots:
        part = self._paths.between(math.ceil(row - self._window), row)
        agent, age = self._paths.agent[part], row - self._paths.time[part]
        opacity = 0.75 * np.clip(1 - age / max(self._window, 1), 0, 1) + 0.08
        # The line ends at the body's edge instead of crossing it.
        xy, head = view.project(self._paths.xy[part]), view.project(self._playback.position[row])[agent]
        radius = max(self._spec.agent_radius, self._least(view)) * view.pixels_per_meter
        opacity = np.where(np.hypot(*(xy - head).T) < radius, 0.0, opacity)
        return Dots.of(xy, color=self._colors[agent], opacity=opacity, width=1.7 * self._scale)

    def _reference(self, view: View, row: int) -> list[Dots]:
        assert self._ghost is not None
        place, known, paths = self._ghost
        part = paths.between(math.ceil(row - self._window), row)
        dash = (paths.along[part] % (9 * self._scale)) < 5 * self._scale
        line = 0.55 * self._colors[paths.agent[part]]
        opacity = np.where(dash, 0.7, 0.0)
        dashes = Dots.of(view.project(paths.xy[part]), color=line, opacity=opacity, width=1.2 * self._scale)
        here = np.flatnonzero(known[row])
        rings = _rings(view, place[row, here], max(self._spec.agent_radius, self._least(view)))
        dotted = np.where(np.arange(len(rings)) % 6 < 3, 0.8, 0.0)[:, None]
        return [dashes, Dots.of(rings, color=0.55 * self._colors[here], opacity=dotted, width=1.2 * self._scale)]

    def _flashes(self, view: View, place: np.ndarray, age: np.ndarray) -> Dots:
        """Rings that widen and fade over a few frames; age is 0..1."""
        rings = _rings(view, place, max(self._spec.agent_radius, self._least(view)) * (1.6 + 1.6 * age))
        return Dots.of(
            rings, color=CONTACT, opacity=np.broadcast_to(1 - 0.8 * age, rings.shape[:2]), width=2.2 * self._scale
        )

    def _marks(self, view: View, past: np.ndarray) -> Dots:
        """A cross where each contact began, (P, 2) rows and agents; a contact of this row is told by its agent."""
        arm = np.linspace(-3.2, 3.2, 8) * self._scale
        cross = np.concatenate([np.stack([arm, arm], axis=-1), np.stack([arm, -arm], axis=-1)])
        middle = view.project(self._playback.position[past[:, 0], past[:, 1]])
        return Dots.of(middle + cross[:, None], color=_MARK, opacity=0.8, width=1.5 * self._scale)

    def _standing(self, view: View, row: int) -> tuple[Stamp, Stamp]:
        """Lines on the ground, and around what stands on it; drawn anew only when camera or obstacles have moved."""
        place, there = self._playback.obstacle[row], self._playback.obstacle_present[row]
        if self._still is not None:
            seen, before, was_there, *stamps = self._still
            if view == seen and np.array_equal(place, before) and np.array_equal(there, was_there):
                return stamps[0], stamps[1]
        ground = stamp(self._ground(view), view.height, view.width)
        standing = stamp(self._outlined(view, place[there]), view.height, view.width)
        self._still = view, place, there, ground, standing
        return ground, standing

    def _ground(self, view: View) -> Dots:
        """Lines of the ground's grid, if the camera asks for one, as far as the picture reaches."""
        step = self._camera.ground
        if step is None:
            return Dots.of(np.zeros((0, 2)), color=_GROUND_LINE)
        half = np.array([view.width, view.height]) / 2 / view.pixels_per_meter
        count = math.ceil(2 * float(half.max()) * view.pixels_per_meter * 1.1)
        lines = []
        for axis in (0, 1):
            low, high = view.center[axis] - half[axis], view.center[axis] + half[axis]
            at = step * np.arange(math.ceil(low / step), math.floor(high / step) + 1)
            along = view.center[1 - axis] + float(half.max()) * np.linspace(-1, 1, count)
            across, along = np.meshgrid(at, along)
            lines.append(np.stack([across, along] if axis == 0 else [along, across], axis=-1).reshape(-1, 2))
        return Dots.of(view.project(np.concatenate(lines)), color=_GROUND_LINE, width=1.2)

    def _outlined(self, view: View, solid: np.ndarray) -> Dots:
        """The arena's border, outlines of obstacles (K, 2), the goal with its ring."""
        spec, goal = self._spec, self._playback.goal
        layers = [Dots.of(_rings(view, solid, spec.obstacle_radius), color=_SOLID_LINE, width=1.5 * self._scale)]
        if not spec.walls:  # walls are bodies and show the border themselves
            corners = spec.arena * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
            count = max(2, math.ceil(2 * spec.arena * view.pixels_per_meter * 1.5))
            border = corners[:-1] + np.linspace(0, 1, count)[:, None, None] * np.diff(corners, axis=0)
            layers.append(Dots.of(view.project(border), color=_ARENA_LINE, width=1.2 * self._scale))
        if goal is not None:
            least = 5 * self._scale / view.pixels_per_meter
            for radius in (spec.goal_radius, max(spec.goal_radius, least) + 0.8 * least):
                layers.append(Dots.of(_rings(view, goal[None], radius), color=_GOAL_LINE, width=1.6 * self._scale))
        return Dots.join(layers)


def _rings(view: View, place: np.ndarray, radius: float | np.ndarray) -> np.ndarray:
    """Points (M, R, 2) [pixels] around places (R, 2) [m] with radius () or (R,) [m], about a pixel apart."""
    scale = view.pixels_per_meter
    return view.project(circles(place * scale, np.broadcast_to(radius * scale, len(place))) / scale)


def _last_true(flags: np.ndarray) -> np.ndarray:
    """The last row up to each row at which a flag was set, (T, N); far in the past when never."""
    rows = np.arange(len(flags))[:, None]
    return np.maximum.accumulate(np.where(flags, rows, -(10**9)), axis=0)
