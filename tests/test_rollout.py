"""A rollout is the environment's steps, one after another, compiled once."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_same, scenes_of

from envs.config import clear
from envs.experts.registry import make_expert
from envs.rollout import make_rollout, step_keys
from envs.swarm_env import SwarmEnv, scene_keys

WORLD = clear(num_agents=3)
SCENE = replace(WORLD.scene, substeps=15)


@pytest.fixture(scope="module")
def env() -> SwarmEnv:
    return SwarmEnv(SCENE, engine="native", spawn=WORLD.spawn)


def noisy(state, params, keys):
    noise = jax.vmap(lambda key: jax.random.normal(key, state.position.shape[1:]))(keys)
    return params * noise - state.velocity


def test_a_rollout_records_what_stepping_gives(env: SwarmEnv):
    policy = make_expert(WORLD.expert)
    keys = scene_keys(0, range(6))
    start = env.reset(keys)
    recording = jax.device_get(make_rollout(env, policy, steps=4)(None, start, keys))
    assert recording.position.shape == (6, 5, 3, 2)
    assert recording.contacts.agent_states.shape == (6, 4, 3)
    np.testing.assert_array_equal(recording.position[:, 0], start.position)
    step, state = jax.jit(env.step), start
    for t in range(4):
        transition = step(state, policy(state))
        state = transition.state
        np.testing.assert_allclose(recording.position[:, t + 1], state.position, atol=1e-3)
        np.testing.assert_allclose(recording.velocity[:, t + 1], state.velocity, atol=1e-3)
        np.testing.assert_array_equal(recording.contacts.agent_states[:, t], transition.contacts.agent_states)


def test_random_policies_draw_by_scene_and_step(env: SwarmEnv):
    run = make_rollout(env, noisy, steps=3)
    keys = scene_keys(2, range(6))
    start = env.reset(keys)
    whole = jax.device_get(run(jnp.float32(2), start, keys))
    assert_same(jax.device_get(run(jnp.float32(2), start, keys)), whole)
    order = np.array([3, 1, 5, 0, 4, 2])
    shuffled = jax.device_get(run(jnp.float32(2), scenes_of(start, order), keys[order]))
    assert_same(shuffled, scenes_of(whole, order))
    calm = jax.device_get(run(jnp.float32(0), start, keys))
    kicks = (whole.velocity - calm.velocity)[:, 1:]
    assert np.abs(kicks).min(axis=(1, 2, 3)).max() > 0
    assert len(np.unique(np.round(whole.velocity[:, 1:], 5))) > 6 * 3 * 3  # no two alike


def test_one_compile_per_number_of_scenes_whatever_the_parameters(env: SwarmEnv):
    traced = []

    def policy(state, params, keys):
        traced.append(state.position.shape[0])
        return -params["gain"] * state.velocity

    run = make_rollout(env, policy, steps=5)
    for scenes in (4, 4, 4, 7, 7):
        keys = scene_keys(len(traced), range(scenes))
        run({"gain": jnp.float32(len(traced))}, env.reset(keys), keys)
    assert traced == [4, 7]


def test_a_policys_keys_are_none_of_those_that_drew_the_start():
    """Spawning splits and folds the same key of the scene: noise would repeat the start's numbers."""
    keys = scene_keys(0, range(3))
    start = [jax.random.split(keys[0], 6)[i] for i in range(6)] + [jax.random.fold_in(keys[0], i) for i in range(64)]
    steps = [step_keys(keys, jnp.asarray(t))[0] for t in range(64)]
    data = [tuple(np.asarray(jax.random.key_data(key)).tolist()) for key in [*start, *steps]]
    assert not set(data[: len(start)]) & set(data[len(start) :])
    assert len(set(data[len(start) :])) == 64
    each = step_keys(keys, jnp.asarray([5, 2, 7]))
    for scene, t in enumerate((5, 2, 7)):
        assert each[scene] == step_keys(keys, jnp.asarray(t))[scene]
