"""Video files: decodable, of the right size and length, whole or not there at all."""

import errno
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from swarm_mjcf import video
from swarm_mjcf.errors import SpecError, SwarmError
from swarm_mjcf.video import VideoError, ffmpeg_problem, write_video

needs_ffmpeg = pytest.mark.skipif(ffmpeg_problem() is not None, reason=f"ffmpeg: {ffmpeg_problem()}")


def pictures(count: int = 12, height: int = 64, width: int = 96):
    """Plain frames from blue to yellow."""
    for k in range(count):
        frame = np.empty((height, width, 3), np.uint8)
        frame[:] = np.array([20, 40, 200]) + (k * np.array([200, 180, -180])) // max(count - 1, 1)
        yield frame


@pytest.fixture
def no_ffmpeg(monkeypatch, tmp_path):
    """A machine on which ffmpeg does not start."""
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "missing" / "ffmpeg"))
    ffmpeg_problem.cache_clear()
    yield
    ffmpeg_problem.cache_clear()


@needs_ffmpeg
@pytest.mark.parametrize(("height", "width"), [(64, 96), (65, 97)])
def test_mp4_is_read_back(tmp_path, height, width) -> None:
    import imageio_ffmpeg  # mediapy 1.2.7 cannot read with ffmpeg 9, which has no `-vsync`; writing is not concerned

    path = write_video(tmp_path / "new" / "run.mp4", pictures(height=height, width=width), 10.0)
    assert path == tmp_path / "new" / "run.mp4"
    program = imageio_ffmpeg.get_ffmpeg_exe()
    read = subprocess.run([program, "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True)
    clip = np.frombuffer(read.stdout, np.uint8).reshape(-1, height + height % 2, width + width % 2, 3)
    assert len(clip) == 12
    assert all(word in read.stderr for word in (b"h264", b"yuv420p", b"10 fps"))
    assert np.abs(clip[0].astype(int) - [20, 40, 200]).max() < 12
    assert np.abs(clip[-1].astype(int) - [220, 220, 20]).max() < 12
    assert [file.name for file in path.parent.iterdir()] == ["run.mp4"]


def test_gif_is_read_back(tmp_path) -> None:
    path = write_video(tmp_path / "run.gif", pictures(), 10.0)
    with Image.open(path) as image:
        assert (image.n_frames, image.size, image.info["duration"]) == (12, (96, 64), 100)
        assert np.abs(np.asarray(image.convert("RGB")).astype(int) - [20, 40, 200]).max() < 40


def test_without_ffmpeg_a_gif_is_written(tmp_path, no_ffmpeg, caplog) -> None:
    path = write_video(tmp_path / "run.mp4", pictures(), 10.0)
    assert path == tmp_path / "run.gif"
    assert "ffmpeg does not run" in caplog.text
    assert [file.name for file in tmp_path.iterdir()] == ["run.gif"]
    with Image.open(path) as image:
        assert image.n_frames == 12


@pytest.mark.parametrize("name", ["run.gif", pytest.param("run.mp4", marks=needs_ffmpeg)])
@pytest.mark.parametrize("interruption", [KeyboardInterrupt(), ZeroDivisionError("in the simulation")])
def test_interrupted_writing_leaves_nothing_new(tmp_path, name, interruption) -> None:
    def breaking():
        yield from pictures(5)
        raise interruption

    (tmp_path / name).write_text("an older file")
    with pytest.raises(type(interruption)):
        write_video(tmp_path / name, breaking(), 10.0)
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [(name, "an older file")]


@needs_ffmpeg
def test_ffmpeg_that_dies_on_the_way_is_one_clear_error(tmp_path, monkeypatch) -> None:
    import mediapy

    def full(self: object, image: np.ndarray) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(mediapy.VideoWriter, "add_image", full)
    with pytest.raises(VideoError, match="No space left on device"):
        write_video(tmp_path / "run.mp4", pictures(), 10.0)
    assert list(tmp_path.iterdir()) == []


@needs_ffmpeg
def test_what_ffmpeg_says_is_passed_on(tmp_path) -> None:
    with pytest.raises(VideoError, match="cannot write"):
        video._write_mp4(Path(tmp_path / "missing" / "run.mp4"), pictures(), 10.0)


def test_a_folder_that_cannot_be_is_a_clear_error(tmp_path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SwarmError, match="cannot write"):
        write_video(tmp_path / "file" / "run.gif", pictures(), 10.0)


def test_frames_that_make_no_video(tmp_path) -> None:
    def growing():
        yield np.zeros((8, 8, 3), np.uint8)
        yield np.zeros((8, 10, 3), np.uint8)

    path = tmp_path / "run.gif"
    for frames, said in ((iter([]), "no frame"), (growing(), "differ in size"), ([np.zeros((8, 8, 3))], "uint8")):
        with pytest.raises(VideoError, match=said):
            write_video(path, frames, 10.0)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(SpecError, match="path"):
        write_video(tmp_path / "run.avi", pictures(), 10.0)
    with pytest.raises(SpecError, match="fps"):
        write_video(path, pictures(), 0.0)


def test_frames_are_taken_one_at_a_time_and_closed(tmp_path) -> None:
    closed = []

    def stream():
        try:
            yield from pictures(4)
        finally:
            closed.append(True)

    write_video(tmp_path / "run.gif", stream(), 10.0)
    assert closed == [True]
