"""Recordings -> moving pictures: one panel per recording, all at one pace."""

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from envs.plain import from_plain
from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories
from swarm_mjcf.camera import scene_camera
from swarm_mjcf.errors import SpecError
from swarm_mjcf.panels import GAP, tiled
from swarm_mjcf.playback import Playback
from swarm_mjcf.render import drawn_rows, frames, picture_height
from swarm_mjcf.spec import SceneSpec

MIN_FPS, MAX_FPS = 18.0, 34.0
"""Pictures per second of video: rows are interpolated below the first and skipped above the second."""
MAX_PIXELS = 4096
"""Largest width and height of a picture; more is what many players cannot show."""
_WIDE, _LEAST, _USUAL = 1440, 220, 480
"""Panels are `_USUAL` pixels large, or smaller so that a row of them is `_WIDE`, but at least `_LEAST`."""


@dataclass(frozen=True)
class Panel:
    """A recording of one scene with the words above it."""

    recording: Trajectories
    """One scene."""
    title: str
    reference: Trajectories | None = None
    """Another recording of the same scene, drawn dashed."""
    reference_title: str = ""


@dataclass(frozen=True, kw_only=True)
class Look:
    """How recordings are shown; see `swarm_mjcf.render.frames`."""

    camera: str = "top"
    size: int | None = None
    """Height and width of a panel [pixels]; None takes 480, less where many stand side by side."""
    renderer: str = "auto"
    speed: float | int = 2.0
    """Seconds of simulation per second of video."""
    contacts: bool = True


@dataclass(frozen=True)
class Film:
    """Pictures to come, uint8 (H, W, 3), how many, and how fast they follow each other."""

    pictures: Iterator[np.ndarray]
    count: int
    fps: float


@dataclass(frozen=True)
class Timing:
    """How rows of a recording become pictures: `between` pictures per row, of which each `every`-th is drawn."""

    between: int
    every: int
    fps: float


def timing(dt: float | int, speed: float | int) -> Timing:
    """Smooth motion from control steps of `dt` seconds at `speed` seconds of simulation per second of video."""
    if not 0 < speed < math.inf:
        raise SpecError("speed", speed, "a finite number above 0")
    rate = speed / dt
    between = max(1, math.ceil(MIN_FPS / rate - 1e-9))
    every = max(1, math.ceil(rate * between / MAX_FPS - 1e-9))
    return Timing(between, every, rate * between / every)


def film(panels: Sequence[Panel], look: Look, *, columns: int, one_view: bool = False) -> Film:
    """Pictures of recordings that run side by side, row by row in `columns` columns.

    Args:
      panels: all with the same dt.
      look: how they are shown.
      columns: panels side by side.
      one_view: whether all panels have one camera, which shows what is in any of them.

    Raises:
      SpecError: the whole picture would be too large, or a value of `look` is out of range.
    """
    dt = panels[0].recording.dt
    pace, size = timing(dt, look.speed), look.size
    if size is None:
        size = int(np.clip(_WIDE // columns, _LEAST, _USUAL))
    if size < 64:
        raise SpecError("size", size, "at least 64 [pixels]")
    across = max(columns, math.ceil(len(panels) / columns)) * (size + GAP)
    if across > MAX_PIXELS:
        most = MAX_PIXELS // (across // (size + GAP)) - GAP
        raise SpecError("size", size, f"at most {most} pixels for so many panels, or fewer panels")
    shown = [
        playback(
            panel.recording,
            0,
            panel.title,
            between=pace.between,
            reference=panel.reference,
            ghost=panel.reference_title,
        )
        for panel in panels
    ]
    specs = [scene_spec(panel.recording) for panel in panels]
    view = {"camera": look.camera, "width": size, "height": picture_height(size)}
    together = scene_camera(specs[0], shown, **view) if one_view else None
    streams = [
        frames(
            spec,
            one,
            camera=together or look.camera,
            width=size,
            height=size,
            backend=look.renderer,  # type: ignore[arg-type]  # frames checks it
            every=pace.every,
            contacts=look.contacts,
            speed=look.speed,
        )
        for spec, one in zip(specs, shown, strict=True)
    ]
    count = max(len(drawn_rows(len(one.position), pace.every)) for one in shown)
    return Film(tiled(streams, columns=columns), count, pace.fps)


def playback(
    trajectories: Trajectories,
    scene: int,
    title: str,
    *,
    between: int = 1,
    reference: Trajectories | None = None,
    ghost: str = "",
) -> Playback:
    """One scene as it is drawn: `between` pictures per row, positions interpolated linearly.

    Contacts of a row are those of the control step that ends there, so all pictures of that step show them, and no
    other: contact steps stay as many and as long as they were. A body is there in a step when it is at both ends.

    Args:
      trajectories: a recording.
      scene: which of its scenes.
      title: above the picture.
      between: pictures per row.
      reference: another recording of the same scene, drawn dashed.
      ghost: its name.
    """
    t = trajectories
    goals, obstacles, agents = (np.flatnonzero(t.kind[scene] == kind) for kind in (GOAL, OBSTACLE, AGENT))
    rows = t.position.shape[1]
    # Picture p lies in the step that ends at row `end`; row 0 ends nothing and is a picture of its own.
    moment = np.arange((rows - 1) * between + 1) / between
    end = np.ceil(moment - 1e-9).astype(int)
    begin = np.maximum(end - 1, 0)

    def there(nodes: np.ndarray) -> np.ndarray:
        present = t.mask[scene][:, nodes]
        return np.where((moment == end)[:, None], present[end], present[end] & present[begin])

    def at(values: np.ndarray) -> np.ndarray:
        share = (end - moment)[:, None, None]
        return share * values[begin] + (1 - share) * values[end]

    other = None
    if reference is not None:
        other = np.full((rows, len(agents), 2), np.nan)
        known = min(rows, reference.position.shape[1])
        where = reference.mask[scene, :known][:, agents]
        other[:known] = np.where(where[..., None], reference.position[scene, :known][:, agents], np.nan)
        other = at(other)
    goal = t.position[scene, 0, goals[0]] if len(goals) and t.mask[scene, 0, goals[0]] else None
    return Playback(
        position=at(t.position[scene][:, agents].astype(float)),
        agent_present=there(agents),
        obstacle=at(t.position[scene][:, obstacles].astype(float)),
        obstacle_present=there(obstacles),
        goal=goal,
        touching=(t.agent_contact[scene][:, agents] > 0)[end],
        touching_solid=(t.solid_contact[scene][:, agents] > 0)[end],
        depth=t.depth[scene][:, agents][end],
        dt=t.dt / between,
        title=title,
        reference=other,
        reference_title=ghost,
    )


def scene_spec(trajectories: Trajectories) -> SceneSpec:
    """What is drawn: the recorded world's scene, or one with the recorded radii and no border to be seen."""
    recorded = trajectories.provenance.get("world", {}).get("scene")
    if recorded:
        with suppress(KeyError):  # of another version
            return from_plain(SceneSpec, recorded)

    def largest(kind: int, default: float) -> float:
        return float(trajectories.radius.max(where=trajectories.kind == kind, initial=0)) or default

    goals, obstacles, agents = trajectories.counts
    return SceneSpec(
        num_agents=agents,
        num_obstacles=obstacles,
        agent_radius=largest(AGENT, 1.0),
        obstacle_radius=largest(OBSTACLE, 1.0),
        goal=goals > 0,
        arena=4 * max(float(np.abs(trajectories.position).max()), float(trajectories.radius.max()), 1.0),
        dt=trajectories.dt,
        substeps=1,
        contacts=False,
    )
