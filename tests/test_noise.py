"""Noise on perception and actuation: what the thesis says, as large as was asked for, and a stream of its own."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_same, scenes_of

from envs.config import SimulateConfig, clear, mixed
from envs.experts.registry import make_expert
from envs.noise import ActuationNoise, PerceptionNoise, with_actuation_noise, with_perception_noise
from envs.simulate import make_policy
from envs.spawn import spawn
from envs.state import State
from envs.swarm_env import scene_keys
from swarm_mjcf.errors import SpecError

SCENES, AGENTS = 1500, 4
WORLD = mixed(clear(num_agents=AGENTS, num_obstacles=2))
KEYS = scene_keys(9, range(SCENES))
EXPERT = make_expert(WORLD.expert)


@pytest.fixture(scope="module")
def state() -> State:
    return jax.jit(lambda keys: spawn(keys, WORLD.scene, WORLD.spawn))(scene_keys(3, range(SCENES)))[0]


def seen(config: PerceptionNoise, state: State, keys=KEYS) -> State:
    """What a policy perceives."""
    held = []

    def spy(state: State, params: object, key):
        held.append(state)
        return jnp.zeros_like(state.position)

    with_perception_noise(spy, config)(state, None, keys)
    return held[0]


def done(config: ActuationNoise, wanted, state: State, keys=KEYS) -> np.ndarray:
    """What a policy that wants the acceleration `wanted` does."""
    return np.asarray(with_actuation_noise(lambda *_: jnp.asarray(wanted, jnp.float32), config)(state, None, keys))


def assert_normal(values: np.ndarray, std: float) -> None:
    """Mean within 5 standard errors of 0, spread within 5 of `std`, and the tails of a normal distribution."""
    values = np.asarray(values, np.float64).ravel()
    assert abs(values.mean()) < 5 * std / math.sqrt(values.size)
    assert abs(values.std() / std - 1) < 5 / math.sqrt(2 * values.size)
    share = math.erfc(2 / math.sqrt(2))  # of values beyond 2 standard deviations
    assert abs((np.abs(values) > 2 * std).mean() - share) < 5 * math.sqrt(share / values.size)


def test_perception_noise_is_normal_in_every_dimension_of_every_node(state: State):
    config = PerceptionNoise(position=2.0, velocity=0.5)
    got = seen(config, state)
    agents, obstacles = np.asarray(state.agent_present), np.asarray(state.obstacle_present)
    shifts = {
        name: np.asarray(getattr(got, name)) - np.asarray(getattr(state, name))
        for name in ("position", "velocity", "goal", "obstacle", "obstacle_velocity")
    }
    for axis in (0, 1):
        assert_normal(shifts["position"][agents][:, axis], 2.0)
        assert_normal(shifts["velocity"][agents][:, axis], 0.5)
        assert_normal(shifts["goal"][:, axis], 2.0)
        assert_normal(shifts["obstacle"][obstacles][:, axis], 2.0)
        assert_normal(shifts["obstacle_velocity"][obstacles][:, axis], 0.5)
    for name, present in (("position", agents), ("velocity", agents), ("obstacle", obstacles)):
        assert not shifts[name][~present].any(), name
    pairs = [shifts["position"][agents], shifts["velocity"][agents]]
    columns = np.concatenate(pairs, axis=1)  # x, y, vx, vy of an agent are independent
    correlation = np.corrcoef(columns.T) - np.eye(4)
    assert np.abs(correlation).max() < 5 / math.sqrt(len(columns))
    same = replace(got, **{name: getattr(state, name) for name in shifts})
    assert_same(same, state)  # nothing else is touched


def test_the_thesis_adds_a_standard_normal():
    assert PerceptionNoise() == PerceptionNoise(position=1.0, velocity=1.0)


def test_actuation_noise_is_normal_absolute_and_relative(state: State):
    present = np.asarray(state.agent_present)
    wanted = np.broadcast_to(np.asarray([3.0, 4.0], np.float32), state.position.shape)  # of norm 5
    for config, std in (
        (ActuationNoise(std=0.7), 0.7),
        (ActuationNoise(relative=0.2), 1.0),
        (ActuationNoise(std=3.0, relative=0.8), 5.0),  # variances add up: 9 + 16
    ):
        noise = done(config, wanted, state)[present] - wanted[present]
        assert_normal(noise[:, 0], std)
        assert_normal(noise[:, 1], std)
        assert abs((noise[:, 0] * noise[:, 1]).mean()) < 5 * std**2 / math.sqrt(len(noise))  # independent
        assert not done(config, wanted, state)[~present].any()
    # Of nothing, relative noise is nothing.
    assert not done(ActuationNoise(relative=0.5), 0 * wanted, state).any()


def test_dropout_loses_the_commands_of_that_share_of_agents_whole(state: State):
    present = np.asarray(state.agent_present)
    wanted = np.ones(state.position.shape)
    lost = (done(ActuationNoise(dropout=0.3), wanted, state) == 0)[present]
    np.testing.assert_array_equal(lost[:, 0], lost[:, 1])
    assert abs(lost[:, 0].mean() - 0.3) < 5 * math.sqrt(0.3 * 0.7 / len(lost))
    assert not done(ActuationNoise(dropout=1.0), wanted, state).any()


def test_no_noise_is_the_policy_itself():
    nothing = PerceptionNoise(position=0.0, velocity=0.0)
    assert with_perception_noise(EXPERT, nothing) is EXPERT
    assert with_actuation_noise(EXPERT, ActuationNoise()) is EXPERT


def test_the_policy_gets_a_key_of_its_own(state: State):
    few = scenes_of(state, slice(0, 8))
    held = []

    def spy(state: State, params: object, key):
        held.append(jax.random.key_data(key))
        return jnp.zeros_like(state.position)

    with_perception_noise(spy, PerceptionNoise())(few, None, KEYS[:8])
    with_actuation_noise(spy, ActuationNoise(std=1.0))(few, None, KEYS[:8])
    for keys in held:
        assert (np.asarray(keys) != jax.random.key_data(KEYS[:8])).any(axis=1).all()
    # A policy's own normal draws have nothing to do with the noise that it got.
    shift = np.asarray(seen(PerceptionNoise(), state).position - state.position)
    own = jax.vmap(lambda key: jax.random.normal(jax.random.split(key)[0], state.position.shape[1:]))(KEYS)
    pairs = np.stack([shift.ravel(), np.asarray(own).ravel()])[:, np.repeat(np.asarray(state.agent_present), 2)]
    assert abs(np.corrcoef(pairs)[0, 1]) < 5 / math.sqrt(pairs.shape[1])


def noisy_expert(state: State, keys) -> np.ndarray:
    policy = with_actuation_noise(
        with_perception_noise(EXPERT, PerceptionNoise()), ActuationNoise(std=0.5, relative=0.1, dropout=0.2)
    )
    return np.asarray(jax.jit(policy)(state, None, keys))


def test_a_scenes_noise_depends_on_its_key_and_not_on_its_place_in_the_batch(state: State):
    few, order = scenes_of(state, slice(0, 8)), np.array([3, 7, 0, 0, 5, 1, 2, 6])
    straight = noisy_expert(few, KEYS[:8])
    np.testing.assert_array_equal(noisy_expert(scenes_of(few, order), KEYS[:8][order]), straight[order])
    other = noisy_expert(few, KEYS[8:16])
    assert (other != straight)[np.asarray(few.agent_present)].any()


def test_absent_agents_after_the_others_change_nothing(state: State):
    """Ghosts do not shift the stream: agents 0..2 are noised alike in scenes of 3 and of 4."""
    here = jnp.asarray(np.arange(AGENTS) < 3)
    full = replace(state, agent_present=jnp.broadcast_to(here, state.agent_present.shape))
    per_agent = (
        "position",
        "velocity",
        "agent_present",
        "target",
        "touching_agent",
        "touching_obstacle",
        "touching_wall",
    )
    fewer = replace(full, **{name: getattr(full, name)[:, :3] for name in per_agent})
    one, other = (seen(PerceptionNoise(), s) for s in (full, fewer))
    np.testing.assert_array_equal(one.position[:, :3], other.position)
    np.testing.assert_array_equal(one.velocity[:, :3], other.velocity)
    config = ActuationNoise(std=1.0, dropout=0.5)
    wide, narrow = (done(config, np.ones(s.position.shape), s) for s in (full, fewer))
    np.testing.assert_array_equal(wide[:, :3], narrow)


def test_the_settings_of_a_simulation_make_the_noise(state: State):
    few = scenes_of(state, slice(0, 8))
    config = SimulateConfig(preset="clear", num_agents=AGENTS, num_obstacles=2, perception_noise=1.0)
    quiet, loud = (make_policy(c) for c in (replace(config, perception_noise=0.0), config))
    expert = EXPERT(few, None, KEYS[:8])
    np.testing.assert_array_equal(quiet(few, None, KEYS[:8]), expert)
    by_hand = with_perception_noise(EXPERT, PerceptionNoise())(few, None, KEYS[:8])
    np.testing.assert_array_equal(loud(few, None, KEYS[:8]), by_hand)
    assert (np.asarray(by_hand) != np.asarray(expert)).any()
    clumsy = make_policy(replace(config, perception_noise=0.0, actuation_noise=0.5))
    by_hand = with_actuation_noise(EXPERT, ActuationNoise(std=0.5))(few, None, KEYS[:8])
    np.testing.assert_array_equal(clumsy(few, None, KEYS[:8]), by_hand)


@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        (PerceptionNoise, "position", -1.0),
        (PerceptionNoise, "velocity", math.nan),
        (ActuationNoise, "std", math.inf),
        (ActuationNoise, "relative", -0.1),
        (ActuationNoise, "dropout", 1.5),
        (ActuationNoise, "dropout", -0.5),
        (SimulateConfig, "perception_noise", -1.0),
        (SimulateConfig, "actuation_noise", math.nan),
    ],
)
def test_noise_that_makes_no_sense_is_refused(kind: type, field: str, value: float):
    with pytest.raises(SpecError) as caught:
        kind(**{field: value})
    assert caught.value.field == field
