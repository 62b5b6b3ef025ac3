"""Pictures: the right colours at the right pixels, contacts shown when they happen, and a picture on every machine."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from swarm_mjcf.build import GOAL_COLOR, OBSTACLE_COLOR
from swarm_mjcf.camera import scene_camera
from swarm_mjcf.errors import SpecError, SwarmError
from swarm_mjcf.overlay import CONTACT, agent_colors
from swarm_mjcf.panels import tiled
from swarm_mjcf.playback import Playback, onsets
from swarm_mjcf.render import check_gl, drawn_rows, frames, picture_height
from swarm_mjcf.spec import SceneSpec
from swarm_mjcf.timeline import Timeline
from swarm_mjcf.view import View

ROOT = Path(__file__).parent.parent
SPEC = SceneSpec(num_agents=3, num_obstacles=2, arena=30.0, agent_radius=2.0, obstacle_radius=5.0)
SIZE = 200
needs_gl = pytest.mark.skipif(check_gl().problem is not None, reason=f"OpenGL: {check_gl().problem}")
BACKENDS = [pytest.param("mujoco", marks=needs_gl), "matplotlib"]


def run(**changes) -> Playback:
    """Three agents move east for six rows; the second obstacle is absent."""
    start = np.array([[-20.0, -15.0], [-20.0, 0.0], [-20.0, 15.0]])
    base = dict(
        position=start + np.arange(6)[:, None, None] * np.array([6.0, 0.0]),
        agent_present=np.ones(3, bool),
        obstacle=np.array([[20.0, 20.0], [5.0, -20.0]]),
        obstacle_present=np.array([True, False]),
        goal=np.array([22.0, -22.0]),
        touching=np.zeros((6, 3), bool),
        touching_solid=np.zeros((6, 3), bool),
        dt=0.5,
        title="three agents",
    )
    return Playback(**{**base, **changes})


def draw(playback: Playback, **options) -> list[np.ndarray]:
    return list(frames(SPEC, playback, **{"width": SIZE, "height": SIZE, **options}))


def view_of(playback: Playback, camera: str = "top", size: int = SIZE, row: int = 0) -> View:
    """The view that `frames` takes in a frame of `size` pixels."""
    return scene_camera(SPEC, [playback], camera=camera, width=size, height=picture_height(size)).at(row)


def pixel(frame: np.ndarray, point, view: str | View = "top") -> np.ndarray:
    """The colour at a point of the plane [m]."""
    view = view_of(run(), view) if isinstance(view, str) else view
    column, row = view.project(np.asarray(point, float))
    return frame[len(frame) - view.height + int(row), int(column)].astype(float)


def near(color, wanted, tolerance: float = 4.0) -> bool:
    return bool(np.abs(np.asarray(color, float) - wanted).max() <= tolerance)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("camera", ["top", "tilted"])
def test_bodies_have_their_colours_where_they_are(backend, camera) -> None:
    playback = run()
    drawn = draw(playback, backend=backend, camera=camera)
    assert len(drawn) == 6
    for t in (0, 5):
        for i, color in enumerate(agent_colors(3)):
            assert near(pixel(drawn[t], playback.position[t, i], camera), color), (t, i)
        assert near(pixel(drawn[t], playback.obstacle[0, 0], camera), 255 * np.array(OBSTACLE_COLOR))
        assert near(pixel(drawn[t], playback.goal, camera), 255 * np.array(GOAL_COLOR))
        assert pixel(drawn[t], playback.obstacle[0, 1], camera).min() > 240  # absent
    # The edge of a body lies where the projection says: just inside its colour, well outside the floor's.
    for angle in np.linspace(0, 2 * np.pi, 7):
        out = np.array([np.cos(angle), np.sin(angle)])
        assert near(pixel(drawn[0], playback.obstacle[0, 0] + 4.2 * out, camera), 255 * np.array(OBSTACLE_COLOR))
        assert pixel(drawn[0], playback.obstacle[0, 0] + 6.0 * out, camera).min() > 240


@pytest.mark.parametrize("backend", BACKENDS)
def test_absent_agents_are_not_drawn(backend) -> None:
    position = run().position.copy()
    position[3:, 1] = np.nan
    present = np.ones((6, 3), bool)
    present[3:, 1] = False
    drawn = draw(run(position=position, agent_present=present), backend=backend, trail=0.0)
    before, after = pixel(drawn[2], position[2, 1]), pixel(drawn[3], run().position[3, 1])
    assert near(before, agent_colors(3)[1])
    assert after.min() > 240
    nobody = draw(run(agent_present=np.zeros(3, bool)), backend=backend)
    assert all(pixel(nobody[0], point).min() > 240 for point in ([0.0, 0.0], [-5.0, 5.0]))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("field", ["touching", "touching_solid"])
def test_contacts_flash_in_exactly_their_frames(backend, field) -> None:
    flags = np.zeros((6, 3), bool)
    flags[2:4, 1] = True
    drawn = draw(run(**{field: flags}), backend=backend)
    red = [near(pixel(frame, run().position[t, 1]), CONTACT) for t, frame in enumerate(drawn)]
    framed = [near(frame[-1, SIZE // 2], CONTACT) for frame in drawn]
    assert red == framed == [False, False, True, True, False, False]
    assert all(near(pixel(frame, run().position[t, 0]), agent_colors(3)[0]) for t, frame in enumerate(drawn))
    # The ring around it fades out in the frames after, and nowhere before.
    ringed = [bool((np.abs(frame.astype(int) - CONTACT).max(-1) < 60)[60:-10, 10:-10].any()) for frame in drawn]
    assert ringed[:2] == [False, False]
    assert ringed[2:5] == [True, True, True]


def test_a_contact_between_two_drawn_rows_is_shown() -> None:
    flags = np.zeros((6, 3), bool)
    flags[1, 0] = True
    drawn = draw(run(touching=flags), backend="matplotlib", every=3)
    assert len(drawn) == 3  # rows 0, 3, and the last
    assert [near(frame[-1, SIZE // 2], CONTACT) for frame in drawn] == [False, True, False]
    assert near(pixel(drawn[1], run().position[3, 0]), CONTACT)


@pytest.mark.parametrize("backend", BACKENDS)
def test_trails_lie_behind_and_fade(backend) -> None:
    playback = run()
    last = draw(playback, backend=backend, trail=2.0)[-1]  # four rows
    behind = 255 - pixel(last, playback.position[4, 0]).min()
    older = 255 - pixel(last, playback.position[2, 0]).min()
    assert behind > older > 5
    assert pixel(last, playback.position[0, 0]).min() > 240
    assert pixel(last, playback.position[5, 0] + [5.0, 0.0]).min() > 240
    assert pixel(draw(playback, backend=backend, trail=0.0)[-1], playback.position[4, 0]).min() > 225


def test_reference_is_drawn_dashed() -> None:
    playback = run(reference=run().position + np.array([0.0, 6.0]))
    frame = draw(playback, backend="matplotlib", width=400, height=400)[-1].astype(int)
    view = view_of(playback, size=400)
    line = view.project(np.linspace(playback.reference[0, 0], playback.reference[4, 0], 200))
    dark = frame[400 - view.height + line[:, 1].astype(int), line[:, 0].astype(int)].min(-1) < 200
    assert 0.3 < dark.mean() < 0.9
    assert np.count_nonzero(np.diff(dark)) >= 6


def test_caption_changes_the_bar_and_nothing_else() -> None:
    one, two = (draw(run(title=title), backend="matplotlib")[3] for title in ("one", "a very different title " * 9))
    bar = SIZE - picture_height(SIZE)
    assert (one[:bar] != two[:bar]).any()
    np.testing.assert_array_equal(one[bar:], two[bar:])
    later = draw(run(title="one"), backend="matplotlib")[4]
    assert (one[:bar, SIZE // 2 :] != later[:bar, SIZE // 2 :]).any()  # the time


def test_contact_events_are_counted_once() -> None:
    hit = np.array([[1, 0], [1, 0], [0, 1], [1, 1], [0, 0]], bool)
    np.testing.assert_array_equal(onsets(hit), [1, 1, 2, 3, 3])


def test_small_agents_get_a_ring_that_is_seen() -> None:
    spec = SceneSpec(num_agents=1, num_obstacles=0)
    position = np.array([[[-95.0, -95.0]], [[95.0, 95.0]], [[0.0, 0.0]]])
    none = np.zeros((3, 1), bool)
    playback = Playback(
        position=position,
        agent_present=np.ones(1, bool),
        obstacle=np.zeros((0, 2)),
        obstacle_present=np.zeros(0, bool),
        touching=none,
        touching_solid=none,
        dt=1.0,
    )
    frame = list(frames(spec, playback, backend="matplotlib", width=SIZE, height=SIZE, trail=0.0))[-1].astype(int)
    middle = frame[SIZE - picture_height(SIZE) :][60:105, 75:125]  # away from the arena's border
    rows, columns = np.nonzero(middle.min(-1) < 220)
    assert min(np.ptp(rows), np.ptp(columns)) >= 8  # 4 pixels of radius; the body alone has 1


@needs_gl
def test_default_quality_shows_the_same_scene() -> None:
    fast, default = (draw(run(), backend="mujoco", quality=quality)[2] for quality in ("fast", "default"))
    assert fast.shape == default.shape
    assert near(pixel(default, run().position[2, 1]), agent_colors(3)[1], 30)


@pytest.mark.parametrize("backend", BACKENDS)
def test_panels_show_what_each_stream_shows(backend) -> None:
    """Painters that take turns do not disturb each other; a shorter stream stays on its last picture."""
    options = {"backend": backend, "width": SIZE, "height": SIZE}
    streams = [frames(SPEC, run(), **options), frames(SPEC, run(title="two"), **options, camera="tilted", every=2)]
    streams.append(frames(SPEC, run(title="three"), **options))
    whole = list(tiled(streams, columns=2))
    assert len(whole) == 6
    assert all(frame.shape == (2 * SIZE + 4, 2 * SIZE + 4, 3) for frame in whole)
    alone = draw(run(), backend=backend)
    other = draw(run(title="two"), backend=backend, camera="tilted", every=2)
    for number, frame in enumerate(whole):
        np.testing.assert_array_equal(frame[:SIZE, :SIZE], alone[number])
        np.testing.assert_array_equal(frame[:SIZE, SIZE + 4 :], other[min(number, 3)])
        np.testing.assert_array_equal(frame[SIZE + 4 + 60 :, :SIZE], alone[number][60:])
        assert np.ptp(frame[SIZE + 4 :, SIZE + 4 :].reshape(-1, 3), axis=0).max() == 0  # no stream fills it


def test_panels_close_their_streams_and_say_what_is_wrong() -> None:
    closed = []

    def stream(name: str, *sizes: int):
        try:
            for size in sizes:
                yield np.zeros((size, 8, 3), np.uint8)
        finally:
            closed.append(name)

    two = tiled([stream("a", 4, 4), stream("b", 4, 4, 4)], columns=1)
    assert next(two).shape == (12, 8, 3)
    two.close()
    assert closed == ["a", "b"]
    with pytest.raises(SwarmError, match="sizes differ, 4 x 8 and 6 x 8"):
        next(tiled([stream("c", 4), stream("d", 6)], columns=2))
    with pytest.raises(SwarmError, match="1 of 2 streams have no picture"):
        next(tiled([stream("e", 4), stream("f")], columns=2))
    assert closed == list("abcdfe") or closed == list("abcdef")
    for given, field in (([], "streams"), ([stream("g", 4)], "columns")):
        with pytest.raises(SpecError, match=field):
            tiled(given, columns=0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_obstacles_move_and_vanish(backend) -> None:
    obstacle = np.repeat(run().obstacle[:1], 6, axis=0).copy()
    obstacle[:, 0, 1] = np.linspace(20, -8, 6)
    there = np.ones((6, 2), bool)
    there[:, 1], there[5] = False, False
    playback = run(obstacle=obstacle, obstacle_present=there)
    drawn, view = draw(playback, backend=backend), view_of(playback)
    grey = 255 * np.array(OBSTACLE_COLOR)
    for t in range(5):
        assert near(pixel(drawn[t], obstacle[t, 0], view), grey), t
    assert pixel(drawn[4], obstacle[0, 0], view).min() > 240
    assert pixel(drawn[5], obstacle[5, 0], view).min() > 240


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_following_camera_draws_bodies_where_it_says(backend) -> None:
    playback = run()
    drawn = draw(playback, backend=backend, camera="follow", width=300, height=300, trail=0.0)
    for t in (0, 3, 5):
        view = view_of(playback, "follow", 300, t)
        for i, color in enumerate(agent_colors(3)):
            assert near(pixel(drawn[t], playback.position[t, i], view), color), (t, i)
    assert view_of(playback, "follow", 300, 0).center[0] < view_of(playback, "follow", 300, 5).center[0]


def test_lines_on_the_ground_pass_below_bodies() -> None:
    """An agent at rest on a line of the grid keeps its colour, and the line is seen beside it."""
    position = np.broadcast_to(np.array([[[0.0, 0.0], [12.0, 9.0], [-12.0, -9.0]]]), (6, 3, 2))
    none = np.zeros(2, bool)
    playback = run(position=position, obstacle_present=none, goal=None)
    frame = draw(playback, camera="follow", backend="matplotlib", trail=0.0, width=400, height=400)[0]
    view = view_of(playback, "follow", 400)
    assert near(pixel(frame, [0.0, 0.0], view), agent_colors(3)[0])
    beside = np.array([pixel(frame, [0.0, y], view) for y in np.linspace(3, 4.5, 40)])
    between = np.array([pixel(frame, [1.0, y], view) for y in np.linspace(3, 4.5, 40)])
    assert beside.mean() < between.mean() - 8


@pytest.mark.parametrize("backend", BACKENDS)
def test_without_contacts_nothing_tells_of_them(backend) -> None:
    flags = np.zeros((6, 3), bool)
    flags[2:4, 1] = True
    touched = draw(run(touching=flags), backend=backend, contacts=False)
    for one, other in zip(touched, draw(run(), backend=backend, contacts=False), strict=True):
        np.testing.assert_array_equal(one, other)
    assert (touched[2] != draw(run(touching=flags), backend=backend)[2]).any()


def test_a_cross_stays_where_a_contact_began() -> None:
    flags = np.zeros((6, 3), bool)
    flags[1:3, 1] = True
    drawn = draw(run(touching=flags), backend="matplotlib", trail=0.0, width=400, height=400)
    view = view_of(run(), size=400)
    for place, marked in ((run().position[1, 1], True), (run().position[2, 1], False)):
        column, row = view.project(place)
        part = drawn[5][400 - view.height + int(row) - 4 :, int(column) - 4 :][:9, :9].astype(int)
        dark = (part[..., 0] - part[..., 1] > 60).sum()
        assert (dark > 8) == marked, (place, dark)


def test_the_timeline_shows_past_contacts_by_depth() -> None:
    hit = np.zeros((11, 3), bool)
    hit[[2, 6], 0] = True
    depth = np.zeros((11, 3))
    depth[2, 0], depth[6, 0], depth[8, 1] = 1.0, 0.5, 9.0  # the last touches nobody: no contact, no column
    base = {
        "position": np.zeros((11, 3, 2)),
        "touching": hit,
        "touching_solid": hit & False,
        "depth": depth,
    }
    line = Timeline(run(**base), hit=hit, radius=1.0, width=101, height=8)
    canvas = np.zeros((8, 101, 3), np.uint8)
    line.paint(canvas, 10)
    red = (canvas == CONTACT).all(axis=-1).sum(axis=0)
    np.testing.assert_array_equal(np.flatnonzero(red), [*range(11, 21), *range(51, 61)])  # steps end at rows 2 and 6
    assert set(red[11:21]) == {8}
    assert set(red[51:61]) == {4}
    line.paint(canvas, 5)
    red = (canvas == CONTACT).all(axis=-1).sum(axis=0)
    np.testing.assert_array_equal(np.flatnonzero(red), range(11, 21))  # the future is not told


def words(**options) -> list[dict]:
    """What captions say."""
    from swarm_mjcf.caption import Caption

    said, paint = [], Caption.paint
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Caption, "paint", lambda self, canvas, **text: (said.append(text), paint(self, canvas, **text)))
        playback = options.pop("playback", run())
        draw_with = options.pop("spec", SPEC)
        list(frames(draw_with, playback, width=SIZE, height=SIZE, backend="matplotlib", **options))
    return said


def test_the_caption_says_time_pace_and_contacts() -> None:
    flags = np.zeros((6, 3), bool)
    flags[1, :2], flags[3, 0] = True, True
    depth = np.where(flags, 0.25, 0.0)
    depth[3, 0] = 0.125
    said = words(playback=run(touching=flags, depth=depth), speed=2.0)
    assert [text["time"] for text in said] == [f"t = {0.5 * t:.1f} s · 2×" for t in range(6)]
    assert said[0]["counts"] == "contacts: agent 0 · obstacle 0"
    assert said[1]["counts"] == said[2]["counts"] == "contacts: agent 2 · obstacle 0 · deepest 0.25 m"
    assert said[5]["counts"] == "contacts: agent 3 · obstacle 0 · deepest 0.25 m"
    assert [text["alarm"] for text in said] == [False, True, False, True, False, False]
    assert words(speed=1)[2]["time"] == "t = 1.0 s · real time"
    assert words(contacts=False)[0]["counts"] == "3 agents"
    uncounted = replace(SPEC, contacts=False, substeps=1)
    assert words(spec=uncounted)[0]["counts"] == "contacts: not counted"
    other = run(reference=run().position, reference_title="expert")
    assert words(playback=other)[0]["note"] == "dashed: expert"
    assert words(camera="follow")[0]["note"].startswith("grid ")


def test_a_hundred_agents_have_their_own_colours() -> None:
    colors = agent_colors(100)
    apart = np.abs(colors[:, None] - colors[None]).max(-1)[~np.eye(100, dtype=bool)]
    assert apart.min() > 1
    assert np.abs(colors - CONTACT).max(-1).min() > 25


def test_drawn_rows_end_with_the_last() -> None:
    assert drawn_rows(7, 3) == [0, 3, 6]
    assert drawn_rows(8, 3) == [0, 3, 6, 7]
    assert drawn_rows(1, 5) == [0]


def test_frames_stream() -> None:
    rows = 200_000  # far more than memory would hold as pictures
    still = np.zeros((rows, 3), bool)
    position = np.broadcast_to(run().position[:1], (rows, 3, 2))
    long = run(position=position, touching=still, touching_solid=still, agent_present=np.ones(3, bool))
    stream = frames(SPEC, long, backend="matplotlib")
    assert next(stream).shape == (480, 480, 3)
    stream.close()


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"position": np.zeros((6, 3))}, "position"),
        ({"touching": np.zeros((5, 3), bool)}, "touching"),
        ({"touching": np.zeros((6, 3))}, "touching"),
        ({"agent_present": np.ones(4, bool)}, "agent_present"),
        ({"goal": np.zeros(3)}, "goal"),
        ({"depth": np.zeros((6, 2))}, "depth"),
        ({"obstacle": np.zeros((5, 2, 2))}, "obstacle"),
        ({"obstacle": np.zeros(2)}, "obstacle"),
        ({"obstacle_present": np.ones((6, 3), bool)}, "obstacle_present"),
        ({"obstacle": np.full((6, 2, 2), np.nan)}, "obstacle"),
        ({"dt": 0.0}, "dt"),
        ({"position": np.full((6, 3, 2), np.nan)}, "position"),
    ],
)
def test_playback_says_what_is_wrong(change, field) -> None:
    with pytest.raises(SpecError, match=field):
        run(**change)


def test_frames_says_what_is_wrong() -> None:
    for options in ({"camera": "side"}, {"width": 10}, {"every": 0}, {"trail": -1.0}, {"trail": float("nan")}):
        with pytest.raises(SpecError, match=next(iter(options))):
            frames(SPEC, run(), **options)


_SCRIPT = """
import numpy as np
from swarm_mjcf.render import check_gl, frames
from swarm_mjcf.spec import SceneSpec
from swarm_mjcf.playback import Playback
flags = np.zeros((2, 1), bool)
playback = Playback(position=np.zeros((2, 1, 2)), agent_present=np.ones(1, bool), obstacle=np.zeros((0, 2)),
    obstacle_present=np.zeros(0, bool), touching=flags, touching_solid=flags, dt=1.0)
print(len(list(frames(SceneSpec(), playback, width=100, height=100))), check_gl().problem)
"""
_NO_EGL = """
import ctypes, ctypes.util
find, load = ctypes.util.find_library, ctypes.CDLL
class CDLL(load):
    def __init__(self, name, *rest, **more):
        if name and "EGL" in str(name):
            raise OSError(f"{name}: cannot open shared object file")
        super().__init__(name, *rest, **more)
ctypes.CDLL, ctypes.cdll = CDLL, ctypes.LibraryLoader(CDLL)
ctypes.util.find_library = lambda name: None if "EGL" in name else find(name)
"""


def render_elsewhere(folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Draws in a process of its own; `folder` may hold a sitecustomize.py."""
    keep = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    paths = os.pathsep.join([str(folder), str(ROOT)])
    child = subprocess.run(
        [sys.executable, "-c", _SCRIPT],
        env={**keep, "PYTHONPATH": paths, **environment},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert child.returncode == 0, child.stderr
    assert "Traceback" not in child.stderr
    return child


@pytest.mark.parametrize("asked", ["", "egl"])
def test_without_egl_matplotlib_draws_and_the_package_is_named(tmp_path, asked) -> None:
    (tmp_path / "sitecustomize.py").write_text(_NO_EGL)
    child = render_elsewhere(tmp_path, MUJOCO_GL=asked)
    assert child.stdout.startswith("2 libEGL is not installed")
    assert "matplotlib" in child.stderr
    assert "libegl1" in child.stderr


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({"MUJOCO_GL": "egl", "MUJOCO_EGL_DEVICE_ID": "99"}, "MUJOCO_EGL_DEVICE_ID"),
        ({"MUJOCO_GL": "nonsense"}, "nonsense"),
        ({"MUJOCO_GL": "off"}, "switches drawing off"),
    ],
)
def test_broken_settings_are_told_in_one_line(tmp_path, environment, said) -> None:
    child = render_elsewhere(tmp_path, **environment)
    assert child.stdout.startswith("2 ")
    assert "drawn by matplotlib" in child.stderr


def test_a_context_that_fails_only_here_falls_back(monkeypatch, caplog) -> None:
    from swarm_mjcf import gl, render

    def broken(width: int, height: int) -> None:
        raise RuntimeError("no context today")

    monkeypatch.setattr(gl, "new_context", broken)
    monkeypatch.setattr(render, "check_gl", lambda: gl.GLReport("egl", "card", "4.5", False))
    assert len(draw(run())) == 6
    assert "no context today" in caplog.text
    with pytest.raises(SwarmError, match="no context today"):
        draw(run(), backend="mujoco")
