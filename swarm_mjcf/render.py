"""Pictures of a playback, one by one: MuJoCo draws the bodies where OpenGL works, matplotlib where it does not."""

import importlib
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from swarm_mjcf import gl  # first: it settles MUJOCO_GL before MuJoCo is imported
from swarm_mjcf.camera import Camera, scene_camera
from swarm_mjcf.caption import Caption, bar_height
from swarm_mjcf.errors import SpecError
from swarm_mjcf.gl import GLReport, RenderError, check_gl
from swarm_mjcf.overlay import CONTACT, Overlay, agent_colors
from swarm_mjcf.playback import Playback, onsets
from swarm_mjcf.spec import SceneSpec
from swarm_mjcf.timeline import Timeline, strip_height

__all__ = ["GLReport", "RenderError", "check_gl", "drawn_rows", "frames", "picture_height"]


@runtime_checkable
class Painter(Protocol):
    """Fills a picture with the bodies; trails, outlines and captions are the same for all painters."""

    def paint(self, canvas: np.ndarray, row: int, colors: np.ndarray) -> None:
        """Fills `canvas`, uint8 (height, width, 3), with row `row`; colors (N, 3) in 0..255."""
        ...

    def close(self) -> None:
        """Frees what it holds."""
        ...


def picture_height(height: int) -> int:
    """Rows of a frame's part below caption and timeline: what a camera for `frames` must have."""
    return height - bar_height(height) - strip_height(height)


def drawn_rows(rows: int, every: int) -> list[int]:
    """The rows that `frames` draws: each `every`-th and the last."""
    return [*range(0, rows - 1, every), rows - 1]


def frames(
    spec: SceneSpec,
    playback: Playback,
    *,
    camera: str | Camera = "top",
    width: int = 480,
    height: int = 480,
    backend: Literal["auto", "mujoco", "matplotlib"] = "auto",
    quality: Literal["fast", "default"] = "fast",
    trail: float | int = 8.0,
    every: int = 1,
    contacts: bool = True,
    speed: float | int | None = None,
) -> Iterator[np.ndarray]:
    """Draws a playback frame by frame, uint8 (height, width, 3); one frame is held in memory at a time.

    Agents have distinct colours and are red while in contact, also when the contact fell between two drawn rows; a red
    frame marks such moments, a ring fades out after them, a cross stays where each contact began. The caption counts
    contact events, per agent, and a strip below it shows when they were and how deep.

    Args:
      spec: radii, arena and walls; how many bodies there are is the playback's affair.
      playback: what is shown.
      camera: "top", "tilted" or "follow" (see `scene_camera`), or a camera that pictures of several runs share, of
        `width` and `picture_height(height)` pixels.
      width, height: of the whole frame with its caption [pixels], at least 64.
      backend: "auto" takes matplotlib, with a logged message that names what to install, when OpenGL does not work.
      quality: "fast", or MuJoCo's "default" (shadows, multisampling, reflections), which costs ten times the time in
        software and shows nothing more.
      trail: how long a trail lasts [s]; inf keeps all of it.
      every: draws each such row, and the last.
      contacts: whether contacts are shown.
      speed: seconds of simulation per second of video, for the caption.

    Raises:
      SpecError: an argument is out of range.
      RenderError: backend "mujoco" was demanded and OpenGL does not work.
    """
    for field, given, allowed in (
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
    if isinstance(camera, str):
        camera = scene_camera(spec, [playback], camera=camera, width=width, height=picture_height(height))
    elif (camera.width, camera.height) != (width, picture_height(height)):
        given = f"{camera.width} x {camera.height} pixels"
        raise SpecError("camera", given, f"one of {width} x {picture_height(height)} pixels")
    if backend == "mujoco" and check_gl().problem:
        raise RenderError(f"MuJoCo cannot draw here: {check_gl()}")
    overlay = Overlay(spec, playback, camera=camera, trail=trail, every=every, contacts=contacts)
    words = _Words(spec, playback, contacts=contacts, speed=speed, camera=camera)
    return _stream(
        spec, playback, camera=camera, overlay=overlay, words=words, backend=backend, quality=quality, height=height
    )


def _stream(
    spec: SceneSpec,
    playback: Playback,
    *,
    camera: Camera,
    overlay: Overlay,
    words: "_Words",
    backend: str,
    quality: str,
    height: int,
) -> Iterator[np.ndarray]:
    bar, top = bar_height(height), height - camera.height
    colors, hit = agent_colors(playback.position.shape[1]), overlay.hit
    drawn = drawn_rows(len(playback.position), overlay.every)
    timeline = Timeline(playback, hit=hit, radius=spec.agent_radius, width=camera.width, height=top - bar)
    painter = _painter(spec, playback, camera=camera, backend=backend, quality=quality)
    try:
        caption = Caption(title=playback.title, width=camera.width, bar=bar)
        for before, row in zip([-1, *drawn[:-1]], drawn, strict=True):
            touched = hit[before + 1 : row + 1].any(axis=0)
            frame = np.empty((height, camera.width, 3), np.uint8)
            painter.paint(frame[top:], row, np.where(touched[:, None], CONTACT, colors))
            overlay.paint(frame[top:], row)
            timeline.paint(frame[bar:top], row)
            caption.paint(frame, **words.at(row), alarm=bool(touched.any()))
            yield frame
    finally:
        painter.close()


class _Words:
    """What the caption says at a row."""

    def __init__(
        self, spec: SceneSpec, playback: Playback, *, contacts: bool, speed: float | int | None, camera: Camera
    ) -> None:
        self._dt, self._present = playback.dt, playback.agent_present
        self._solid = "obstacle or wall" if spec.walls else "obstacle"
        self._events = (onsets(playback.agent_hit), onsets(playback.solid_hit)) if contacts else None
        # Bodies that pass through each other leave no contacts to be counted; a zero would be misread.
        self._uncounted = not spec.contacts and not (playback.agent_hit | playback.solid_hit).any()
        self._deepest = None
        if contacts and playback.depth is not None:
            self._deepest = np.maximum.accumulate(np.where(playback.agent_present, playback.depth, 0).max(axis=1))
        self._pace = "" if speed is None else " · real time" if speed == 1 else f" · {speed:g}×"
        notes = [f"dashed: {playback.reference_title}" if playback.reference_title else ""]
        notes += [f"grid {camera.ground:g} m" if camera.ground is not None else ""]
        self._note = " · ".join(filter(None, notes))

    def at(self, row: int) -> dict[str, str]:
        """Keyword arguments of `Caption.paint`."""
        if self._events is not None and self._uncounted:
            counts = "contacts: not counted"
        elif self._events is None:
            counts = f"{np.count_nonzero(self._present[row])} agents"
        else:
            agent, solid = self._events
            counts = f"contacts: agent {agent[row]} · {self._solid} {solid[row]}"
            if self._deepest is not None and self._deepest[row] > 0:
                counts += f" · deepest {self._deepest[row]:.2g} m"
        return {"time": f"t = {row * self._dt:.1f} s{self._pace}", "counts": counts, "note": self._note}


def _painter(spec: SceneSpec, playback: Playback, *, camera: Camera, backend: str, quality: str) -> Painter:
    if backend != "matplotlib":
        report = check_gl()
        if report.problem is None:
            gl.warn_if_slow()
            try:
                from swarm_mjcf.scene_gl import MujocoPainter

                return MujocoPainter(spec, playback, camera=camera, quality=quality)
            except Exception as error:  # drivers raise anything; the check passed in a process of its own
                if backend == "mujoco":
                    raise RenderError(f"MuJoCo cannot draw in this process: {error}") from error
                report = replace(report, problem=f"{type(error).__name__}: {error}", fix="unset PYOPENGL_PLATFORM")
        gl.log.warning("videos are drawn by matplotlib, flat but complete: %s", report)
    return importlib.import_module("swarm_mjcf.draw").MatplotlibPainter(spec, playback, camera=camera)
