"""Vicsek's law: constant speed, mean heading of the neighbours, noise by key; hand-computed cases and symmetries."""

import math
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import scene_state
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.config import SimulateConfig, World, make_world
from envs.experts.config import Interaction, VicsekConfig
from envs.experts.vicsek import vicsek
from envs.simulate import simulate_in_memory
from envs.state import State
from envs.swarm_env import scene_keys
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec

QUIET = VicsekConfig(noise=0.0, interaction=Interaction(radius=20.0))
SPEED, DT = QUIET.speed, QUIET.dt


def state_of(position, velocity, present=None) -> State:
    spec = SceneSpec(num_agents=np.shape(position)[1], num_obstacles=0)
    return jax.tree.map(jnp.asarray, scene_state(spec, position, velocity, agent_present=present))


@cache
def law(config: VicsekConfig):
    return jax.jit(vicsek(config))


def next_velocity(config: VicsekConfig, state: State, key=None) -> np.ndarray:
    return np.asarray(state.velocity) + DT * np.asarray(law(config)(state, None, key))


def test_the_mean_heading_of_those_in_sight_and_oneself_by_hand():
    # Agents 0 and 1 see each other, 2 is alone. Headings 0 and 90 degrees: 45 degrees, whatever their speeds were.
    got = next_velocity(QUIET, state_of([[[0, 0], [10, 0], [90, 0]]], [[[1, 0], [0, 9], [-3, 0]]]))[0]
    half = SPEED / math.sqrt(2)
    np.testing.assert_allclose(got, [[half, half], [half, half], [-SPEED, 0]], atol=1e-5)


def test_headings_that_cancel_and_agents_at_rest():
    opposite = next_velocity(QUIET, state_of([[[0, 0], [1, 0]]], [[[0, 2], [0, -2]]]))[0]
    np.testing.assert_allclose(opposite, [[0, SPEED], [0, -SPEED]], atol=1e-5)  # each keeps its own
    follower = next_velocity(QUIET, state_of([[[0, 0], [1, 0]]], [[[0, 0], [0, -2]]]))[0]
    np.testing.assert_allclose(follower, [[0, -SPEED]] * 2, atol=1e-5)
    alone = next_velocity(QUIET, state_of([[[0, 0]]], [[[0, 0]]]))[0]
    np.testing.assert_allclose(alone, [[SPEED, 0]], atol=1e-5)


def numpy_headings(position, velocity, seen) -> np.ndarray:
    """Angles by arctan2 of summed sines and cosines, as in the paper."""
    angle = np.arctan2(velocity[:, 1], velocity[:, 0])
    seen = seen | np.eye(len(position), dtype=bool)
    return np.arctan2(seen @ np.sin(angle), seen @ np.cos(angle))


@pytest.mark.parametrize(("agents", "radius"), [(12, 20.0), (80, 20.0), (12, None)])  # all pairs, cells, totals
def test_the_paper_in_numpy(agents: int, radius: float | None):
    rng = np.random.default_rng(0)
    position, velocity = rng.uniform(-40, 40, (agents, 2)), rng.uniform(-3, 3, (agents, 2))
    distance = np.linalg.norm(position[None] - position[:, None], axis=-1)
    angle = numpy_headings(position, velocity, distance < (radius or np.inf))
    config = replace(QUIET, interaction=Interaction(radius=radius))
    got = next_velocity(config, state_of([position], [velocity]))[0]
    np.testing.assert_allclose(got, SPEED * np.stack([np.cos(angle), np.sin(angle)], -1), atol=1e-3)


KEYS = scene_keys(0, range(200))


def test_noise_is_uniform_of_width_eta_and_belongs_to_the_key():
    config = replace(QUIET, noise=0.8)
    state = state_of(np.tile([[[0.0, 0], [500, 0]]], (200, 1, 1)), np.tile([[[1.0, 0], [1, 0]]], (200, 1, 1)))
    got = next_velocity(config, state, KEYS)
    np.testing.assert_allclose(np.linalg.norm(got, axis=-1), SPEED, rtol=1e-5)
    angle = np.arctan2(got[..., 1], got[..., 0])
    assert -0.4 <= angle.min() < -0.38
    assert 0.38 < angle.max() <= 0.4001
    assert np.std(angle) == pytest.approx(0.8 / math.sqrt(12), rel=0.1)
    assert abs(np.corrcoef(angle.T)[0, 1]) < 0.2  # agents draw for themselves
    np.testing.assert_array_equal(got, next_velocity(config, state, KEYS))
    swapped = next_velocity(config, state, KEYS[::-1])
    np.testing.assert_array_equal(got, swapped[::-1])  # by the scene's key, not by its place in the batch


def test_noise_without_a_key_is_refused():
    with pytest.raises(SpecError, match="one key per scene"):
        vicsek(VicsekConfig())(state_of([[[0, 0]]], [[[1, 0]]]))


coordinate = st.floats(-30, 30, width=32)
rows = st.lists(st.tuples(coordinate, coordinate, coordinate, coordinate), min_size=6, max_size=6)
quiet_law, noisy_law = jax.jit(vicsek(QUIET)), jax.jit(vicsek(replace(QUIET, noise=1.0)))


@settings(max_examples=40)
@given(rows, st.permutations(range(6)), st.lists(st.booleans(), min_size=6, max_size=6))
def test_numbering_and_ghosts_change_nothing(rows, order, present):
    rows, present = np.array([rows], np.float32), np.array([present])
    state = state_of(rows[..., :2], rows[..., 2:], present)
    got = np.asarray(quiet_law(state))
    assert np.isfinite(got).all()
    assert not got[~present].any()
    own = jnp.where(present[..., None], state.position, 3.0), jnp.where(present[..., None], state.velocity, -5.0)
    haunted = replace(state, position=own[0], velocity=own[1])
    np.testing.assert_array_equal(np.asarray(noisy_law(haunted, None, KEYS[:1])), noisy_law(state, None, KEYS[:1]))
    apart = np.linalg.norm(rows[0, :, None, :2] - rows[0, None, :, :2], axis=-1)
    unit = rows[0, :, 2:] / np.maximum(np.linalg.norm(rows[0, :, 2:], axis=-1, keepdims=True), 1e-6)
    seen = (apart < 20) & present[0]
    cancels = np.linalg.norm(seen @ unit, axis=-1) < 1e-3  # there, rounding decides
    if (np.abs(apart - 20) > 1e-3).all() and not cancels.any():
        renumbered = np.asarray(quiet_law(state_of(rows[:, order, :2], rows[:, order, 2:], present[:, order])))
        np.testing.assert_allclose(renumbered, got[:, order], atol=0.05)


def test_padding_with_ghosts_keeps_the_noise_of_the_others():
    rng = np.random.default_rng(3)
    position, velocity = rng.uniform(-20, 20, (1, 9, 2)), rng.uniform(-5, 5, (1, 9, 2))
    present = np.array([[True] * 6 + [False] * 3])
    padded = np.asarray(noisy_law(state_of(position, velocity, present), None, KEYS[:1]))
    alone = np.asarray(noisy_law(state_of(position[:, :6], velocity[:, :6]), None, KEYS[:1]))
    np.testing.assert_allclose(padded[:, :6], alone, rtol=1e-4, atol=1e-4)


@pytest.fixture(scope="module")
def flight():
    return simulate_in_memory(
        SimulateConfig(preset="vicsek", scenes=4, steps=30, num_agents=40, num_obstacles=0, engine="native", threads=1)
    )


def test_the_preset_keeps_its_speed_and_orders_itself(flight):
    speed = np.linalg.norm(flight.velocity[:, 1:], axis=-1)
    np.testing.assert_allclose(speed, make_world("vicsek").expert.speed, rtol=1e-3)
    heading = flight.velocity[:, 1:] / speed[..., None]
    polarisation = np.linalg.norm(heading.mean(axis=2), axis=-1)
    assert polarisation[:, -1].mean() > polarisation[:, 0].mean() + 0.2


def test_the_expert_and_the_scene_must_agree_on_dt():
    world = make_world("vicsek")
    with pytest.raises(SpecError, match="dt"):
        World(world.scene, world.spawn, replace(world.expert, dt=0.1))


@pytest.mark.parametrize(("field", "value"), [("speed", 0.0), ("noise", 7.0), ("noise", -0.1), ("dt", math.inf)])
def test_values_that_make_no_sense_are_refused(field: str, value: float):
    with pytest.raises(SpecError) as caught:
        VicsekConfig(**{field: value})
    assert caught.value.field == field
