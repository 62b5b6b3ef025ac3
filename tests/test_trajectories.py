"""The data record: nodes, edges, masks, contacts, and refusal of what is not finite."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from helpers import assert_same_trajectories, make_trajectories, scene_state

from envs.config import SimulateConfig
from envs.plain import plain
from envs.rollout import make_rollout
from envs.swarm_env import SwarmEnv, scene_keys
from envs.trajectories import (
    AGENT,
    ARRAYS,
    GOAL,
    OBSTACLE,
    TrajectoryError,
    concatenate,
    edge_types,
    from_recording,
    versions,
)
from swarm_mjcf.errors import SwarmError
from swarm_mjcf.spec import SceneSpec

SPEC = SceneSpec(num_agents=3, num_obstacles=2, obstacle_radius=5.0, substeps=15)


def recorded(spec: SceneSpec):
    """Scene 0: agent 0 crashes into agent 1, agent 2 into obstacle 1. Scene 1: only agent 0 and obstacle 0 exist."""
    crash = [[0, 0], [2.5, 0], [0, -30]]
    state = scene_state(
        spec,
        [crash, crash],
        [[[5, 0], [-5, 0], [0, -5]]] * 2,
        goal=[[7.0, 8.0]] * 2,
        obstacle=[[[50, 50], [0, -37]]] * 2,
        agent_present=[[True] * 3, [True, False, False]],
        obstacle_present=[[True] * 2, [True, False]],
    )
    env = SwarmEnv(spec, engine="native")
    run = make_rollout(env, lambda state, params, key: np.zeros((2, 3, 2), np.float32), steps=2)
    recording = jax.device_get(run(None, state, scene_keys(0, range(2))))
    return recording, from_recording(recording, spec, {"expert": "none"})


@pytest.fixture(scope="module")
def crash():
    return recorded(SPEC)


def test_nodes_are_goal_obstacles_agents(crash):
    recording, t = crash
    assert t.counts == (1, 2, 3)
    assert t.kind.tolist() == [[GOAL, OBSTACLE, OBSTACLE, AGENT, AGENT, AGENT]] * 2
    assert t.position.shape == (2, 3, 6, 2)
    assert len(t) == 2
    np.testing.assert_array_equal(t.position[0, :, 0], [[7, 8]] * 3)
    np.testing.assert_array_equal(t.position[0, :, 1:3], [[[50, 50], [0, -37]]] * 3)
    np.testing.assert_array_equal(t.position[0, :, 3:], recording.position[0])
    np.testing.assert_array_equal(t.velocity[0, :, 3:], recording.velocity[0])
    np.testing.assert_array_equal(t.velocity[:, :, :3], 0)
    assert t.radius[0].tolist() == [0, 5, 5, 1, 1, 1]
    assert (t.dt, t.substeps, t.max_speed, t.max_acceleration) == (0.3, 15, 10, 10)


def test_absent_nodes_are_masked_and_zero(crash):
    _, t = crash
    assert t.mask[0].all()
    assert t.mask[1].tolist() == [[True, True, False, True, False, False]] * 3
    gone = ~t.mask
    for name in ("position", "velocity", "agent_contact", "solid_contact", "agent_events", "solid_events", "depth"):
        assert not getattr(t, name)[gone].any(), name
    assert t.radius[1].tolist() == [0, 5, 0, 1, 0, 0]


def test_contacts_stand_at_the_row_their_step_ends_in(crash):
    recording, t = crash
    contacts = recording.contacts
    assert not t.agent_contact[:, 0].any()
    assert not t.solid_contact[:, 0].any()
    assert (t.agent_contact[0, 1, 3:5] > 0).all()
    assert t.agent_events[0, 1].tolist() == [0, 0, 0, 1, 1, 0]
    assert t.solid_events[0, 1].tolist() == [0, 0, 0, 0, 0, 1]
    np.testing.assert_array_equal(t.agent_contact[:, 1:, 3:], contacts.agent_states)
    np.testing.assert_array_equal(t.solid_contact[:, 1:, 3:], contacts.obstacle_states)
    assert t.depth[0, 1, 3] == contacts.agent_depth[0, 0, 0] > 0
    assert t.depth[0, 1, 5] == contacts.obstacle_depth[0, 0, 2] > 0
    assert not t.agent_contact[1].any()


def test_a_scene_without_a_goal_has_no_goal_node():
    _, t = recorded(replace(SPEC, goal=False))
    assert t.counts == (0, 2, 3)
    assert t.position.shape[2] == 5


def test_every_agent_receives_from_every_other_node_that_is_present():
    kind = np.array([[GOAL, OBSTACLE, AGENT, AGENT]] * 2)
    present = np.array([[True] * 4, [True, False, True, False]])
    assert edge_types(kind, present).tolist() == [
        [[0, 0, 1, 1], [0, 0, 2, 2], [0, 0, 0, 3], [0, 0, 3, 0]],
        [[0, 0, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]],
    ]


@pytest.mark.parametrize("name", ["position", "velocity"])
@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused_by_scene_row_and_node(name: str, poison: float):
    t = make_trajectories(scenes=5, rows=4, agents=3)
    broken = getattr(t, name).copy()
    broken[3, 2, 4, 1] = broken[4, 0, 1, 0] = poison
    mask = t.mask.copy()
    mask[3:] = True
    with pytest.raises(TrajectoryError, match=f"{name} .*2 of 5 scenes; first at scene 3, row 2, node 4") as caught:
        replace(t, mask=mask, **{name: broken})
    assert isinstance(caught.value, SwarmError)
    mask[3, 2, 4] = mask[4, 0, 1] = False
    replace(t, mask=mask, **{name: broken})  # where nothing is, nothing can be wrong


def test_scenes_are_taken_and_joined():
    t = make_trajectories(scenes=6)
    assert_same_trajectories(concatenate([t.take(slice(0, 2)), t.take([2, 3, 4]), t.take(np.array([5]))]), t)
    backwards = t.take([5, 4, 3, 2, 1, 0])
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(backwards, name), getattr(t, name)[::-1])


def test_settings_become_plain_json():
    assert plain(SimulateConfig(seed=4))["seed"] == 4
    endless = plain(SceneSpec(max_speed=float("inf"), contacts=False))
    assert endless["max_speed"] == "inf"
    assert endless["walls"] is False


def test_versions_name_the_packages_whose_numbers_matter():
    assert {"mujoco", "jax", "numpy"} <= set(versions())


def test_without_an_engine_nothing_is_saturated(crash):
    t = make_trajectories(scenes=3, rows=5)
    assert t.saturated.shape == (3, 5)
    assert not t.saturated.any()
    assert not crash[1].saturated.any()  # the native engine has no caps
