"""Gymnasium: its own checker, its own wrappers, and the same scenes one by one and many at once."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics, RescaleObservation

from envs.adapters import SwarmVectorEnv, make_core, register
from swarm_mjcf.errors import SpecError, SwarmError

WORLD = {"num_agents": 3, "num_obstacles": 1, "horizon": 4, "engine": "native", "terminate_on_contact": False}
register()


@pytest.fixture
def vector() -> SwarmVectorEnv:
    env = gymnasium.make_vec("SwarmNet/Swarm-v0", num_envs=3, **WORLD)
    assert isinstance(env.unwrapped, SwarmVectorEnv)
    return env.unwrapped


def test_the_single_environment_passes_gymnasiums_checker():
    env = gymnasium.make("SwarmNet/Swarm-v0", render_mode="rgb_array", size=64, **WORLD)
    check_env(env.unwrapped)  # warnings are errors


def test_many_scenes_are_the_single_ones(vector: SwarmVectorEnv):
    together, _ = vector.reset(seed=11)
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 3, 3, 2)).astype(np.float32)
    alone = gymnasium.make("SwarmNet/Swarm-v0", **WORLD).unwrapped
    for scene in range(3):
        seen, _ = alone.reset(seed=11, options={"scene": scene})
        np.testing.assert_allclose(seen, together[scene], atol=1e-5)
    results = [vector.step(action) for action in actions]
    for scene in range(3):
        alone.reset(seed=11, options={"scene": scene})
        for t in range(4):
            seen, earned, terminated, truncated, info = alone.step(actions[t, scene])
            many = results[t]
            np.testing.assert_allclose(seen, many[0][scene], atol=1e-4)
            np.testing.assert_allclose(earned, many[1][scene], rtol=1e-4)
            assert (terminated, truncated) == (many[2][scene], many[3][scene])
            assert info["agent_contacts"].tolist() == many[4]["agent_contacts"][scene].tolist()
            if terminated or truncated:
                break
        if t == 3:  # the call after the end plays scene 3, 4 or 5
            np.testing.assert_array_equal(results[4][1][scene], 0)
            first, _ = alone.reset(seed=11, options={"scene": 3 + scene})
            np.testing.assert_allclose(results[4][0][scene], first, atol=1e-5)


def test_spaces_hold_what_comes_out_and_are_batched(vector: SwarmVectorEnv):
    assert vector.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert vector.observation_space.shape == (3, *vector.single_observation_space.shape)
    assert vector.action_space.shape == (3, 3, 2)
    seen, infos = vector.reset(seed=0)
    assert seen in vector.observation_space
    assert infos["_present"].all()
    vector.action_space.seed(0)
    kept = seen.copy()
    for _ in range(6):
        again, reward, terminated, truncated, _ = vector.step(vector.action_space.sample())
        assert again in vector.observation_space
        assert reward.dtype == np.float64
        assert terminated.dtype == truncated.dtype == bool
        again[:] = 0  # what was handed out is the caller's: neither read-only nor read again
    np.testing.assert_array_equal(seen, kept)


def test_a_seed_gives_the_same_scenes_and_no_seed_gives_new_ones(vector: SwarmVectorEnv):
    first, _ = vector.reset(seed=5)
    second, _ = vector.reset()
    again, _ = vector.reset(seed=5)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, second)
    chosen, _ = vector.reset(options={"scenes": [3, 4, 5]})
    np.testing.assert_array_equal(chosen, second)


def test_ended_scenes_hand_out_their_last_observation_in_same_step_mode():
    env = SwarmVectorEnv(make_core(**WORLD), 3, autoreset_mode="SameStep")
    other = SwarmVectorEnv(make_core(**WORLD), 3)
    env.reset(seed=0)
    other.reset(seed=0)
    actions = np.zeros((3, 3, 2), np.float32)

    def same(one, other):  # two compiled programs need not round alike
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-7)

    for t in range(4):
        seen, reward, _, truncated, infos = env.step(actions)
        plain = other.step(actions)
        same(reward, plain[1])
        if t < 3:
            assert "final_obs" not in infos
    assert truncated.all()
    assert infos["_final_obs"].all()
    same(np.stack(infos["final_obs"]), plain[0])
    same(infos["final_info"]["agent_reward"], plain[4]["agent_reward"])
    assert not infos["agent_reward"].any()
    assert infos["present"].all()
    fresh, _ = other.reset(options={"scenes": [3, 4, 5]})
    np.testing.assert_allclose(seen, fresh, atol=1e-5)


def test_gymnasiums_vector_wrappers_work(vector: SwarmVectorEnv):
    wrapped = DictInfoToList(RecordEpisodeStatistics(RescaleObservation(vector, np.float32(-1), np.float32(1))))
    wrapped.reset(seed=0)
    lengths = []
    for _ in range(8):
        seen, *_, infos = wrapped.step(np.zeros((3, 3, 2), np.float32))
        assert np.abs(seen).max() <= 1
        lengths += [info["episode"]["l"] for info in infos if "episode" in info]
    assert lengths == [4] * 3  # the call that resets counts for none


def test_pictures_show_the_whole_arena_and_stay_still():
    env = SwarmVectorEnv(make_core(**WORLD), 2, render_mode="rgb_array", size=96)
    env.reset(seed=0)
    before = env.render()
    assert [(frame.shape, frame.dtype) for frame in before] == [((96, 96, 3), np.uint8)] * 2
    assert not np.array_equal(*before)
    env.step(np.ones((2, 3, 2), np.float32))
    after = env.render()
    same = (before[0] == after[0]).all(axis=-1).mean()
    assert 0.8 < same < 1  # agents moved, nothing else


@pytest.mark.parametrize(
    ("wrong", "field"),
    [({"render_mode": "human"}, "render_mode"), ({"autoreset_mode": "Disabled"}, "autoreset_mode")],
)
def test_modes_that_are_not_there_are_refused(wrong: dict, field: str):
    with pytest.raises(SpecError, match=field):
        SwarmVectorEnv(make_core(**WORLD), 2, **wrong)


def test_wrong_calls_say_what_is_allowed(vector: SwarmVectorEnv):
    fresh = SwarmVectorEnv(make_core(**WORLD), 2)
    with pytest.raises(SwarmError, match="call reset"):
        fresh.step(np.zeros((2, 3, 2), np.float32))
    vector.reset(seed=0)
    with pytest.raises(SpecError, match="action"):
        vector.step(np.zeros((2, 3, 2), np.float32))
    with pytest.raises(SpecError, match="options"):
        vector.reset(options={"scene": 1})
    with pytest.raises(SpecError, match="scenes"):
        vector.reset(options={"scenes": [1, 2]})
    with pytest.raises(SpecError, match="num_envs"):
        SwarmVectorEnv(make_core(**WORLD), 0)
