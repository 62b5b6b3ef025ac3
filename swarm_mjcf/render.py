"""Pictures of a playback, one by one: MuJoCo draws the bodies where OpenGL works, matplotlib where it does not."""

import importlib
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from swarm_mjcf import gl  # first: it settles MUJOCO_GL before MuJoCo is imported
from swarm_mjcf.caption import Caption, bar_height
from swarm_mjcf.errors import SpecError, SwarmError
from swarm_mjcf.gl import GLReport, RenderError, check_gl
from swarm_mjcf.overlay import CONTACT, Overlay, agent_colors
from swarm_mjcf.playback import Playback, onsets
from swarm_mjcf.spec import SceneSpec
from swarm_mjcf.view import ELEVATION, View, fit_view

__all__ = ["GLReport", "RenderError", "check_gl", "frames", "scene_view", "side_by_side"]

_DIVIDER = (214, 218, 224)
_GAP = 4


@runtime_checkable
class Painter(Protocol):
    """Fills a picture with the bodies; trails, outlines and captions are the same for all painters."""

    def paint(self, canvas: np.ndarray, row: int, colors: np.ndarray) -> None:
        """Fills `canvas`, uint8 (height, width, 3), with row `row`; colors (N, 3) in 0..255."""
        ...

    def close(self) -> None:
        """Frees what it holds."""
        ...


def frames(
    spec: SceneSpec,
    playback: Playback,
    *,
    camera: str = "top",
    width: int = 480,
    height: int = 480,
    backend: Literal["auto", "mujoco", "matplotlib"] = "auto",
    quality: Literal["fast", "default"] = "fast",
    trail: float | int = 8.0,
    every: int = 1,
) -> Iterator[np.ndarray]:
    """Draws a playback frame by frame, uint8 (height, width, 3); one frame is held in memory at a time.

    Agents have distinct colours and are red while in contact, also when the contact fell between two drawn rows; a red
    frame marks such moments and a ring fades out after them. The caption counts contact events, per agent. The view is
    constant and shows the whole run.

    Args:
      spec: radii, arena and walls; how many bodies there are is the playback's affair.
      playback: what is shown.
      camera: "top" or "tilted".
      width, height: of the whole frame with its caption [pixels], at least 64.
      backend: "auto" takes matplotlib, with a logged message that names what to install, when OpenGL does not work.
      quality: "fast", or MuJoCo's "default" (shadows, multisampling, reflections), which costs ten times the time in
        software and shows nothing more.
      trail: how long a trail lasts [s]; inf keeps all of it.
      every: draws each such row, and the last.

    Raises:
      SpecError: an argument is out of range.
      RenderError: backend "mujoco" was demanded and OpenGL does not work.
    """
    for field, given, allowed in (
        ("camera", camera, tuple(ELEVATION)),
        ("backend", backend, ("auto", "mujoco", "matplotlib")),
        ("quality", quality, ("fast", "default")),
    ):
        if given not in allowed:
            raise SpecError(field, given, f"one of {', '.join(allowed)}")
    for field, given, least in (("width", width, 64), ("height", height, 64), ("every", every, 1)):
        if given < least:
            raise SpecError(field, given, f"at least {least}")
    if not trail >= 0 or math.isnan(trail):
        raise SpecError("trail", trail, "at least 0 [s]")
    if backend == "mujoco" and check_gl().problem:
        raise RenderError(f"MuJoCo cannot draw here: {check_gl()}")
    view = scene_view(spec, playback, camera=camera, width=width, height=height)
    return _stream(
        spec, playback, view=view, bar=height - view.height, backend=backend, quality=quality, trail=trail, every=every
    )


def scene_view(spec: SceneSpec, playback: Playback, *, camera: str, width: int, height: int) -> View:
    """The view of a frame's part below its caption: pixels of `View.project` lie `bar_height(height)` rows higher."""
    return fit_view(spec, playback, camera=camera, width=width, height=height - bar_height(height))


def side_by_side(left: Iterator[np.ndarray], right: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    """Two streams of frames of one height side by side, 4 pixels apart; the shorter one stays on its last frame."""
    one, two = next(left, None), next(right, None)
    if one is None or two is None:
        raise SwarmError("side by side: one of the two streams has no frame")
    if one.shape[0] != two.shape[0]:
        raise SwarmError(f"side by side: heights differ, {one.shape[0]} and {two.shape[0]} pixels")
    gap = np.empty((one.shape[0], _GAP, 3), np.uint8)
    gap[:] = _DIVIDER
    more = True
    while more:
        yield np.concatenate([one, gap, two], axis=1)
        after_one, after_two = next(left, None), next(right, None)
        more = after_one is not None or after_two is not None
        one, two = (one if after_one is None else after_one), (two if after_two is None else after_two)


def _stream(
    spec: SceneSpec,
    playback: Playback,
    *,
    view: View,
    bar: int,
    backend: str,
    quality: str,
    trail: float | int,
    every: int,
) -> Iterator[np.ndarray]:
    rows, agents, _ = playback.position.shape
    drawn = [*range(0, rows - 1, every), rows - 1]
    overlay = Overlay(spec, playback, view=view, trail=trail, every=every)
    colors, hit = agent_colors(agents), playback.agent_hit | playback.solid_hit
    agent_events, solid_events = onsets(playback.agent_hit), onsets(playback.solid_hit)
    solid = "obstacle or wall" if spec.walls else "obstacle"
    painter = _painter(spec, playback, view=view, backend=backend, quality=quality)
    try:
        caption = Caption(title=playback.title, width=view.width, bar=bar)
        for before, row in zip([-1, *drawn[:-1]], drawn, strict=True):
            touched = hit[before + 1 : row + 1].any(axis=0)
            frame = np.empty((view.height + bar, view.width, 3), np.uint8)
            painter.paint(frame[bar:], row, np.where(touched[:, None], CONTACT, colors))
            overlay.paint(frame[bar:], row)
            counts = f"agent contacts {agent_events[row]}  ·  {solid} contacts {solid_events[row]}"
            caption.paint(frame, time=f"t = {row * playback.dt:.1f} s", counts=counts, alarm=bool(touched.any()))
            yield frame
    finally:
        painter.close()


def _painter(spec: SceneSpec, playback: Playback, *, view: View, backend: str, quality: str) -> Painter:
    if backend != "matplotlib":
        report = check_gl()
        if report.problem is None:
            gl.warn_if_slow()
            try:
                from swarm_mjcf.scene_gl import MujocoPainter

                return MujocoPainter(spec, playback, view=view, quality=quality)
            except Exception as error:  # drivers raise anything; the check passed in a process of its own
                if backend == "mujoco":
                    raise RenderError(f"MuJoCo cannot draw in this process: {error}") from error
                report = replace(report, problem=f"{type(error).__name__}: {error}", fix="unset PYOPENGL_PLATFORM")
        gl.log.warning("videos are drawn by matplotlib, flat but complete: %s", report)
    return importlib.import_module("swarm_mjcf.draw").MatplotlibPainter(spec, playback, view=view)
