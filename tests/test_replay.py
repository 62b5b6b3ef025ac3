"""Contacts of recorded positions: against the run that made them, against a slow loop over pairs, and by hand."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from helpers import assert_same_trajectories, scene_state
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from learning import blank

import envs.replay
from envs.collisions import collision_report
from envs.config import SpawnConfig
from envs.replay import replay, touching_pairs
from envs.rollout import make_rollout
from envs.swarm_env import SwarmEnv, scene_keys
from envs.touching import BY_AGENT, BY_OBSTACLE, BY_WALL
from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories, from_recording
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec

FIELDS = ("agent_contact", "solid_contact", "agent_events", "solid_events")
CROWD = SceneSpec(num_agents=5, num_obstacles=2, obstacle_radius=2.0, arena=8.0, walls=True, dt=0.02, substeps=1)
"""One physics step per row, so that the rows are all states; about every second agent touches something."""
SCENES, STEPS = 8, 10


@pytest.fixture(scope="module")
def run():
    """`seed -> Trajectories`: the engine's own run from random starts, bodies in each other included."""
    env = SwarmEnv(CROWD, engine="native", spawn=SpawnConfig(agent_range=4.0, overlap=True), horizon=STEPS)
    compiled = make_rollout(env, lambda state, params, key: -3 * state.position + params, steps=STEPS)

    def run(seed: int) -> Trajectories:
        rng = np.random.default_rng(seed)
        start = scene_state(
            CROWD,
            rng.uniform(-7.5, 7.5, (SCENES, 5, 2)),
            rng.uniform(-8, 8, (SCENES, 5, 2)),
            obstacle=rng.uniform(-6, 6, (SCENES, 2, 2)),
            agent_present=rng.random((SCENES, 5)) < 0.8,
            obstacle_present=rng.random((SCENES, 2)) < 0.7,
        )
        push = rng.uniform(-9, 9, (SCENES, 5, 2)).astype(np.float32)
        return from_recording(jax.device_get(compiled(push, start, scene_keys(seed, range(SCENES)))), CROWD, {})

    return run


@settings(max_examples=20)
@given(st.integers(0, 2**31))
def test_replaying_recorded_positions_gives_the_counts_of_the_original_run(run, seed: int):
    original = run(seed)
    replayed = replay(original, arena=CROWD.arena)
    assume(replayed.provenance["replay"]["borderline"] == 0)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(replayed, name), getattr(original, name), err_msg=name)
    np.testing.assert_allclose(replayed.depth, original.depth, atol=2e-5)
    before, after = collision_report(original), collision_report(replayed)
    for name, estimate in before.items():
        assert after[name].value == pytest.approx(estimate.value, abs=2e-5, nan_ok=True), name


def test_the_runs_of_that_test_touch_in_every_way(run):
    original = run(0)
    assert all(getattr(original, name).any() for name in FIELDS)
    assert not original.agent_contact.all()
    touches, _ = touching_pairs(original, arena=CROWD.arena)
    assert set(touches.kind) == {BY_AGENT, BY_OBSTACLE, BY_WALL}


def comings_and_goings(seed: int, *, scenes: int = 3, rows: int = 5) -> Trajectories:
    """Random walks of a goal, two obstacles (one moving) and five agents of many radii, that come and go."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(-6, 6, (scenes, 1, 8, 2)) + rng.normal(0, 1.5, (scenes, rows, 8, 2)).cumsum(axis=1)
    data = blank(
        position,
        rng.normal(0, 5, (scenes, rows, 8, 2)),
        [GOAL, OBSTACLE, OBSTACLE] + [AGENT] * 5,
        rng.random((scenes, rows, 8)) < 0.8,
    )
    return replace(data, radius=rng.uniform(0.2, 2, (scenes, 8)).astype(np.float32))


def by_hand(t: Trajectories, k: int, arena: float) -> dict[str, np.ndarray]:
    """Second implementation: one scene, step, state and pair at a time, straight from the definitions."""
    found = {name: np.zeros(t.mask.shape, int) for name in FIELDS} | {"depth": np.zeros(t.mask.shape)}
    agents, obstacles = (np.flatnonzero(t.kind[0] == kind) for kind in (AGENT, OBSTACLE))
    position = t.position.astype(np.float64)
    for s in range(len(t)):
        earlier: dict[int, set] = {}
        for row in range(1, t.mask.shape[1]):
            for j in range(1, k + 1):
                touching: dict[int, set] = {int(a): set() for a in agents}

                def place(node: int, s: int = s, row: int = row, j: int = j) -> np.ndarray | None:
                    if not t.mask[s, row, node] or (j < k and not t.mask[s, row - 1, node]):
                        return None
                    if j == k:
                        return position[s, row, node]
                    return (1 - j / k) * position[s, row - 1, node] + j / k * position[s, row, node]

                for a in agents:
                    if (x := place(a)) is None:
                        continue
                    others = [("agent", b) for b in agents if b != a] + [(f"obstacle{o}", o) for o in obstacles]
                    for name, other in others:
                        if (y := place(other)) is None:
                            continue
                        depth = float(t.radius[s, a]) + float(t.radius[s, other]) - np.linalg.norm(x - y)
                        if depth > 0:
                            touching[a].add(name)
                            found["depth"][s, row, a] = max(found["depth"][s, row, a], depth)
                    depth = float(np.abs(x).max() + t.radius[s, a] - arena)
                    if depth > 0:
                        touching[a].add("wall")
                        found["depth"][s, row, a] = max(found["depth"][s, row, a], depth)
                for a, what in touching.items():
                    onsets = what - earlier.get(a, set())
                    found["agent_contact"][s, row, a] += "agent" in what
                    found["agent_events"][s, row, a] += "agent" in onsets
                    found["solid_contact"][s, row, a] += any(w.startswith("obstacle") for w in what) + ("wall" in what)
                    found["solid_events"][s, row, a] += len(onsets - {"agent"})
                earlier = touching
    return found


@pytest.mark.parametrize("k", [1, 2, 7])
@pytest.mark.parametrize("points", [1 << 17, 1])
def test_a_slow_loop_over_pairs_finds_the_same(k: int, points: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(envs.replay, "_POINTS", points)  # all scenes at once, and one by one
    data = comings_and_goings(k)
    expected, found = by_hand(data, k, 9.0), replay(data, states=k, arena=9.0)
    assert found.provenance["replay"]["borderline"] == 0
    for name in FIELDS:
        assert expected[name].any(), name
        np.testing.assert_array_equal(getattr(found, name), expected[name], err_msg=name)
    np.testing.assert_allclose(found.depth, expected["depth"], atol=1e-6)


def passing(gap: float | int = 0.0) -> Trajectories:
    """Two agents of radius 1 that swap places in one row, head on, `gap` aside: 8 m in 0.1 s each."""
    position = np.array([[[-4, 0], [4, gap]], [[4, 0], [-4, gap]]], float)[None]
    velocity = np.array([[80, 0], [-80, 0]], float) + np.zeros((1, 2, 2, 2))
    data = blank(position, velocity, [AGENT, AGENT])
    return replace(data, radius=np.ones((1, 2), np.float32))


def test_what_happens_between_rows_is_seen_where_it_is_looked_for():
    assert not replay(passing()).agent_contact.any(), "the rows alone do not touch"
    # At states j = 1..16 centres are 8 - j apart: touching below 2 are j = 7, 8, 9.
    found = replay(passing(), states=16)
    np.testing.assert_array_equal(found.agent_contact[0], [[0, 0], [3, 3]])
    np.testing.assert_array_equal(found.agent_events[0], [[0, 0], [1, 1]])
    np.testing.assert_allclose(found.depth[0, 1], [2, 2])
    touches, _ = touching_pairs(passing(), states=16)
    np.testing.assert_array_equal(touches.state, [7, 8, 9])
    np.testing.assert_allclose(touches.relative_speed, 160)
    np.testing.assert_allclose(touches.closing_speed, [160, 0, -160])  # coming, in one place, parting
    assert np.isnan(touches.impulse).all()


def test_touching_is_below_the_sum_of_radii_and_its_border_is_counted_apart():
    at = replay(passing(2.0), states=16)
    assert not at.agent_contact.any(), "surfaces that just meet do not touch"
    assert at.provenance["replay"] == {"states": 16, "arena": None, "borderline": 1}
    assert replay(passing(1.99), states=16).agent_contact.max() == 1


def test_walls_by_hand():
    position = np.array([[8.5, 0], [9.5, 0], [0, -9.25]])[None, :, None]
    data = replace(blank(position, np.full((1, 3, 1, 2), 3.0), [AGENT]), radius=np.ones((1, 1), np.float32))
    found = replay(data, arena=10)
    np.testing.assert_array_equal(found.solid_contact[0, :, 0], [0, 1, 1])
    np.testing.assert_array_equal(found.solid_events[0, :, 0], [0, 1, 0])  # from the east wall to the south one
    np.testing.assert_allclose(found.depth[0, :, 0], [0, 0.5, 0.25])
    touches, _ = touching_pairs(data, arena=10)
    np.testing.assert_array_equal(touches.partner, [0, 3])
    np.testing.assert_allclose(touches.closing_speed, [3, -3])
    assert not replay(data).solid_contact.any()


def test_ghosts_order_place_and_batch_change_nothing():
    data = comings_and_goings(5, scenes=4)
    plain = replay(data, states=3)
    moved = replace(data, position=np.where(data.mask[..., None], data.position + np.float32(64), 0))
    order = np.array([0, 1, 2, 6, 4, 3, 7, 5])
    fields = {n: getattr(data, n)[:, :, order] for n in ("position", "velocity", "mask")}
    reordered = replay(replace(data, radius=data.radius[:, order], **fields), states=3)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(replay(moved, states=3), name), getattr(plain, name), err_msg=name)
        np.testing.assert_array_equal(getattr(reordered, name), getattr(plain, name)[:, :, order], err_msg=name)
    one = replay(data.take([2]), states=3)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(one, name)[0], getattr(plain, name)[2], err_msg=name)
        assert not getattr(plain, name)[~data.mask].any()


def test_replaying_twice_is_replaying_once():
    once = replay(comings_and_goings(1))
    assert_same_trajectories(replay(once), once)


@pytest.mark.parametrize("options", [{"states": 0}, {"arena": 0.0}])
def test_nonsense_is_refused(options: dict):
    with pytest.raises(SpecError, match=next(iter(options))):
        replay(passing(), **options)
