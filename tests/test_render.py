"""Pictures: the right colours at the right pixels, contacts shown when they happen, and a picture on every machine."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from swarm_mjcf.build import GOAL_COLOR, OBSTACLE_COLOR
from swarm_mjcf.caption import bar_height
from swarm_mjcf.errors import SpecError, SwarmError
from swarm_mjcf.overlay import CONTACT, agent_colors
from swarm_mjcf.playback import Playback, onsets
from swarm_mjcf.render import check_gl, frames, scene_view, side_by_side
from swarm_mjcf.spec import SceneSpec

ROOT = Path(__file__).parent.parent
SPEC = SceneSpec(num_agents=3, num_obstacles=2, arena=30.0, agent_radius=2.0, obstacle_radius=5.0)
SIZE = 200
needs_gl = pytest.mark.skipif(check_gl().problem is not None, reason=f"OpenGL: {check_gl().problem}")
BACKENDS = [pytest.param("mujoco", marks=needs_gl), "matplotlib"]


def run(**changes) -> Playback:
    """Three agents move east for six rows; the second obstacle is absent."""
    start = np.array([[-20.0, -15.0], [-20.0, 0.0], [-20.0, 15.0]])
    base = Playback(
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
    return replace(base, **changes)


def draw(playback: Playback, **options) -> list[np.ndarray]:
    return list(frames(SPEC, playback, **{"width": SIZE, "height": SIZE, **options}))


def pixel(frame: np.ndarray, point, camera: str = "top") -> np.ndarray:
    """The colour at a point of the plane [m]."""
    height, width, _ = frame.shape
    view = scene_view(SPEC, run(), camera=camera, width=width, height=height)
    column, row = view.project(np.asarray(point, float))
    return frame[bar_height(height) + int(row), int(column)].astype(float)


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
        assert near(pixel(drawn[t], playback.obstacle[0], camera), 255 * np.array(OBSTACLE_COLOR))
        assert near(pixel(drawn[t], playback.goal, camera), 255 * np.array(GOAL_COLOR))
        assert pixel(drawn[t], playback.obstacle[1], camera).min() > 240  # absent
    # The edge of a body lies where the projection says: just inside its colour, well outside the floor's.
    for angle in np.linspace(0, 2 * np.pi, 7):
        out = np.array([np.cos(angle), np.sin(angle)])
        assert near(pixel(drawn[0], playback.obstacle[0] + 4.2 * out, camera), 255 * np.array(OBSTACLE_COLOR))
        assert pixel(drawn[0], playback.obstacle[0] + 6.0 * out, camera).min() > 240


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
    view = scene_view(SPEC, playback, camera="top", width=400, height=400)
    line = view.project(np.linspace(playback.reference[0, 0], playback.reference[4, 0], 200))
    dark = frame[bar_height(400) + line[:, 1].astype(int), line[:, 0].astype(int)].min(-1) < 200
    assert 0.3 < dark.mean() < 0.9
    assert np.count_nonzero(np.diff(dark)) >= 6


def test_caption_changes_the_bar_and_nothing_else() -> None:
    one, two = (draw(run(title=title), backend="matplotlib")[3] for title in ("one", "a very different title " * 9))
    bar = bar_height(SIZE)
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
    middle = frame[bar_height(SIZE) :][70:110, 80:120]  # away from the arena's border
    rows, columns = np.nonzero(middle.min(-1) < 220)
    assert min(np.ptp(rows), np.ptp(columns)) >= 8  # 4 pixels of radius; the body alone has 1


@needs_gl
def test_default_quality_shows_the_same_scene() -> None:
    fast, default = (draw(run(), backend="mujoco", quality=quality)[2] for quality in ("fast", "default"))
    assert fast.shape == default.shape
    assert near(pixel(default, run().position[2, 1]), agent_colors(3)[1], 30)


@pytest.mark.parametrize("backend", BACKENDS)
def test_side_by_side(backend) -> None:
    left = frames(SPEC, run(), backend=backend, width=SIZE, height=SIZE)
    right = frames(SPEC, run(title="right"), backend=backend, width=150, height=SIZE, camera="tilted", every=2)
    pairs = list(side_by_side(left, right))
    assert len(pairs) == 6
    assert all(frame.shape == (SIZE, SIZE + 4 + 150, 3) for frame in pairs)
    np.testing.assert_array_equal(pairs[3][:, :SIZE], draw(run(), backend=backend)[3])  # interleaving changes nothing
    with pytest.raises(SwarmError, match="heights differ"):
        next(side_by_side(iter([np.zeros((4, 4, 3), np.uint8)]), iter([np.zeros((6, 4, 3), np.uint8)])))


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
