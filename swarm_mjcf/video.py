"""Frames -> a file, whole or not at all: mp4 through mediapy and imageio-ffmpeg, gif where ffmpeg does not run."""

import functools
import itertools
import logging
import math
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from swarm_mjcf.errors import SpecError, SwarmError
from swarm_mjcf.whole import WholeFile

log = logging.getLogger("swarm_mjcf")


class VideoError(SwarmError):
    """A video could not be written; says where and why. No file was left behind."""


def write_video(path: str | os.PathLike[str], frames: Iterable[np.ndarray], fps: float | int) -> Path:
    """Writes frames, uint8 (H, W, 3), as they come; returns the path really written.

    H.264 in yuv420p, which browsers play; odd sizes get one more row or column. The file appears under its name when
    it is complete. Where ffmpeg does not run, a gif is written beside it instead, and a logged message says so; a path
    that ends in .gif always gives one.

    Raises:
      SpecError: the name ends otherwise, or `fps` is not above 0.
      VideoError: there is no frame, frames differ in size, or the folder or disk refuses.
    """
    target = Path(path)
    if target.suffix.lower() not in (".mp4", ".gif"):
        raise SpecError("path", str(path), "a name that ends in .mp4 or .gif")
    if not 0 < fps < math.inf:
        raise SpecError("fps", fps, "a finite number above 0 [frames/s]")
    if target.suffix.lower() == ".mp4" and (problem := ffmpeg_problem()):
        target = target.with_suffix(".gif")
        log.warning("ffmpeg does not run (%s): writing %s instead of an mp4", problem, target)
    stream = iter(frames)
    try:
        first = next(stream, None)
        if first is None:
            raise VideoError(f"{target}: there is no frame to write")
        even = (_even(frame, target, first.shape) for frame in itertools.chain([first], stream))
        with Unfinished(target) as part:
            (_write_gif if target.suffix.lower() == ".gif" else _write_mp4)(part, even, fps)
    finally:
        if isinstance(stream, Iterator) and hasattr(stream, "close"):
            stream.close()  # type: ignore[attr-defined]  # a generator of frames frees its renderer
    return target


@functools.cache
def ffmpeg_problem() -> str | None:
    """Why ffmpeg cannot encode here, or None; tried once per process on two tiny frames."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            _write_mp4(Path(folder) / "probe.mp4", itertools.repeat(np.zeros((16, 16, 3), np.uint8), 2), 10.0)
        except (ImportError, OSError, RuntimeError, VideoError) as error:
            return (str(error).strip().splitlines() or [type(error).__name__])[-1]
    return None


def _write_mp4(path: Path, frames: Iterable[np.ndarray], fps: float | int) -> None:
    import imageio_ffmpeg
    import mediapy

    mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    stream = iter(frames)
    first = next(stream)
    writer = mediapy.VideoWriter(
        path,
        first.shape[:2],
        fps=fps,
        codec="h264",
        encoded_format="yuv420p",
        crf=20,
        ffmpeg_args="-movflags +faststart",
    )
    writer.__enter__()
    done = False
    try:
        for frame in itertools.chain([first], stream):
            with refused(path):
                writer.add_image(frame)
        done = True
    finally:
        try:
            with refused(path):
                writer.close()
        except VideoError:
            if done:  # otherwise what broke the loop is the news
                raise
        finally:
            _reap(writer)


def _write_gif(path: Path, frames: Iterable[np.ndarray], fps: float | int) -> None:
    from PIL import Image

    # Palette images, one byte a pixel: Pillow holds all frames until it has seen the last.
    pictures = (Image.fromarray(frame).quantize(128, method=Image.Quantize.FASTOCTREE) for frame in frames)
    first = next(pictures)
    # The format counts hundredths of a second, and browsers slow down anything below two.
    duration = max(20, 10 * round(100 / fps))
    with refused(path), path.open("wb") as file:
        first.save(file, format="GIF", save_all=True, append_images=pictures, duration=duration, loop=0)


def _even(frame: np.ndarray, target: Path, shape: tuple[int, ...]) -> np.ndarray:
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        raise VideoError(f"{target}: a frame is {frame.dtype} {frame.shape}, it must be uint8 (height, width, 3)")
    if frame.shape != shape:
        raise VideoError(f"{target}: frames differ in size, {shape[:2]} and {frame.shape[:2]} pixels")
    odd = frame.shape[0] % 2, frame.shape[1] % 2
    return np.pad(frame, ((0, odd[0]), (0, odd[1]), (0, 0)), mode="edge") if any(odd) else frame


class Unfinished(WholeFile):
    """A `WholeFile` whose errors are one line each."""

    def __enter__(self) -> Path:
        with refused(self.path):
            return super().__enter__()

    def __exit__(self, kind: object, *others: object) -> None:
        with refused(self.path):
            super().__exit__(kind, *others)


class refused:
    """Turns what the system or ffmpeg says into one line that names the file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, _: object) -> None:
        if isinstance(error, OSError | RuntimeError) and not isinstance(error, SwarmError):
            reason = getattr(error, "strerror", None) or (str(error).strip().splitlines() or ["no reason given"])[-1]
            raise VideoError(
                f"cannot write {self._path}: {reason}; is the folder writable and the disk not full?"
            ) from error


def _reap(writer: Any) -> None:
    """Waits for ffmpeg and closes its pipes, which mediapy leaves open when ffmpeg fails."""
    process = writer._popen
    if process is not None:
        for pipe in (process.stdin, process.stderr):
            with suppress(OSError):
                pipe.close()
        process.wait()
