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
from swarmnet.cli import main
from swarmnet.film import MIN_FPS, Look, Panel, film, playback, scene_spec, timing
from swarmnet.videos import find_videos, make_video, make_videos

needs_ffmpeg = pytest.mark.skipif(ffmpeg_problem() is not None, reason=f"ffmpeg: {ffmpeg_problem()}")
SMALL = Look(size=96, renderer="matplotlib")


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
    np.testing.assert_array_equal(shown.obstacle, np.broadcast_to([[10, 12]], (21, 1, 2)))


def test_obstacles_move_like_agents_and_come_and_go() -> None:
    data = scenes()
    data.position[0, :, 1] = np.array([10, 12]) + 2 * np.arange(6)[:, None]
    data.mask[0, 4:, 1] = False
    data.depth[0, 2, 2] = 0.25
    shown = playback(data, 0, "x", between=2)
    np.testing.assert_allclose(shown.obstacle[:, 0], np.array([10, 12]) + np.arange(11)[:, None])
    np.testing.assert_array_equal(np.flatnonzero(shown.obstacle_present[:, 0]), np.arange(7))
    assert shown.depth is not None
    np.testing.assert_array_equal(np.flatnonzero(shown.depth[:, 0]), [3, 4])  # the pictures of the step to row 2


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
    out = make_video(pair[:1], tmp_path / "one.gif", scenes=[1], look=SMALL)
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

    told = []
    out = make_video(
        pair,
        tmp_path / "both.mp4",
        look=replace(SMALL, camera="tilted"),
        progress=lambda done, total, note: told.append((done, total)),
    )
    program = imageio_ffmpeg.get_ffmpeg_exe()
    read = subprocess.run([program, "-i", out, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True)
    count = 5 * timing(0.5, 2.0).between + 1
    assert len(read.stdout) == count * 96 * (2 * 96 + 4) * 3
    assert told == [(number + 1, count) for number in range(count)]


def test_compared_recordings_share_a_view_and_scenes_of_one_file_do_not() -> None:
    """The agents of the second recording end elsewhere; what stands still has one place in both pictures."""
    one, other = scenes(count=1), scenes(count=1)
    other.position[0, 1:, 3, 1] = 60
    two = [Panel(one, "a"), Panel(other, "b", one, "a")]
    shared, own = (
        next(film(two, replace(SMALL, contacts=False), columns=2, one_view=view).pictures).astype(int)
        for view in (True, False)
    )
    left, right = shared[45:, :96], shared[45:, 100:]
    grey = [np.argwhere(np.abs(part - [140, 145, 153]).max(-1) < 6).mean(axis=0) for part in (left, right)]
    np.testing.assert_allclose(grey[0], grey[1], atol=1)
    part = own[45:, :96], own[45:, 100:]
    grey = [np.argwhere(np.abs(picture - [140, 145, 153]).max(-1) < 6).mean(axis=0) for picture in part]
    assert np.abs(grey[0] - grey[1]).max() > 3


def test_many_panels_are_smaller_and_too_many_are_refused() -> None:
    panels = [Panel(scenes(count=1), "x")] * 9
    first = next(film(panels, Look(renderer="matplotlib"), columns=3).pictures)
    assert first.shape == (3 * 484 - 4, 3 * 484 - 4, 3)
    assert next(film(panels[:5], Look(renderer="matplotlib"), columns=5).pictures).shape == (288, 5 * 292 - 4, 3)
    with pytest.raises(SpecError, match="size: 600 was given, allowed is at most 451 pixels"):
        film(panels, Look(size=600), columns=9)


def test_what_cannot_be_shown_leaves_no_file(pair, tmp_path) -> None:
    out = tmp_path / "x.gif"
    with pytest.raises(SwarmError, match="does not exist"):
        make_video([tmp_path / "none.h5"], out, look=SMALL)
    with pytest.raises(SpecError, match="speed"):
        make_video(pair, out, look=replace(SMALL, speed=0.0))
    with pytest.raises(SpecError, match="camera"):
        make_video(pair, out, look=replace(SMALL, camera="inside"))
    with pytest.raises(SpecError, match="size: 8 was given, allowed is at least 64"):
        make_video(pair, out, look=replace(SMALL, size=8))
    with pytest.raises(SpecError, match="ends in"):
        make_video(pair, tmp_path / "x.avi", look=SMALL)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["expert.h5", "learned.h5"]


def test_an_interrupted_video_leaves_nothing(pair, tmp_path) -> None:
    def interrupt(done: int, total: int, note: str) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_video(pair, tmp_path / "x.gif", look=SMALL, progress=interrupt)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["expert.h5", "learned.h5"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--camera", "follow", "--grid", "1x2", "--speed", "1"), (1, 2)),
        (("--no-contacts", "--scene", "1"), (1, 1)),
        (("--scene", "1", "0", "1"), (1, 3)),
    ],
)
def test_the_command_writes_the_panels_it_was_asked_for(pair, tmp_path, capsys, arguments, said) -> None:
    out = tmp_path / "new" / "x.gif"
    assert (
        main(["render", str(pair[0]), *arguments, "--size", "64", "--renderer", "matplotlib", "--out", str(out)]) == 0
    )
    assert capsys.readouterr().out.strip() == str(out)
    rows, columns = said
    with Image.open(out) as image:
        assert image.size == (columns * 68 - 4, rows * 68 - 4)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--out", "x.avi"), "out: 'x.avi' was given"),
        (("--out", "x.pdf", "--speed", "3"), "speed: 3.0 was given, allowed is nothing"),
        (("--width", "page"), "width: 'page' was given, allowed is nothing"),
    ],
)
def test_the_command_refuses_what_would_mean_nothing(pair, capsys, arguments, said) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(["render", str(pair[0]), *arguments])
    assert exit_.value.code == 2
    captured = capsys.readouterr()
    assert said in " ".join((captured.out + captured.err).replace("│", " ").split())


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
