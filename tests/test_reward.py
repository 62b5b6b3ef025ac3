"""The reward of eq. 5.26-5.27: numbers worked out by hand, a second implementation, and what must change nothing."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from helpers import assert_same, scene_state, scenes_of
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.config import RewardConfig
from envs.reward import by_distance, reward, reward_terms
from envs.state import Contacts, no_contacts
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec

SPEC = SceneSpec(num_agents=3, num_obstacles=2)
NEAR = [[[0.0, 0.0], [3.0, 4.0], [0.0, -10.0]]]


def contacts(scenes: int = 1, agents: int = 3, **fields) -> Contacts:
    return jax.device_get(replace(no_contacts(scenes, agents), **{k: np.asarray(v) for k, v in fields.items()}))


def test_numbers_worked_out_by_hand():
    state = scene_state(SPEC, NEAR, goal=[[0.0, 30.0]])
    touched = contacts(agent_states=[[4, 4, 0]], obstacle_states=[[0, 2, 0]], wall_states=[[0, 0, 1]])
    terms = reward_terms(state, touched)
    # To the goal 30, sqrt(9 + 26^2), 40 m; between agents 5, 10 and sqrt(9 + 14^2) m.
    far = np.sqrt(9 + 676)
    np.testing.assert_allclose(terms.goal[0], [0.34, 20 / (far + 10) - 0.16, 0.24], rtol=1e-5)
    other = np.sqrt(9 + 196)
    np.testing.assert_allclose(terms.formation[0], [-0.0075, -5e-4 * (5 + other), -5e-4 * (10 + other)], rtol=1e-5)
    assert terms.agent_collision.tolist() == [[-10, -10, 0]]
    assert terms.solid_collision.tolist() == [[0, -10, -10]]
    total = 0.34 - 0.0075 - 10
    np.testing.assert_allclose(reward(state, touched)[0, 0], total, rtol=1e-5)


def test_the_published_goal_term_is_the_thesis_formula_with_its_coefficients():
    distance = np.linspace(0, 200, 9)
    as_coded = 0.2 * (1 / (distance / 100 + 0.1) - 0.8)
    spec = replace(SPEC, num_agents=1, num_obstacles=0)
    state = scene_state(spec, np.stack([distance, 0 * distance], axis=-1)[:, None])
    terms = reward_terms(state, contacts(len(distance), 1))
    np.testing.assert_allclose(terms.goal[:, 0], as_coded, rtol=1e-5, atol=1e-6)


def test_as_printed_every_pair_that_is_too_close_counts():
    place = [[[0, 0], [3.9, 0], [-3.9, 0]]]
    state = scene_state(SPEC, place, obstacle=[[[0, 8.9], [0, 500]]], obstacle_present=[[True, True]])
    terms = reward_terms(state, contacts(), collisions=by_distance(2.0, 7.0))
    assert terms.agent_collision.tolist() == [[-20, -10, -10]]
    assert terms.solid_collision.tolist() == [[-10, 0, 0]]  # the others are sqrt(3.9^2 + 8.9^2) = 9.7 m away
    gone = replace(state, obstacle_present=np.zeros((1, 2), bool))
    assert not np.any(reward_terms(gone, contacts(), collisions=by_distance(2.0, 7.0)).solid_collision)


def in_numpy(state, touched: Contacts, config: RewardConfig) -> np.ndarray:
    """Equation 5.27 in float64, agent by agent."""
    earned = np.zeros(state.agent_present.shape)
    for s, i in np.argwhere(np.asarray(state.agent_present)):
        own = np.asarray(state.position[s, i], float)
        earned[s, i] = config.goal_gain / (np.hypot(*(own - state.goal[s])) + config.goal_softening)
        earned[s, i] += config.goal_offset
        for j in np.flatnonzero(np.asarray(state.agent_present[s])):
            earned[s, i] -= config.formation * np.hypot(*(own - np.asarray(state.position[s, j], float)))
        earned[s, i] -= config.collision * (touched.agent_states[s, i] > 0)
        earned[s, i] -= config.collision * (touched.obstacle_states[s, i] + touched.wall_states[s, i] > 0)
    return earned


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000))
def test_a_second_implementation_agrees_and_order_ghosts_and_place_change_nothing(seed: int):
    rng = np.random.default_rng(seed)
    present = rng.random((2, 3)) < 0.7
    place, goal = rng.uniform(-100, 100, (2, 3, 2)), rng.uniform(-40, 40, (2, 2))
    state = scene_state(SPEC, place, goal=goal, agent_present=present)
    kinds = ("agent_states", "obstacle_states", "wall_states")
    touched = contacts(2, **{kind: rng.integers(0, 2, (2, 3)).astype(np.int32) for kind in kinds})
    config = RewardConfig(goal_gain=7.0, goal_softening=3.0, goal_offset=0.5, formation=0.01, collision=4.0)
    earned = np.asarray(reward(state, touched, config))
    np.testing.assert_allclose(earned, in_numpy(state, touched, config), rtol=1e-4, atol=1e-4)
    assert not earned[~present].any()

    order = rng.permutation(3)
    shuffled = scene_state(SPEC, place[:, order], goal=goal, agent_present=present[:, order])
    likewise = replace(touched, **{kind: getattr(touched, kind)[:, order] for kind in kinds})
    np.testing.assert_allclose(reward(shuffled, likewise, config), earned[:, order], rtol=1e-5, atol=1e-5)

    elsewhere = scene_state(SPEC, place + np.array([13, -7]), goal=goal + np.array([13, -7]), agent_present=present)
    np.testing.assert_allclose(reward(elsewhere, touched, config), earned, rtol=1e-3, atol=1e-3)
    assert_same(reward(scenes_of(state, [1]), scenes_of(touched, [1]), config), earned[1:])


def test_the_terms_add_up_inside_jit():
    state = scene_state(SPEC, NEAR)
    touched = contacts(agent_states=[[1, 1, 0]])
    terms = jax.jit(reward_terms)(state, touched)
    parts = (terms.goal, terms.formation, terms.agent_collision, terms.solid_collision)
    np.testing.assert_allclose(terms.total, np.sum([np.asarray(part) for part in parts], axis=0), rtol=1e-6)
    np.testing.assert_allclose(terms.total, reward(state, touched), rtol=1e-6)


@pytest.mark.parametrize(
    ("field", "value"),
    [("goal_softening", 0.0), ("goal_gain", -1.0), ("formation", float("nan")), ("collision", float("inf"))],
)
def test_coefficients_that_make_no_sense_are_refused(field: str, value: float):
    with pytest.raises(SpecError, match=field):
        RewardConfig(**{field: value})
