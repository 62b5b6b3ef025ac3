"""PettingZoo, dm_env and dm_control: their own conformance suites, and the native engine's contacts."""

import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import dm_env
import jax
import numpy as np
import pytest
from absl.testing import absltest
from dm_env.test_utils import EnvironmentTestMixin
from pettingzoo.test import (
    api_test,
    max_cycles_test,
    parallel_api_test,
    parallel_seed_test,
    render_test,
    seed_test,
    state_test,
)
from pettingzoo.utils.conversions import parallel_to_aec

from envs.adapters import SwarmDmEnv, SwarmParallelEnv, control_environment, make_core
from envs.adapters.core import SwarmCore
from envs.config import SpawnConfig
from envs.swarm_env import SwarmEnv
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec
from swarmnet.bench_adapters import bench_adapters

WORLD = {"num_agents": 3, "num_obstacles": 1, "horizon": 6, "engine": "native"}


def zoo(**more) -> SwarmParallelEnv:
    return SwarmParallelEnv(make_core(**WORLD), size=64, **more)


def test_pettingzoos_parallel_suite_passes(capsys: pytest.CaptureFixture):
    parallel_api_test(zoo(), num_cycles=20)
    parallel_seed_test(zoo, num_cycles=6)
    assert "Passed" in capsys.readouterr().out


def test_pettingzoos_turn_based_suite_passes_through_its_own_conversion():
    api_test(parallel_to_aec(zoo()), num_cycles=20)
    seed_test(lambda: parallel_to_aec(zoo()), num_cycles=3)
    state_test(parallel_to_aec(zoo()), zoo())
    # It first asks for a window, which is not among our modes; then for each mode of the metadata.
    render_test(lambda render_mode: parallel_to_aec(zoo(render_mode="rgb_array")))


def test_an_episode_has_as_many_cycles_as_the_horizon():
    def make(max_cycles: int) -> SwarmParallelEnv:
        return SwarmParallelEnv(make_core(**WORLD | {"horizon": max_cycles, "terminate_on_contact": False}))

    max_cycles_test(SimpleNamespace(parallel_env=make, env=lambda max_cycles: parallel_to_aec(make(max_cycles))))


def test_only_agents_of_the_scene_play_and_each_earns_its_own():
    core = make_core(**WORLD | {"mixed_counts": True})
    env = SwarmParallelEnv(core)
    sizes = set()
    for scene in range(8):
        seen, _ = env.reset(seed=2, options={"scene": scene})
        present = np.asarray(env.swarm_state.agent_present[0])
        assert env.agents == [f"agent_{i}" for i in np.flatnonzero(present)]
        sizes.add(len(env.agents))
        assert set(seen) == set(env.agents)
        alone = core.start(2, np.array([scene]))[0]
        _, outcome = core.step(alone, np.full((1, 3, 2), 0.5, np.float32) * present[None, :, None])
        _, earned, *_ = env.step({agent: np.full(2, 0.5, np.float32) for agent in env.agents})
        for agent, value in earned.items():
            assert value == pytest.approx(float(outcome.reward[0, int(agent[-1])]), rel=1e-5)
    assert len(sizes) > 1
    env.reset(seed=2, options={"scene": 0})
    with pytest.raises(SpecError, match="one for each agent"):
        env.step({})


class TestDmEnv(EnvironmentTestMixin, absltest.TestCase):
    """dm_env's own suite, over whole episodes."""

    def make_object_under_test(self) -> SwarmDmEnv:
        return SwarmDmEnv(make_core(**WORLD), seed=1)


class TestControlEnvironment(EnvironmentTestMixin, absltest.TestCase):
    """The same suite for dm_control's environment around our task."""

    def make_object_under_test(self):
        return control_environment(make_core(**WORLD), seed=1)


@pytest.fixture(scope="module")
def crowd() -> SwarmCore:
    """Four agents in 12 m x 12 m with obstacles: contacts at once, and they end the scene."""
    spec = SceneSpec(num_agents=4, num_obstacles=2, substeps=15, walls=False, obstacle_radius=2.0)
    spawn = SpawnConfig(agent_range=6.0, goal_range=20.0, obstacle_radius=3.0)
    return SwarmCore(SwarmEnv(spec, engine="native", spawn=spawn, horizon=3, terminate_on_contact=True))


def test_the_discount_tells_termination_from_truncation(crowd: SwarmCore):
    still = np.zeros((3, 2), np.float32)
    # Horizon 7: 7 * 0.3 s are a little more than 7 steps in floating point.
    core = make_core(**WORLD | {"terminate_on_contact": False, "horizon": 7})
    for env in (SwarmDmEnv(core), control_environment(core)):
        env.reset()
        steps = [env.step(still) for _ in range(7)]
        assert [step.last() for step in steps] == [False] * 6 + [True]
        assert steps[-1].discount == 1.0
        assert env.step(still).step_type is dm_env.StepType.FIRST
    for env in (SwarmDmEnv(crowd), control_environment(crowd)):
        discounts = set()
        for _ in range(12):
            step = env.reset()
            while not step.last():
                step = env.step(np.ones((4, 2), np.float32) * [[1], [-1], [1], [-1]])
            discounts.add(step.discount)
        assert 0.0 in discounts


def test_dm_controls_physics_sees_the_native_engines_contacts(crowd: SwarmCore):
    env, native = control_environment(crowd, seed=5), jax.jit(crowd.env.step)
    rng = np.random.default_rng(0)
    touched = 0
    for _ in range(25):
        step = env.reset()
        while not step.last():
            before = env.task.state
            action = rng.uniform(-1, 1, (4, 2)).astype(np.float32)
            transition = jax.device_get(native(before, action[None] * crowd.spec.max_acceleration))
            step = env.step(action)
            seen, wanted = env.task.contacts, transition.contacts
            for kind in ("agent_states", "obstacle_states", "agent_events", "obstacle_events"):
                np.testing.assert_array_equal(getattr(seen, kind), getattr(wanted, kind), err_msg=kind)
            np.testing.assert_array_equal(env.task.state.touching_agent, transition.state.touching_agent)
            np.testing.assert_allclose(env.task.state.position, transition.state.position, atol=1e-3)
            np.testing.assert_allclose(env.physics.data.qpos.reshape(1, 4, 2), transition.state.position, atol=1e-3)
            observation, earned = crowd.judged(transition.state, transition.contacts)
            np.testing.assert_allclose(step.observation["agents"], observation[0], atol=1e-2)
            assert step.reward == pytest.approx(float(np.mean(earned)), rel=1e-3)
            touched += int(seen.agent_states.sum() + seen.obstacle_states.sum())
    assert touched > 50


@pytest.mark.parametrize(("library", "name"), [("gymnasium", "SwarmVectorEnv"), ("pettingzoo", "SwarmParallelEnv")])
def test_a_missing_library_is_named_with_what_to_install(library: str, name: str):
    code = f"import sys; sys.modules[{library!r}] = None; from envs.adapters import {name}"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 1
    said = result.stderr.strip().splitlines()[-1]
    assert f"SwarmError: {name} needs {library}, which is not installed" in said
    assert f"pip install {library}" in said


def test_moving_obstacles_move_in_dm_control_too():
    spec = SceneSpec(num_agents=1, num_obstacles=1, substeps=15, moving_obstacles=True)
    core = SwarmCore(SwarmEnv(spec, engine="native", horizon=9, spawn=SpawnConfig(agent_range=20.0)))
    env, native = control_environment(core), jax.jit(core.env.step)
    env.reset()
    task = env.task
    # An obstacle that runs into an agent at rest: 0.05 m away at 6 m/s.
    place = np.asarray(task.state.position[:, :1] + [[[8.05, 0]]], np.float32)
    task.state = replace(
        task.state,
        velocity=np.zeros_like(task.state.velocity),
        obstacle=place,
        obstacle_velocity=np.array([[[-6.0, 0.0]]], np.float32),
    )
    env.physics.data.qvel[:] = 0
    env.physics.data.mocap_pos[-1, :2] = place[0, 0]
    for _ in range(3):
        transition = jax.device_get(native(task.state, np.zeros((1, 1, 2), np.float32)))
        env.step(np.zeros((1, 2), np.float32))
        np.testing.assert_allclose(task.state.obstacle, transition.state.obstacle, rtol=1e-5)
        np.testing.assert_array_equal(task.contacts.obstacle_states, transition.contacts.obstacle_states)
        np.testing.assert_allclose(task.state.position, transition.state.position, atol=1e-3)
        assert task.contacts.obstacle_states.sum() > 0


def test_the_benchmark_compares_every_adapter_with_its_own_yardstick():
    rates = list(bench_adapters(scenes=2, num_agents=2, turns=1, seconds=0.01, engine="native"))
    alone = ["environment", "gymnasium", "pettingzoo", "dm_env", "dm_control"]
    assert [rate.adapter for rate in rates] == 2 * (["environment", "gymnasium vector", *alone])
    assert [rate.policy for rate in rates] == ["random"] * 7 + ["expert"] * 7
    assert [rate.scenes for rate in rates] == 2 * ([2] * 2 + [1] * 5)
    assert all(rate.per_second > 0 and rate.ratio > 0 for rate in rates)
    assert {rate.ratio for rate in rates if rate.adapter == "environment"} == {1.0}
