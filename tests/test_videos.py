"""Videos of recordings: right number, rate and size of pictures, contacts where they were, clear refusals."""

import os
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from test_figures import scenes

from envs.config import clear
from envs.plain import plain
from envs.storage import save
from swarm_mjcf.errors import SpecError, SwarmError
from swarm_mjcf.overlay import CONTACT
from swarm_mjcf.playback import onsets
from swarm_mjcf.video import ffmpeg_problem
from swarmnet.videos import MIN_FPS, find_videos, make_video, make_videos, playback, scene_spec, timing

needs_ffmpeg = pytest.mark.skipif(ffmpeg_problem() is not None, reason=f"ffmpeg: {ffmpeg_problem()}")
SMALL = {"size": 96, "renderer": "matplotlib"}


def pictures(path) -> list[np.ndarray]:
    with Image.open(path) as image:
        frames = []
        for number in range(image.n_frames):
            image.seek(number)
            frames.append(np.asarray(image.convert("RGB")).astype(int))
        return frames


@pytest.fixture
def pair(tmp_path):
    """Two files of the same scenes."""
    save(tmp_path / "expert.h5", scenes())
    save(tmp_path / "learned.h5", replace(scenes(), provenance={"policy": "learned"}))
    return tmp_path / "expert.h5", tmp_path / "learned.h5"


@pytest.mark.parametrize(("dt", "speed"), [(0.3, 2.0), (0.1, 1.0), (0.5, 0.25), (0.02, 2.0), (0.001, 1.0)])
def test_motion_is_smooth_and_keeps_its_pace(dt, speed) -> None:
    pace = timing(dt, speed)
    assert MIN_FPS <= pace.fps <= 40
    assert pace.fps * dt * pace.every / pace.between == pytest.approx(speed)


def test_positions_are_interpolated_and_contacts_are_not() -> None:
    data = scenes()
    shown = playback(data, 1, "x", between=4)
    assert shown.position.shape == (21, 2, 2)
    assert shown.dt == 0.5 / 4
    np.testing.assert_allclose(shown.position[:, 0, 0], 4 * np.arange(21) / 4, atol=1e-6)
    np.testing.assert_array_equal(shown.position[::4, 0], data.position[1, :, 2])
    # The contact of the step that ends at row 3 is that of pictures 9..12: one step, one event.
    np.testing.assert_array_equal(np.flatnonzero(shown.touching_solid[:, 0]), [9, 10, 11, 12])
    assert not shown.touching.any()
    assert onsets(shown.solid_hit)[-1] == 1
    # The second agent's last row is 3; nothing is drawn on its way to the zeros of masked rows.
    np.testing.assert_array_equal(np.flatnonzero(shown.agent_present[:, 1]), np.arange(13))
    np.testing.assert_array_equal(shown.goal, [30, 0])
    np.testing.assert_array_equal(shown.obstacle, [[10, 12]])


def test_contacts_of_successive_steps_stay_one_event() -> None:
    data = scenes()
    data.agent_contact[0, 2:5, 2] = 1
    shown = playback(data, 0, "x", between=3)
    np.testing.assert_array_equal(np.flatnonzero(shown.touching[:, 0]), np.arange(4, 13))
    assert onsets(shown.agent_hit)[-1] == 1


def test_the_scene_is_the_recorded_one_or_has_its_radii() -> None:
    built = scene_spec(scenes())
    assert (built.num_agents, built.num_obstacles, built.agent_radius, built.obstacle_radius) == (2, 1, 1.0, 4.0)
    world = clear(num_agents=2)
    world = replace(world, scene=replace(world.scene, max_acceleration=float("inf")))
    assert scene_spec(replace(scenes(), provenance={"world": plain(world)})) == world.scene


def test_a_video_has_its_pictures_and_its_contacts(pair, tmp_path) -> None:
    out = make_video(pair[0], tmp_path / "one.gif", scene=1, speed=2.0, **SMALL)
    pace = timing(0.5, 2.0)
    drawn = pictures(out)
    assert len(drawn) == 5 * pace.between + 1
    assert drawn[0].shape == (96, 96, 3)
    with Image.open(out) as image:
        assert image.info["duration"] == pytest.approx(1000 / pace.fps, abs=10)
    framed = [np.abs(picture[-2, 48] - CONTACT).max() < 40 for picture in drawn]
    first, last = 2 * pace.between + 1, 3 * pace.between
    assert framed == [first <= number <= last for number in range(len(drawn))]


@needs_ffmpeg
def test_side_by_side_as_mp4(pair, tmp_path) -> None:
    import imageio_ffmpeg

    out = make_video(pair[0], tmp_path / "both.mp4", beside=pair[1], camera="tilted", **SMALL)
    program = imageio_ffmpeg.get_ffmpeg_exe()
    read = subprocess.run([program, "-i", out, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True)
    assert len(read.stdout) == (5 * timing(0.5, 2.0).between + 1) * 96 * (2 * 96 + 4) * 3


def test_what_cannot_be_shown_is_said(pair, tmp_path) -> None:
    out = tmp_path / "x.gif"
    with pytest.raises(SwarmError, match=r"there is no scene 2; it holds 2 scenes, 0 to 1"):
        make_video(pair[0], out, scene=2, **SMALL)
    with pytest.raises(SwarmError, match="there is no scene -1"):
        make_video(pair[0], out, scene=-1, **SMALL)
    with pytest.raises(SwarmError, match="does not exist"):
        make_video(tmp_path / "none.h5", out, **SMALL)
    with pytest.raises(SpecError, match="speed"):
        make_video(pair[0], out, speed=0.0, **SMALL)
    save(tmp_path / "moved.h5", scenes(shift=2.0))
    save(tmp_path / "slower.h5", replace(scenes(), dt=0.25))
    for name, said in (("moved", "other starts"), ("slower", r"dt 0\.5 s in one and 0\.25 s")):
        with pytest.raises(SwarmError, match=f"do not hold the same scenes.*{said}"):
            make_video(pair[0], out, beside=tmp_path / f"{name}.h5", **SMALL)
    assert not out.exists()


def test_shorter_recordings_stay_on_their_last_picture(pair, tmp_path) -> None:
    save(tmp_path / "short.h5", scenes(rows=4))
    drawn = pictures(make_video(pair[0], tmp_path / "x.gif", beside=tmp_path / "short.h5", **SMALL))
    assert len(drawn) == 5 * timing(0.5, 2.0).between + 1
    assert np.abs(drawn[-1][:, 110:] - drawn[-2][:, 110:]).max() < 30  # quantised apart


def test_videos_of_a_run_are_made_once(tmp_path) -> None:
    assert make_videos(tmp_path, 2) == []
    save(tmp_path / "rollouts" / "expert.h5", scenes())
    save(tmp_path / "rollouts" / "learned.h5", scenes())
    said = []
    videos = make_videos(tmp_path, 2, progress=lambda done, total, note: said.append((done, total)), size=64)
    # Scene 1 has the contact.
    assert [video.path.stem for video in videos] == ["scene-0001-top", "scene-0001-tilted", "scene-0000-top"]
    assert [done for done, _ in said] == [0, 1, 2, 3]
    assert all(video.poster is not None and video.poster.exists() for video in videos)
    before = [video.path.stat().st_mtime_ns for video in videos]
    assert [video.path.stat().st_mtime_ns for video in make_videos(tmp_path, 2, size=64)] == before
    for video in videos:  # rollouts newer than the videos
        os.utime(video.path, (1, 1))
    assert find_videos(tmp_path) == []
    assert [video.path.stem for video in make_videos(tmp_path, 1, size=64)] == ["scene-0001-top", "scene-0001-tilted"]
