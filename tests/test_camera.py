"""Cameras: nothing is lost from sight, a following one is calm, and runs that are compared share one."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_mjcf.camera import CAMERAS, FOLLOW_SECONDS, scene_camera
from swarm_mjcf.errors import SpecError
from swarm_mjcf.playback import Playback
from swarm_mjcf.spec import SceneSpec
from swarm_mjcf.view import DISC_TOP, FOVY

SPEC = SceneSpec(num_agents=4, num_obstacles=0, goal=False, agent_radius=1.0)
WIDTH, HEIGHT, DT = 320, 240, 0.1


def playback(position: np.ndarray, present: np.ndarray | None = None, **more) -> Playback:
    rows, agents, _ = position.shape
    nothing = np.zeros((rows, agents), bool)
    return Playback(
        position=position,
        agent_present=np.ones(agents, bool) if present is None else present,
        obstacle=np.zeros((0, 2)),
        obstacle_present=np.zeros(0, bool),
        touching=nothing,
        touching_solid=nothing,
        dt=DT,
        **more,
    )


def camera(kind: str, *shown: Playback):
    return scene_camera(SPEC, shown, camera=kind, width=WIDTH, height=HEIGHT)


def walk(seed: int, rows: int, agents: int = 4, step: float = 2.0) -> np.ndarray:
    """Agents that stagger."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-60, 60, (1, agents, 2)) + np.cumsum(rng.normal(0, step, (rows, agents, 2)), axis=0)


@given(
    seed=st.integers(0, 10_000),
    rows=st.integers(1, 120),
    kind=st.sampled_from(CAMERAS),
    leaving=st.booleans(),
)
def test_every_body_that_is_there_is_in_the_picture(seed: int, rows: int, kind: str, leaving: bool) -> None:
    position = walk(seed, rows)
    present = np.random.default_rng(seed).random((rows, 4)) < 0.6 if leaving else np.ones((rows, 4), bool)
    shot = camera(kind, playback(position, present))
    around = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]) * SPEC.agent_radius
    for row in range(rows):
        seen = shot.at(row).project(position[row, present[row], None] + around)
        assert (seen >= 0).all()
        assert (seen <= (WIDTH, HEIGHT)).all()


def test_following_is_calm() -> None:
    """Agents that jump about by 2 m a row move the picture by far less, and it never jerks."""
    position = walk(3, 400) + np.stack([np.linspace(0, 300, 400), np.zeros(400)], axis=-1)[:, None]
    shot = camera("follow", playback(position))
    middle = (position.min(axis=1) + position.max(axis=1)) / 2
    jerk = {name: np.abs(np.diff(path, n=2, axis=0)).max() for name, path in (("box", middle), ("shot", shot.center))}
    assert jerk["shot"] < jerk["box"] / 50
    zoom = np.diff(np.log(shot.distance))
    assert np.abs(zoom).max() < 0.05
    assert np.abs(shot.center[:, 0] - middle[:, 0]).max() < 15  # it stays with them over 300 m


def test_following_does_not_lag() -> None:
    """A swarm at constant speed is in the middle, away from the ends, where the camera is already at rest."""
    rows, window = 200, round(FOLLOW_SECONDS / DT)
    east = np.arange(rows)[:, None] * np.array([0.8, 0.0])
    square = np.array([[-20.0, -20], [-20, 20], [20, -20], [20, 20]])
    shot = camera("follow", playback(square + east[:, None]))
    np.testing.assert_allclose(shot.center[window:-window], east[window:-window], atol=1e-9)
    # 21 m to each side [radius included], with 6% of the picture's height as margin.
    scale = 21 / (0.44 * HEIGHT)
    distance = scale * HEIGHT / 2 / math.tan(math.radians(FOVY / 2)) + DISC_TOP
    np.testing.assert_allclose(shot.distance[2 * window : -2 * window], distance, rtol=1e-9)
    view = shot.at(100)
    np.testing.assert_allclose(view.project(square[3] + [1.0, 1.0] + east[100])[1], 0.06 * HEIGHT, atol=1e-6)


def test_moving_everything_moves_the_camera_along() -> None:
    position = walk(5, 50)
    for kind in CAMERAS:
        here, there = (camera(kind, playback(position + shift)) for shift in (0.0, np.array([40.0, -25.0])))
        np.testing.assert_allclose(there.center, np.add(here.center, [40.0, -25.0]), atol=1e-6)
        np.testing.assert_allclose(there.distance, here.distance, rtol=1e-9)


def test_the_order_of_agents_and_of_runs_changes_nothing() -> None:
    one, two = walk(1, 30), walk(2, 30)
    for kind in CAMERAS:
        first = camera(kind, playback(one), playback(two))
        second = camera(kind, playback(two[:, ::-1]), playback(one))
        np.testing.assert_allclose(first.center, second.center)
        np.testing.assert_allclose(first.distance, second.distance)


def test_runs_that_share_a_camera_are_all_seen() -> None:
    near, far = np.zeros((20, 4, 2)), np.full((20, 4, 2), 80.0)
    for kind in CAMERAS:
        shot = camera(kind, playback(near), playback(far[:10]))  # of unequal lengths
        for row in range(10):
            seen = shot.at(row).project(np.concatenate([near[row], far[row]]))
            assert (seen >= 0).all()
            assert (seen <= (WIDTH, HEIGHT)).all()


def test_a_still_swarm_and_an_empty_scene_have_a_picture() -> None:
    still = camera("follow", playback(np.zeros((5, 1, 2))))
    assert still.at(0) == still.at(4)
    assert still.at(0).pixels_per_meter < HEIGHT / (2 * 8 * SPEC.agent_radius)  # eight radii around it at least
    nobody = camera("follow", playback(np.zeros((5, 4, 2)), np.zeros(4, bool)))
    assert np.isfinite(nobody.distance).all()
    assert still.ground is not None
    assert camera("top", playback(np.zeros((5, 1, 2)))).ground is None


@pytest.mark.parametrize(("half", "ground"), [(8.0, 2.0), (24.0, 10.0), (190.0, 50.0)])
def test_lines_on_the_ground_have_a_round_spacing(half: float, ground: float) -> None:
    """The picture is 2 (half + radius) / 0.88 m high: 20, 57 and 434 m; a fifth of it rounded down."""
    position = np.broadcast_to(np.array([[[-half, -half], [half, half]]]), (50, 2, 2))
    shot = camera("follow", playback(position))
    assert shot.ground == pytest.approx(ground)


def test_bad_values_are_named() -> None:
    with pytest.raises(SpecError, match="top, tilted, follow"):
        camera("inside", playback(np.zeros((5, 1, 2))))
    with pytest.raises(SpecError, match="at least one run"):
        camera("top")
