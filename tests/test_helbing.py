"""Helbing against the published code's own numbers (`data/golden_helbing.npz`), hand-computed cases, symmetries."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from golden import golden_state, relative_error
from helpers import scene_state
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.config import SimulateConfig, make_world, published
from envs.dynamics import free_flight, limited
from envs.experts.config import HelbingConfig, Interaction
from envs.experts.helbing import helbing, rules
from envs.simulate import simulate_in_memory
from envs.state import State, make_state
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec

GOLDEN = np.load(Path(__file__).parent / "data/golden_helbing.npz")
WORLDS = ("helbing_n5_k1", "helbing_n5_k1_dense", "helbing_n10_k2")
TERMS = ("repulsion", "body", "friction", "goal")
PUBLISHED = HelbingConfig()
FIVE = SceneSpec(num_agents=5, num_obstacles=2)


def computed(world: str, dtype: type) -> dict[str, np.ndarray]:
    """All that the published code computed for its states, computed by ours."""

    def everything(state: State) -> dict[str, jax.Array]:
        scene, acceleration = published().scene, helbing(PUBLISHED)(state)
        executed = limited(state.velocity, acceleration, scene)
        position, velocity = free_flight(state.position, state.velocity, executed, scene)
        return {
            "acceleration_no_walls": acceleration,
            "next_position_dt0.3": position,
            "next_velocity_dt0.3": velocity,
        }

    with jax.enable_x64(dtype == np.float64):
        return jax.device_get(jax.jit(everything)(golden_state(GOLDEN, world, dtype)))


@pytest.mark.parametrize("world", WORLDS)
def test_golden_numbers_are_reproduced_in_float64(world: str):
    ours = computed(world, np.float64)
    recorded = {key.split("/")[1] for key in GOLDEN.files if key.startswith(world + "/")}
    assert recorded == set(ours) | {"position", "velocity", "goal", "obstacle"}  # nothing golden is left unchecked
    for name, value in ours.items():
        assert value.dtype == np.float64
        assert relative_error(value, GOLDEN[f"{world}/{name}"]).max() <= 1e-9, name


@pytest.mark.parametrize("world", WORLDS)
def test_golden_numbers_are_reproduced_in_float32(world: str):
    for name, value in computed(world, np.float32).items():
        assert value.dtype == np.float32
        error = relative_error(value, GOLDEN[f"{world}/{name}"])
        assert (error <= 1e-5).mean() >= 0.99, name
        assert error.max() <= 1e-2, name


@cache
def law_of(config: HelbingConfig):
    return jax.jit(helbing(config))


@jax.jit
def terms(state: State) -> dict[str, jax.Array]:
    """Every term without its weight."""
    return {name: rule(state) for name, rule in rules(PUBLISHED).items()}


def numpy_terms(state: State, config: HelbingConfig) -> dict[str, np.ndarray]:
    """Each term in plain loops: one agent, one other at a time, from the formulas of the paper."""
    position, velocity = np.asarray(state.position, float), np.asarray(state.velocity, float)
    terms = {name: np.zeros_like(position) for name in TERMS}
    for s, i in np.ndindex(*position.shape[:2]):
        others = [(position[s, j], velocity[s, j], 2 * 3.0) for j in range(position.shape[1]) if j != i]
        others += [(np.asarray(o, float), np.zeros(2), 3.0 + 8.0) for o in np.asarray(state.obstacle)[s]]
        for place, speed, r in others:
            away = position[s, i] - place
            d = math.hypot(*away)
            n = away / d
            terms["repulsion"][s, i] += math.exp((r - d) / config.repulsion_range) * n
            if r > d:
                tangent = np.array([-n[1], n[0]])
                terms["body"][s, i] += (r - d) * n
                terms["friction"][s, i] += (r - d) * ((speed - velocity[s, i]) @ tangent) * tangent
        toward = np.asarray(state.goal, float)[s] - position[s, i]
        distance = math.hypot(*toward)
        terms["goal"][s, i] = 10 * min(1, distance / 20) * toward / distance - velocity[s, i]
    return terms


def test_each_term_alone_and_weighted():
    state = golden_state(GOLDEN, "helbing_n5_k1_dense", np.float32)
    state = jax.tree.map(lambda x: x[:10], state)
    expected, unweighted = numpy_terms(state, PUBLISHED), terms(state)
    for name in TERMS:
        assert (np.linalg.norm(expected[name], axis=-1) > 0.01).mean() > 0.05  # the states put every term to the test
        np.testing.assert_allclose(unweighted[name], expected[name], rtol=1e-3, atol=1e-3)
        alone = law_of(replace(PUBLISHED, **(dict.fromkeys(TERMS, 0.0) | {name: 3.0})))(state)
        np.testing.assert_allclose(alone, 3 * unweighted[name], rtol=1e-5, atol=1e-5)


def test_two_agents_by_hand():
    # 4 m apart, contact distance 6: overlap 2; the other passes at (1, 5) relative to own velocity.
    state = scene_state(replace(FIVE, num_agents=2), [[[0, 0], [4, 0]]], [[[0, 0], [1, 5]]])
    got = {name: np.asarray(term)[0, 0] for name, term in terms(state).items()}
    np.testing.assert_allclose(got["repulsion"], [-math.e, 0], rtol=1e-6)
    np.testing.assert_allclose(got["body"], [-2, 0], rtol=1e-6)
    np.testing.assert_allclose(got["friction"], [0, 10], rtol=1e-6)


def test_agents_and_obstacles_can_be_switched_off():
    state = golden_state(GOLDEN, "helbing_n10_k2", np.float32)
    both, agents, obstacles = (
        np.asarray(law_of(replace(PUBLISHED, goal=0.0, agents=a, obstacles=o))(state))
        for a, o in ((True, True), (True, False), (False, True))
    )
    np.testing.assert_allclose(agents + obstacles, both, atol=1e-4, rtol=1e-4)
    assert np.abs(agents).max() > 0.1
    assert np.abs(obstacles).max() > 0.1
    neither = law_of(replace(PUBLISHED, agents=False, obstacles=False, goal=0.0))(state)
    assert not np.asarray(neither).any()


def test_only_those_in_sight_are_felt():
    places = [[[0.0, 0], [5, 0], [0, 7], [40, 40], [41, 40]]]
    state = jax.tree.map(jnp.asarray, scene_state(FIVE, places))
    seen = replace(PUBLISHED, goal=0.0, interaction=Interaction(radius=6.0))
    got = np.asarray(law_of(seen)(state))[0]
    push = math.exp((6 - 5) / 2) + 2 * 1
    np.testing.assert_allclose(got[:3], [[-push, 0], [push, 0], [0, 0]], rtol=1e-5)
    nearest = np.asarray(law_of(replace(seen, interaction=Interaction(nearest=1)))(state))[0]
    np.testing.assert_allclose(nearest[2], [0, math.exp(-1 / 2)], rtol=1e-5, atol=1e-6)


coordinate = st.floats(-15, 15, width=32)
agents = st.lists(st.tuples(coordinate, coordinate, coordinate, coordinate), min_size=5, max_size=5)
law = law_of(PUBLISHED)


def random_state(rows, **kwargs) -> State:
    rows = np.array([rows], np.float32)
    where = {"goal": [[10.0, -20.0]], "obstacle": [[[25.0, 5.0], [-30.0, 12.0]]]} | kwargs
    return scene_state(FIVE, rows[..., :2], rows[..., 2:] / 2, **where)


def test_everything_at_one_place_stays_finite():
    state = random_state([(1.0, 2.0, 0.0, 0.0)] * 5, obstacle=[[[1.0, 2.0]] * 2], goal=[[1.0, 2.0]])
    assert not np.asarray(law(state)).any()


@settings(max_examples=40)
@given(agents, st.permutations(range(5)), st.lists(st.booleans(), min_size=5, max_size=5))
def test_numbering_and_ghosts_change_nothing(rows, order, present):
    present = np.array([present])
    state = random_state(rows, agent_present=present)
    got = np.asarray(law(state))
    assert np.isfinite(got).all()
    assert not got[~present].any()
    renumbered = random_state([rows[i] for i in order], agent_present=present[:, order])
    assert relative_error(np.asarray(law(renumbered)), got[:, order]).max() < 1e-4
    haunted = replace(
        state,
        position=np.where(present[..., None], state.position, np.float32(3)),
        velocity=np.where(present[..., None], state.velocity, np.float32(-5)),
    )
    np.testing.assert_array_equal(np.asarray(law(haunted)), got)


def test_the_preset_simulates_this_law():
    t = simulate_in_memory(
        SimulateConfig(preset="helbing", scenes=3, steps=12, num_agents=3, engine="native", threads=1)
    )
    scene = make_world("helbing", num_agents=3).scene
    fields = {"position": t.position[:, 0, 2:], "velocity": t.velocity[:, 0, 2:], "goal": t.position[:, 0, 0]}
    start = make_state(**jax.tree.map(jnp.asarray, fields), obstacle=jnp.asarray(t.position[:, 0, 1:2]))
    executed = limited(start.velocity, law(start), scene)
    position, velocity = free_flight(start.position, start.velocity, executed, scene)
    np.testing.assert_allclose(t.position[:, 1, 2:], position, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(t.velocity[:, 1, 2:], velocity, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize(("field", "value"), [("repulsion", math.nan), ("repulsion_range", 0.0), ("agent_size", -1.0)])
def test_values_that_make_no_sense_are_refused(field: str, value: float):
    with pytest.raises(SpecError) as caught:
        HelbingConfig(**{field: value})
    assert caught.value.field == field
