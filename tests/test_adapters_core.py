"""What all adapters share: what agents see, resets inside the compiled step, actions refused."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from helpers import assert_same, scene_state
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.adapters.core import SwarmCore, make_core
from envs.adapters.observation import Observation, nearest
from envs.config import SpawnConfig
from envs.experts.boids import boids
from envs.experts.config import BoidsConfig
from envs.reward import reward
from envs.spawn import SpawnError
from envs.swarm_env import SwarmEnv, scene_keys
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec

SPEC = SceneSpec(num_agents=3, num_obstacles=2, substeps=15)


@pytest.fixture(scope="module")
def crowded() -> SwarmCore:
    """Three agents in 10 m x 10 m: scenes end by contact after a few steps, or after 4."""
    env = SwarmEnv(
        replace(SPEC, num_obstacles=1),
        engine="native",
        spawn=SpawnConfig(agent_range=5.0, obstacle_radius=9.0, goal_range=80.0),
        horizon=4,
        terminate_on_contact=True,
    )
    return SwarmCore(env)


def test_what_an_agent_sees_by_hand():
    state = scene_state(
        SPEC,
        [[[1, 2], [4, 6], [1, -8]]],
        [[[1, 0], [0, 2], [-3, 0]]],
        goal=[[11, 2]],
        obstacle=[[[1, 52], [1, 32]]],
        obstacle_present=[[True, True]],
    )
    view = nearest(SPEC, neighbours=8, obstacles=1)
    assert len(view.labels) == 5 + 2 * 5 + 5
    seen = dict(zip(view.labels, np.asarray(view.observe(state))[0, 0].tolist(), strict=True))
    assert (seen["present"], seen["velocity x [m/s]"], seen["goal x [m]"], seen["goal y [m]"]) == (1, 1, 10, 0)
    first, second = ([seen[f"agent {j} {what}"] for what in WHAT] for j in (0, 1))
    assert first == [1, 3, 4, -1, 2]  # 5 m away
    assert second == [1, 0, -10, -4, 0]
    assert [seen[f"obstacle 0 {what}"] for what in WHAT] == [1, 0, 30, -1, 0]  # the nearer of the two


WHAT = ("seen", "x [m]", "y [m]", "vx [m/s]", "vy [m/s]")


def test_nothing_is_seen_beyond_the_sight_and_the_goal_keeps_its_direction():
    state = scene_state(SPEC, [[[0, 0], [29, 0], [0, 31]]], goal=[[0, 300]])
    view = nearest(SPEC, sight=30)
    seen = np.asarray(view.observe(state))[0, 0]
    np.testing.assert_allclose(seen[3:5], [0, 30], rtol=1e-6)
    assert seen[5:7].tolist() == [1, 29]
    assert not seen[10:].any()


def in_numpy(state, view_sight: float) -> list[list[np.ndarray]]:
    """Rows (relative x, y, vx, vy) of the others that each agent of scene 0 sees, nearest first."""
    rows = []
    place, speed = (np.asarray(x[0], float) for x in (state.position, state.velocity))
    here = np.asarray(state.agent_present[0])
    for i in range(len(place)):
        apart = {j: np.hypot(*(place[j] - place[i])) for j in np.flatnonzero(here) if j != i and here[i]}
        order = sorted((d, j) for j, d in apart.items() if d <= view_sight)
        rows.append([np.concatenate([place[j] - place[i], speed[j] - speed[i]]) for _, j in order])
    return rows


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_a_second_implementation_agrees_and_order_and_place_change_nothing(seed: int):
    rng = np.random.default_rng(seed)
    place, speed = rng.uniform(-100, 100, (1, 3, 2)), rng.uniform(-10, 10, (1, 3, 2))
    here = rng.random((1, 3)) < 0.8
    goal = rng.uniform(-40, 40, (1, 2))
    state = scene_state(SPEC, place, speed, goal=goal, agent_present=here)
    view = nearest(SPEC, sight=120)
    seen = np.asarray(view.observe(state))
    assert not seen[~here].any()
    assert (seen >= view.low).all()
    assert (seen <= view.high).all()
    for row, expected in zip(seen[0], in_numpy(state, 120), strict=True):
        others = row[5:15].reshape(2, 5)
        assert others[:, 0].sum() == len(expected)
        for shown, wanted in zip(others, expected, strict=False):
            np.testing.assert_allclose(shown[1:], wanted, rtol=1e-4, atol=1e-4)

    order = rng.permutation(3)
    shuffled = scene_state(SPEC, place[:, order], speed[:, order], goal=goal, agent_present=here[:, order])
    np.testing.assert_array_equal(view.observe(shuffled), seen[:, order])
    moved = scene_state(SPEC, place + np.array([5, -3]), speed, goal=goal + np.array([5, -3]), agent_present=here)
    np.testing.assert_allclose(view.observe(moved), seen, atol=1e-3)


def test_an_observation_needs_a_bound_for_every_entry():
    with pytest.raises(SpecError, match="one bound per label"):
        Observation(lambda state: state.position, ("x [m]", "y [m]"), np.zeros(1), np.ones(1))
    with pytest.raises(SpecError, match="neighbours"):
        nearest(SPEC, neighbours=-1)
    with pytest.raises(SpecError, match="sight"):
        nearest(SPEC, sight=0)


def played(core: SwarmCore, slot: int, actions: np.ndarray) -> list[dict]:
    """One slot by the plain environment, step by step in Python: the oracle of both ways to reset."""
    step = jax.jit(core.env.step)
    scene, rows = slot, []
    state = core.env.reset(scene_keys(7, range(scene, scene + 1)))
    over = False
    for action in actions:
        if over:
            scene += 3
            state = core.env.reset(scene_keys(7, range(scene, scene + 1)))
            rows.append({"reset": True, "seen": core.observation.observe(state)[0]})
            over = False
            continue
        transition = step(state, action[None, slot] * core.spec.max_acceleration)
        state = transition.state
        over = bool(transition.terminated[0] | transition.truncated[0])
        rows.append(
            {
                "reset": False,
                "seen": core.observation.observe(state)[0],
                "reward": reward(state, transition.contacts)[0],
                "ends": (bool(transition.terminated[0]), bool(transition.truncated[0])),
            }
        )
    return rows


def test_scenes_that_ended_are_reset_in_the_next_step_as_a_python_loop_would(crowded: SwarmCore):
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (12, 3, 3, 2)).astype(np.float32)
    expected = [played(crowded, slot, actions) for slot in range(3)]
    episodes, first = crowded.start(7, np.arange(3))
    assert_same(jax.device_get(episodes.state), jax.device_get(crowded.env.reset(scene_keys(7, range(3)))))
    np.testing.assert_array_equal(first.observation, crowded.observation.observe(episodes.state))
    kinds = set()
    for t, action in enumerate(actions):
        episodes, outcome = crowded.reset_or_step(episodes, action)
        for slot in range(3):
            row = expected[slot][t]
            np.testing.assert_allclose(outcome.observation[slot], row["seen"], atol=1e-4)
            ends = (bool(outcome.terminated[slot]), bool(outcome.truncated[slot]))
            if row["reset"]:
                assert ends == (False, False)
                assert not np.any(outcome.reward[slot])
            else:
                assert ends == row["ends"]
                np.testing.assert_allclose(outcome.reward[slot], row["reward"], rtol=1e-5, atol=1e-6)
            kinds.add((row["reset"], *ends))
    assert kinds >= {(True, False, False), (False, True, False), (False, False, True), (False, False, False)}
    assert crowded.reset_or_step._cache_size() == 1  # type: ignore[attr-defined]  # compiled once


def test_scenes_that_end_are_reset_at_once_with_their_last_observation_kept(crowded: SwarmCore):
    rng = np.random.default_rng(1)
    episodes, _ = crowded.start(7, np.arange(3))
    plain = episodes
    ended = 0
    for _ in range(10):
        action = rng.uniform(-1, 1, (3, 3, 2)).astype(np.float32)
        plain, before = crowded.step(replace(plain, state=episodes.state), action)
        scene = np.asarray(episodes.scene)
        episodes, outcome = crowded.step_then_reset(episodes, action)
        over = np.asarray(outcome.terminated | outcome.truncated)
        np.testing.assert_array_equal(outcome.final_observation, before.observation)
        np.testing.assert_array_equal(outcome.reward, before.reward)
        np.testing.assert_array_equal(episodes.scene, scene + 3 * over)
        fresh = crowded.env.reset(scene_keys(7, np.asarray(episodes.scene, np.int32)))
        np.testing.assert_array_equal(np.asarray(episodes.state.step)[over], 0)
        first = np.asarray(crowded.observation.observe(fresh))
        np.testing.assert_allclose(np.asarray(outcome.observation)[over], first[over], atol=1e-4)
        np.testing.assert_array_equal(np.asarray(outcome.observation)[~over], np.asarray(before.observation)[~over])
        ended += over.sum()
    assert ended >= 6


def test_a_project_policy_acts_in_the_units_of_actions(crowded: SwarmCore):
    episodes, _ = crowded.start(0, np.arange(2))
    act = crowded.acting(boids(BoidsConfig()))
    wanted = np.asarray(boids(BoidsConfig())(episodes.state))
    action = np.asarray(act(episodes.state))
    assert np.linalg.norm(action, axis=-1).max() <= 1 + 1e-6
    short = np.linalg.norm(wanted, axis=-1) < crowded.spec.max_acceleration
    assert short.any()
    np.testing.assert_allclose(action[short] * crowded.spec.max_acceleration, wanted[short], rtol=1e-5, atol=1e-5)


def test_what_cannot_be_is_refused_by_name(crowded: SwarmCore):
    with pytest.raises(SpecError, match="action"):
        crowded.action(np.zeros((3, 3)), (3, 2))
    with pytest.raises(SpecError, match=r"action.*nan.*finite"):
        crowded.action([[0, np.nan]] * 3, (3, 2))
    for seed, scene in ((-1, 0), (2**32, 0), (0, -1)):
        with pytest.raises(SpecError, match="whole number"):
            crowded.start(seed, np.array([scene]))
    endless = SwarmEnv(replace(SPEC, max_acceleration=float("inf")), engine="native")
    with pytest.raises(SpecError, match="max_acceleration"):
        SwarmCore(endless)


def test_a_scene_without_goal_earns_no_goal_reward():
    core = SwarmCore(SwarmEnv(replace(SPEC, goal=False), engine="native"))
    assert (core.reward.goal_gain, core.reward.goal_offset) == (0, 0)
    assert not any("goal" in label for label in core.observation.labels)


def test_no_room_is_said_also_from_within_the_compiled_step():
    tight = replace(SPEC, num_obstacles=1, num_agents=1)
    # One agent of radius 1 in 4 m x 4 m beside an obstacle of radius 7 that often covers all of it.
    env = SwarmEnv(tight, engine="native", spawn=SpawnConfig(agent_range=2.0, goal_range=2.0), horizon=1)
    core = SwarmCore(env)
    with pytest.raises(SpawnError, match="found no room"):
        core.start(0, np.arange(20))
    ok = np.asarray(env.spawn(scene_keys(0, range(20)))[1])
    good = np.flatnonzero(ok)[:1]
    assert len(good) == 1
    episodes, _ = core.start(0, good)
    failed = 0
    while not failed:  # the next scenes of the slot, one per step
        episodes, outcome = core.step_then_reset(episodes, np.zeros((1, 1, 2), np.float32))
        failed = int(outcome.no_room)
    assert not ok[int(episodes.scene[0])]
    with pytest.raises(SpawnError, match="found no room"):
        core.check(outcome)


def test_the_same_values_give_the_same_core():
    assert make_core(num_agents=2) is make_core(num_agents=2)
    assert make_core(num_agents=2) is not make_core(num_agents=3)
